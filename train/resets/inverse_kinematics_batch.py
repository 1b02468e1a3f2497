"""Inverse kinematics of many tool poses on the device: Newton's Levenberg-Marquardt from several initial postures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.errors import TrainError
from concent_warp.train.reset_cfg import NewtonSolverCfg
from concent_warp.train.task.robot import Robot

if TYPE_CHECKING:
    import newton


def solve_inverse_kinematics_batch(
    m: mujoco.MjModel,
    robot: Robot,
    qpos: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    cfg: NewtonSolverCfg | None = None,
    *,
    device: str | None = None,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions that bring the tool to poses.

    Args:
        m: Compiled model.
        robot: The robot.
        qpos: States with the initial postures, shape (P, nq).
        position: Tool positions [m], world frame, shape (P, 3).
        rotation: Tool orientations, shape (P, 3, 3).
        cfg: Iterations, initial postures and tolerances.
        device: Warp's name of the device.
        seed: Seed of the further initial postures.

    Returns:
        Joint positions in the order of the robot's joints, shape (P, J), and whether they meet the tolerances
        within the joint limits, shape (P,) bool.

    Raises:
        TrainError: The joints between the world and the tool are not the arm's.
    """
    import newton.ik as ik
    import warp as wp

    cfg, count = cfg or NewtonSolverCfg(), len(qpos)
    if not count:
        return np.empty((0, len(robot.qpos))), np.empty(0, dtype=bool)
    chain, joints, link, offset = _tool_chain(m, robot, device)
    lower, upper = chain.joint_limit_lower, chain.joint_limit_upper
    assert lower is not None
    assert upper is not None
    address, reference = m.jnt_qposadr[joints], m.qpos0[m.jnt_qposadr[joints]]
    quaternion = np.empty((count, 4))
    for i in range(count):
        mujoco.mju_mat2Quat(quaternion[i], rotation[i].ravel())
    with wp.ScopedDevice(chain.device):
        solver = ik.IKSolver(
            chain,
            count,
            [
                ik.IKObjectivePosition(link, wp.vec3(*offset[0]), wp.array(position, dtype=wp.vec3)),
                ik.IKObjectiveRotation(
                    link, wp.quat(*np.roll(offset[1], -1)), wp.array(np.roll(quaternion, -1, axis=1), dtype=wp.vec4)
                ),
                ik.IKObjectiveJointLimit(lower, upper, weight=cfg.limit_weight),
            ],
            jacobian_mode=ik.IKJacobianType.ANALYTIC,
            sampler=ik.IKSampler.GAUSS,
            n_seeds=cfg.seeds,
            noise_std=cfg.noise,
            rng_seed=seed,
        )
        start: Any = wp.array(qpos[:, address] - reference, dtype=float)
        found: Any = wp.zeros_like(start)
        solver.step(start, found, iterations=cfg.iterations)
        angles = found.numpy().astype(float) + reference
    order = [list(joints).index(j) for j in robot.joint]
    return angles[:, order], _within_tolerance(m, robot, qpos, angles[:, order], position, rotation, cfg)


def _within_tolerance(
    m: mujoco.MjModel,
    robot: Robot,
    qpos: np.ndarray,
    angles: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    cfg: NewtonSolverCfg,
) -> np.ndarray:
    """Return whether joint positions (P, J) meet poses and joint limits within the tolerances, shape (P,) bool."""
    d = mujoco.MjData(m)
    limited = m.jnt_limited[robot.joint].astype(bool)
    low, high = m.jnt_range[robot.joint].T
    fine = (((angles >= low - 1e-4) & (angles <= high + 1e-4)) | ~limited).all(axis=1) & np.isfinite(angles).all(axis=1)
    turn, quaternion = np.zeros(3), np.zeros(4)
    for i in np.flatnonzero(fine):
        d.qpos[:] = qpos[i]
        d.qpos[robot.qpos] = angles[i]
        mujoco.mj_kinematics(m, d)
        mujoco.mju_mat2Quat(quaternion, (rotation[i] @ d.site_xmat[robot.tool].reshape(3, 3).T).ravel())
        mujoco.mju_quat2Vel(turn, quaternion, 1.0)
        fine[i] = (
            np.linalg.norm(position[i] - d.site_xpos[robot.tool]) < cfg.position and np.linalg.norm(turn) < cfg.angle
        )
    return fine


def _tool_chain(
    m: mujoco.MjModel, robot: Robot, device: str | None
) -> tuple[newton.Model, np.ndarray, int, tuple[np.ndarray, np.ndarray]]:
    """Return the links from the world to the tool as a Newton model.

    Returns:
        The model; the ids of its joints in its order, shape (n,); the link of the tool; the tool's pose in it, a
        position [m] and a quaternion wxyz.

    Raises:
        TrainError: The joints between the world and the tool are not the arm's.
    """
    import newton
    import warp as wp

    def transform(position: np.ndarray, quaternion: np.ndarray) -> wp.transform:
        return wp.transform(wp.vec3(*map(float, position)), wp.quat(*map(float, np.roll(quaternion, -1))))

    bodies = [int(m.site_bodyid[robot.tool])]
    while m.body_parentid[bodies[0]]:
        bodies.insert(0, int(m.body_parentid[bodies[0]]))
    builder = newton.ModelBuilder()
    link, joints, handles = -1, [], []
    fixed = wp.transform_identity()
    for body in bodies:
        fixed = fixed * transform(m.body_pos[body], m.body_quat[body])
        for j in range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]):
            anchor = wp.transform(wp.vec3(*map(float, m.jnt_pos[j])), wp.quat_identity())
            child = builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)))
            hinge = m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
            add = builder.add_joint_revolute if hinge else builder.add_joint_prismatic
            limited = bool(m.jnt_limited[j])
            low, high = (m.jnt_range[j] - m.qpos0[m.jnt_qposadr[j]]) if limited else (-1e6, 1e6)
            handles.append(
                add(
                    parent=link,
                    child=child,
                    parent_xform=fixed * anchor,
                    child_xform=anchor,
                    axis=wp.vec3(*map(float, m.jnt_axis[j])),
                    limit_lower=float(low),
                    limit_upper=float(high),
                )
            )
            joints.append(j)
            link, fixed = child, wp.transform_identity()
    if sorted(joints) != sorted(robot.joint.tolist()):
        raise TrainError("the arm's joints are not those between the world and the tool")
    builder.add_articulation(handles)
    tool = fixed * transform(m.site_pos[robot.tool], m.site_quat[robot.tool])
    offset = np.array(wp.transform_get_translation(tool)), np.roll(np.array(wp.transform_get_rotation(tool)), 1)
    return builder.finalize(device=device), np.array(joints), link, offset
