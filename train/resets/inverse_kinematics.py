"""Inverse kinematics of small displacements: damped least squares from a nearby posture."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.train.reset_cfg import PostureSolverCfg
from concent_warp.train.task.robot import Robot


def solve_inverse_kinematics(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    robot: Robot,
    position: np.ndarray,
    rotation: np.ndarray,
    cfg: PostureSolverCfg | None = None,
) -> np.ndarray | None:
    """Return joint positions that bring the tool to a pose, shape (J,); None if they are not found within the limits.

    An arm with fewer than six joints must meet the tolerances in all six directions too: a Cartesian robot reaches no
    rotated pose.

    Args:
        m: Compiled model.
        d: Data with the initial posture; modified.
        robot: The robot.
        position: Tool position [m], world frame, shape (3,).
        rotation: Tool orientation, shape (3, 3).
        cfg: Iterations, damping and tolerances.
    """
    cfg = cfg or PostureSolverCfg()
    jacobian = np.zeros((6, m.nv))
    turn = np.zeros(3)
    quaternion = np.zeros(4)
    limited = m.jnt_limited[robot.joint].astype(bool)
    low, high = m.jnt_range[robot.joint].T
    for _ in range(cfg.iterations):
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mju_mat2Quat(quaternion, (rotation @ d.site_xmat[robot.tool].reshape(3, 3).T).ravel())
        mujoco.mju_quat2Vel(turn, quaternion, 1.0)
        error = np.concatenate([position - d.site_xpos[robot.tool], turn])
        joints = d.qpos[robot.qpos]
        if np.linalg.norm(error[:3]) < cfg.position and np.linalg.norm(error[3:]) < cfg.angle:
            inside = (joints >= low - 1e-9) & (joints <= high + 1e-9) | ~limited
            return joints.copy() if inside.all() else None
        mujoco.mj_jacSite(m, d, jacobian[:3], jacobian[3:], robot.tool)
        arm = jacobian[:, robot.dof]
        step = arm.T @ np.linalg.solve(arm @ arm.T + cfg.damping * np.eye(6), error)
        d.qpos[robot.qpos] = np.where(limited, np.clip(joints + step, low, high), joints + step)
    return None
