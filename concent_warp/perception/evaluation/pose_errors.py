"""Errors of object poses by the distances of model points: ADD, ADD-S, and the areas under their curves.

ADD is the mean distance of each model point from where the true pose puts it; ADD-S takes the nearest model point in
its place and so does not see symmetries (Hinterstoisser et al., "Model Based Training, Detection and Pose Estimation
of Texture-Less 3D Objects in Heavily Cluttered Scenes", ACCV 2012). The area under the curve of accuracy over the
threshold, 0 to 10 cm, is that of Xiang et al., "PoseCNN", RSS 2018, section IV-B.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from concent_warp.errors import ConcentError

MAX_THRESHOLD = 0.1
"""Largest threshold of the curves [m]."""


@dataclass(frozen=True)
class ModelPoints:
    """Points of an object's mesh, by which poses are compared."""

    points: np.ndarray
    """Points [m], frame of the object, shape (n, 3)."""

    @cached_property
    def tree(self) -> KDTree:
        """Search tree of the points."""
        return KDTree(self.points)

    def add(self, estimate: np.ndarray, truth: np.ndarray) -> float:
        """Return ADD, the mean distance of corresponding points [m].

        Args:
            estimate: Transform, shape (4, 4); NaN where there is none, which gives an infinite error.
            truth: True transform, shape (4, 4).
        """
        if not np.isfinite(estimate).all():
            return float("inf")
        return float(np.linalg.norm(_moved(self.points, estimate) - _moved(self.points, truth), axis=1).mean())

    def adds(self, estimate: np.ndarray, truth: np.ndarray) -> float:
        """Return ADD-S, the mean distance of the points in the true pose from the nearest in the estimated pose [m].

        The points of the true pose look for those of the estimate, as in PoseCNN's evaluation and in bop_toolkit; the
        reverse gives another number. Arguments are those of `add`.
        """
        if not np.isfinite(estimate).all():
            return float("inf")
        # Distances do not change if both poses move: the tree of the model itself serves every frame.
        return float(self.tree.query(_moved(self.points, np.linalg.inv(estimate) @ truth))[0].mean())


def area_under_curve(errors: np.ndarray, max_threshold: float = MAX_THRESHOLD) -> float:
    """Return the area under the curve of the share of errors below a threshold, over the threshold's range, 0 to 1.

    It is the integral itself, the mean of max(0, 1 - error / max_threshold). PoseCNN's script sums rectangles whose
    height is the share at their right end, which adds up to 1 / n for n errors.

    Args:
        errors: Errors [m], shape (n,); infinite where there was no estimate.
        max_threshold: Largest threshold [m].

    Raises:
        ConcentError: There are no errors, or one is NaN or negative.
    """
    errors = np.asarray(errors, float)
    if not errors.size or np.isnan(errors).any() or (errors < 0).any():
        found = "none" if not errors.size else "NaN or numbers below 0"
        raise ConcentError("no curve of these errors", expected="errors in m, not negative", found=found)
    return float(np.clip(1 - errors / max_threshold, 0, 1).mean())


def _moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return points (n, 3) after a transform (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]
