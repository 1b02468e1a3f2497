"""Rigid motion between two sets of points.

Least squares by Kabsch ("A solution for the best rotation to relate two sets of vectors", Acta Crystallographica A32,
1976).
"""

from __future__ import annotations

import numpy as np


def kabsch(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the rigid transforms that bring `source` nearest to `target`, shape (..., 4, 4).

    Args:
        source: Points [m], shape (..., n, 3), n >= 3.
        target: The same points elsewhere [m], shape (..., n, 3).
    """
    source_mean, target_mean = source.mean(axis=-2), target.mean(axis=-2)
    covariance = np.swapaxes(source - source_mean[..., None, :], -1, -2) @ (target - target_mean[..., None, :])
    left, _, right = np.linalg.svd(covariance)
    mirror = np.sign(np.linalg.det(left) * np.linalg.det(right))
    left[..., 2] *= mirror[..., None]
    rotation = np.swapaxes(left @ right, -1, -2)
    result = np.zeros((*rotation.shape[:-2], 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = target_mean - np.einsum("...ij,...j->...i", rotation, source_mean)
    result[..., 3, 3] = 1.0
    return result
