"""Inverse kinematics of small displacements: damped least squares from a posture nearby."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.train.task.robot import Robot

ITERATIONS = 20
DAMPING = 1e-4
"""Added to the diagonal of J J^T, with lengths in m and angles in rad."""
POSITION, ANGLE = 2e-4, 2e-3
"""Errors that are accepted [m, rad]."""


def reach(
    m: mujoco.MjModel, d: mujoco.MjData, robot: Robot, position: np.ndarray, rotation: np.ndarray
) -> np.ndarray | None:
    """Return joint positions that bring the tool to a pose, from those in `d`, shape (J,); None where they do not.

    An arm of fewer than six joints reaches what it can: directions in which it cannot move at the outset count as
    reached if they are off by no more than is accepted; so a Cartesian robot cannot be turned.

    Args:
        m: Compiled model.
        d: Data with the posture to start from; changed.
        robot: The robot.
        position: Tool position [m], world frame, shape (3,).
        rotation: Tool orientation, shape (3, 3).
    """
    jacobian = np.zeros((6, m.nv))
    turn = np.zeros(3)
    quaternion = np.zeros(4)
    limited = m.jnt_limited[robot.joint].astype(bool)
    low, high = m.jnt_range[robot.joint].T
    for _ in range(ITERATIONS):
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mju_mat2Quat(quaternion, (rotation @ d.site_xmat[robot.tool].reshape(3, 3).T).ravel())
        mujoco.mju_quat2Vel(turn, quaternion, 1.0)
        error = np.concatenate([position - d.site_xpos[robot.tool], turn])
        joints = d.qpos[robot.qpos]
        if np.linalg.norm(error[:3]) < POSITION and np.linalg.norm(error[3:]) < ANGLE:
            inside = (joints >= low - 1e-9) & (joints <= high + 1e-9) | ~limited
            return joints.copy() if inside.all() else None
        mujoco.mj_jacSite(m, d, jacobian[:3], jacobian[3:], robot.tool)
        arm = jacobian[:, robot.dof]
        step = arm.T @ np.linalg.solve(arm @ arm.T + DAMPING * np.eye(6), error)
        d.qpos[robot.qpos] = np.where(limited, np.clip(joints + step, low, high), joints + step)
    return None
