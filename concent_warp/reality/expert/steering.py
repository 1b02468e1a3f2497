"""From the expert's path to commands: which joints move, and how far the commands lead to exert a force."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from concent_warp.reality.expert.plan import Path


def finger_joints(model: mujoco.MjModel) -> list[int]:
    """Return the slide joints of the gripper: those no arm actuator drives directly."""
    return [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE and model.jnt_limited[j]]


def arm_joints(model: mujoco.MjModel, gripper: list[int]) -> list[int]:
    """Return the hinge joints that the other actuators drive, in the order of the actuators."""
    return [int(model.actuator_trnid[a, 0]) for a in range(model.nu) if a not in gripper]


def deflection(
    model: mujoco.MjModel, site: str, joints: list[int], qpos: np.ndarray, angles: np.ndarray, force: np.ndarray
) -> np.ndarray:
    """Return by how much the commands lie beyond `angles` (T, J) [rad] to exert `force` (T, 3) [N], shape (T, J).

    A position-controlled joint yields by torque over proportional gain: dq = K^-1 J^T f.
    """
    gain = np.array(
        [
            model.actuator_gainprm[a, 0]
            for j in joints
            for a in range(model.nu)
            if model.actuator_trnid[a, 0] == j and model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        ]
    )
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    jacobian = np.zeros((3, model.nv))
    result = np.zeros_like(angles)
    for t in range(len(angles)):
        data.qpos[model.jnt_qposadr[joints]] = angles[t]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(site).id)
        result[t] = jacobian[:, model.jnt_dofadr[joints]].T @ force[t] / gain
    return result


def aligned(path: Path, start_rotation: np.ndarray) -> Path:
    """Turn the planned orientations by quarter turns so that they begin nearest to where the tool is."""
    best, turn = -np.inf, np.eye(3)
    for k in range(4):
        a = k * np.pi / 2
        candidate = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        match = float(np.trace(start_rotation.T @ candidate @ path.rotation[0]))
        if match > best + 1e-9:
            best, turn = match, candidate
    return replace(path, rotation=turn @ path.rotation)
