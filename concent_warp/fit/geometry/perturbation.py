"""Spatially coherent noise over sphere positions (paper, appendix A).

The paper samples noise at the centroid of the deformable region and propagates it through an RBF kernel. Literally,
that is one translation of each object; what deforms surfaces smoothly is a sample of a Gaussian process whose
covariance is the same RBF kernel. Both are here, and independent noise for comparison.

A third of the matter is size: spheres centred on a surface inflate the object everywhere, and undoing this takes a
motion of all spheres inward that random dents seldom add up to. So each sample may also contain a swelling: a
displacement of all faces by the same distance (`offset`), which varies over a longer length.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from concent_warp.scene.spheres.contact_geometry import ContactGeometry

Noise = Literal["gaussian_process", "centroid", "independent"]
DIAGONAL_JITTER = 1e-6
"""Added to the diagonal of the kernel, so that its Cholesky factor exists [-]."""


class Perturbation:
    """Samples noise of unit standard deviation over the spheres of a mask."""

    def __init__(
        self,
        geometry: ContactGeometry,
        mask: np.ndarray,
        kind: Noise,
        length: float,
        *,
        growth: np.ndarray | None = None,
        swelling: float = 0.0,
        swelling_length: float = 0.05,
    ) -> None:
        """Prepare to sample.

        Args:
            geometry: Where the spheres are.
            mask: Spheres that may move, shape (S,) bool.
            kind: Gaussian-process sample, the paper's literal reading, or independent noise.
            length: Length scale of the RBF kernel [m].
            growth: Displacement of each sphere where its body grows by one, shape (S, 3); needed for swelling.
            swelling: Standard deviation of the swelling, relative to that of the rest.
            swelling_length: Length scale over which the swelling varies [m].
        """
        self.shape = len(geometry)
        self.growth, self.swelling = growth, swelling
        self.blocks: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for body in geometry.bodies:
            rows = geometry.of(body)
            rows = rows[mask[rows]]
            if not len(rows):
                continue
            points = geometry.position[rows]
            slow = _root(points, swelling_length)
            if kind == "gaussian_process":
                factor = _root(points, length)
            elif kind == "centroid":
                factor = rbf(points, points.mean(axis=0, keepdims=True), length)
            else:
                factor = np.eye(len(rows))
            self.blocks.append((rows, factor, slow))

    def sample(self, count: int, channels: int, rng: np.random.Generator) -> np.ndarray:
        """Return `count` samples with independent channels, shape (count, S, channels); zero outside the mask."""
        result = np.zeros((count, self.shape, channels))
        for rows, factor, slow in self.blocks:
            result[:, rows] = np.einsum("rk,ckd->crd", factor, rng.normal(size=(count, factor.shape[1], channels)))
            if self.swelling > 0 and self.growth is not None:
                size = self.swelling * rng.normal(size=(count, len(rows))) @ slow.T
                result[:, rows, :3] += size[:, :, None] * self.growth[rows]
        return result


def _root(points: np.ndarray, length: float) -> np.ndarray:
    """Return the Cholesky factor of the RBF kernel over points (n, 3), shape (n, n)."""
    return np.linalg.cholesky(rbf(points, points, length) + DIAGONAL_JITTER * np.eye(len(points)))


def rbf(a: np.ndarray, b: np.ndarray, length: float) -> np.ndarray:
    """Return the kernel exp(-|a_i - b_j|^2 / (2 length^2)), shape (len(a), len(b)); positions and length in m."""
    squared = ((a[:, None] - b[None]) ** 2).sum(axis=2)
    return np.exp(-squared / (2 * length**2))


def smoothed(geometry: ContactGeometry, mask: np.ndarray, values: np.ndarray, length: float) -> np.ndarray:
    """Return `values` (S, channels) averaged over neighbours by the normalised kernel, inside the mask of each body."""
    result = values.copy()
    for body in geometry.bodies:
        rows = geometry.of(body)
        rows = rows[mask[rows]]
        if len(rows):
            weight = rbf(geometry.position[rows], geometry.position[rows], length)
            result[rows] = weight @ values[rows] / weight.sum(axis=1, keepdims=True)
    return result
