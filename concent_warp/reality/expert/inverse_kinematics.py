"""Inverse kinematics of a site's pose: bounded least squares on the joint angles, warm-started along a path."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from scipy.optimize import least_squares

from concent_warp.errors import SceneError


def solve_path(
    model: mujoco.MjModel,
    site: str,
    joints: list[int],
    qpos: np.ndarray,
    positions: np.ndarray,
    rotations: np.ndarray,
    *,
    tolerance: float = 5e-4,
) -> np.ndarray:
    """Return joint angles [rad] that bring a site through a path of poses, shape (T, len(joints)).

    Args:
        model: Compiled scene.
        site: Name of the site.
        joints: Ids of the hinge joints that may move.
        qpos: Start configuration, shape (nq,); redundant degrees of freedom are regularised towards it.
        positions: Site positions [m], world frame, shape (T, 3).
        rotations: Site orientations as matrices, shape (T, 3, 3).
        tolerance: Largest position error accepted [m]; the orientation may be off by 20 times that in rad.

    Raises:
        SceneError: A pose is out of reach within the joint limits.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    address = model.jnt_qposadr[joints]
    column = model.jnt_dofadr[joints]
    lower, upper = model.jnt_range[joints].T + np.array([[1e-3], [-1e-3]])
    row = model.site(site).id
    rest = qpos[address].copy()
    angle = rest.copy()
    solution = np.zeros((len(positions), len(joints)))
    jacobian = np.zeros((6, model.nv))
    pull = 1e-3

    for t, (position, rotation) in enumerate(zip(positions, rotations, strict=True)):
        previous = angle.copy()

        def residual(q: np.ndarray, position=position, rotation=rotation, previous=previous) -> np.ndarray:
            data.qpos[address] = q
            mujoco.mj_kinematics(model, data)
            turn = _rotation_vector(rotation.T @ data.site_xmat[row].reshape(3, 3))
            return np.concatenate(
                [data.site_xpos[row] - position, 0.1 * turn, pull * 0.3 * (q - previous), pull * 0.1 * (q - rest)]
            )

        def gradient(q: np.ndarray, rotation=rotation) -> np.ndarray:
            data.qpos[address] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], row)
            move = jacobian[:3, column]
            turn = 0.1 * rotation.T @ jacobian[3:, column]
            identity = pull * np.eye(len(q))
            return np.concatenate([move, turn, 0.3 * identity, 0.1 * identity])

        options: dict[str, Any] = {"jac": gradient, "bounds": (lower, upper), "xtol": 1e-10}
        angle = least_squares(residual, np.clip(angle, lower, upper), **options).x
        error = residual(angle)
        if np.abs(error[:3]).max() > tolerance or np.abs(error[3:6]).max() > 2 * tolerance:
            raise SceneError(
                f"the robot cannot reach pose {t} of the path",
                where=np.round(position, 3).tolist(),
                expected=f"within {tolerance * 1e3:g} mm",
                found=f"{np.abs(error[:3]).max() * 1e3:.2f} mm off",
                fix="move the objects nearer to the robot",
            )
        solution[t] = angle
    return solution


def _rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad] of a rotation matrix (3, 3)."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, matrix.ravel())
    vector = np.zeros(3)
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector
