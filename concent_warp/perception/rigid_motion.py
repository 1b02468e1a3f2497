"""Rigid motion between two sets of points with outliers.

Least squares by Kabsch ("A solution for the best rotation to relate two sets of vectors", Acta Crystallographica A32,
1976), made robust by random sample consensus (Fischler and Bolles, "Random sample consensus", Communications of the
ACM 24(6), 1981).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from concent_warp.checks import Count, Positive


@dataclass(frozen=True)
class ConsensusCfg:
    """Settings of the random sample consensus."""

    samples: Count = 200
    """Triples of points that are tried."""
    refits: int = 2
    """Rounds of refitting to the points that agree."""
    max_over_median: Positive = 3.0
    """Largest distance of an agreeing point over the median of all agreeing points [-]. With the same normal noise
    along all axes, all but one in ten thousand are nearer."""


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


def transformed(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (..., n, 3) [m] after a rigid transform (..., 4, 4)."""
    return points @ np.swapaxes(transform[..., :3, :3], -1, -2) + transform[..., None, :3, 3]


def inverse(transform: np.ndarray) -> np.ndarray:
    """Return the inverse of a rigid transform, shape (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = transform[:3, :3].T
    result[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return result


def consensus(
    source: np.ndarray, target: np.ndarray, tolerance: float, rng: np.random.Generator, cfg: ConsensusCfg | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the rigid transform (4, 4) that most points agree with, and which do, shape (n,) bool.

    Each sample fits three points; its cost is the sum of the distances of all points, each at most `tolerance` [m].
    Squared distances would favour a motion between those of two groups of points over that of the larger group. The
    best sample is refitted to the points that agree with it: those within `cfg.max_over_median` times the median
    distance, so that a wide tolerance costs no accuracy where the noise is small. None with fewer than three points, or
    if fewer than four agree.

    Args:
        source: Points [m], shape (n, 3).
        target: The same points elsewhere [m], some of them wrong, shape (n, 3).
        tolerance: Distance within which a point agrees [m].
        rng: Random generator of the samples.
        cfg: Settings.
    """
    cfg = cfg or ConsensusCfg()
    count = len(source)
    if count < 3:
        return None
    triples = np.argsort(rng.random((cfg.samples, count)), axis=1)[:, :3]
    candidates = kabsch(source[triples], target[triples])
    distances = np.linalg.norm(transformed(candidates, source[None]) - target, axis=2)
    winner = np.minimum(distances, tolerance).sum(axis=1).argmin()
    distance, transform = distances[winner], candidates[winner]
    for _ in range(cfg.refits):
        agrees = _narrowed(distance, tolerance, cfg.max_over_median)
        if agrees.sum() < min(count, 4):
            return None
        transform = kabsch(source[agrees], target[agrees])
        distance = np.linalg.norm(transformed(transform, source) - target, axis=1)
    return transform, _narrowed(distance, tolerance, cfg.max_over_median)


def _narrowed(distance: np.ndarray, tolerance: float, limit: float) -> np.ndarray:
    """Return which points agree, shape (n,) bool: within `tolerance` [m] and `limit` times the median of those."""
    agrees = distance < tolerance
    if not agrees.any():
        return agrees
    return agrees & (distance <= limit * np.median(distance[agrees]))
