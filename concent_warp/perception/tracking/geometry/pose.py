"""Small motions of rigid poses: a twist is (translation [m], rotation vector [rad]), both along the world's axes.

The rotation acts about the origin of the body: ``R <- exp(w) R``, ``p <- p + v``.
"""

from __future__ import annotations

import mujoco
import numpy as np


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix, shape (3, 3), of a rotation vector [rad], shape (3,)."""
    quaternion, result = np.array([1.0, 0, 0, 0]), np.zeros(9)
    mujoco.mju_quatIntegrate(quaternion, np.asarray(vector, float), 1.0)
    mujoco.mju_quat2Mat(result, quaternion)
    return result.reshape(3, 3)


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad], shape (3,), at most a half turn, of a rotation matrix, shape (3, 3)."""
    quaternion, result = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation, float).ravel())
    mujoco.mju_quat2Vel(result, quaternion, 1.0)
    return result


def moved(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Return a pose, shape (4, 4), after a twist, shape (6,)."""
    result = pose.copy()
    result[:3, :3] = rotation_of(twist[3:]) @ pose[:3, :3]
    result[:3, 3] += twist[:3]
    return result


def twist_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the twist, shape (6,), that moves one pose, shape (4, 4), to another."""
    return np.concatenate([end[:3, 3] - start[:3, 3], rotation_vector(end[:3, :3] @ start[:3, :3].T)])


def rotation_angle(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle [rad] between the orientations of two poses or rotations."""
    cosine = (float((first[:3, :3] * second[:3, :3]).sum()) - 1) / 2
    return float(np.arccos(min(max(cosine, -1.0), 1.0)))


def pose_of(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return a pose, shape (4, 4), of a position [m] and a quaternion wxyz."""
    result, rotation = np.eye(4), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quaternion, float) / np.linalg.norm(quaternion))
    result[:3, :3], result[:3, 3] = rotation.reshape(3, 3), position
    return result


def quaternion_of(pose: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz of a pose, w not negative, shape (4,)."""
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(pose[:3, :3]).ravel())
    return -result if result[0] < 0 else result
