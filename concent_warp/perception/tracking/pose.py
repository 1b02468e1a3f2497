"""Small motions of rigid poses: a twist is (translation [m], rotation vector [rad]), both along the world's axes.

The rotation acts about the origin of the body: ``R <- exp(w) R``, ``p <- p + v``.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def moved(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Return a pose, shape (4, 4), after a twist, shape (6,)."""
    result = pose.copy()
    result[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix() @ pose[:3, :3]
    result[:3, 3] += twist[:3]
    return result


def twist_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the twist, shape (6,), that moves one pose, shape (4, 4), to another."""
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    return np.concatenate([end[:3, 3] - start[:3, 3], turn])


def rotation_angle(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle [rad] between the orientations of two poses or rotations."""
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1, 1)))


def pose_of(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return a pose, shape (4, 4), of a position [m] and a quaternion wxyz."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    result[:3, 3] = position
    return result


def quaternion_of(pose: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz of a pose, shape (4,)."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True, scalar_first=True)
