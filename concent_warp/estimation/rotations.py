"""Sequences of orientations: quaternions wxyz, rotation matrices and the rotation vectors between them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def rotation_vectors(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rotation vectors [rad], shape (n, 3), from `start` to `end`, quaternions wxyz (n, 4)."""
    lengths = np.linalg.norm(start, axis=1) * np.linalg.norm(end, axis=1)
    vectors = np.zeros((len(start), 3))
    valid = lengths > 0
    first, second = (Rotation.from_quat(q[valid], scalar_first=True) for q in (start, end))
    vectors[valid] = (first.inv() * second).as_rotvec()
    return vectors


def rotation_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return rotation vectors [rad], shape (T, 3), that turn `start` into `end`, quaternions wxyz (T, 4).

    In the frame of `start`; NaN where either is.
    """
    vector = np.full((len(start), 3), np.nan)
    valid = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1)
    vector[valid] = rotation_vectors(start[valid], end[valid])
    return vector


def continuous_quaternions(quaternion: np.ndarray) -> np.ndarray:
    """Return quaternions (T, 4) with signs flipped so that each is on the side of the one before it."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return quaternion * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def rotation_matrices(quaternion: np.ndarray) -> np.ndarray:
    """Return rotation matrices, shape (T, 3, 3), of quaternions wxyz (T, 4) of any length but zero; NaN for NaN."""
    matrix = np.full((len(quaternion), 3, 3), np.nan)
    valid = np.isfinite(quaternion).all(axis=1)
    matrix[valid] = Rotation.from_quat(quaternion[valid], scalar_first=True).as_matrix()
    return matrix
