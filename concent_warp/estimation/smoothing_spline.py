"""Smoothing splines: position, velocity and acceleration from noisy readings, each with a standard deviation.

A quintic spline with even knots whose third differences are penalised (Eilers and Marx, Flexible smoothing with
B-splines and penalties, 1996), read as a Gaussian process: jerk is white noise of a strength that the readings
themselves tell, by maximum marginal likelihood. What comes out is band-limited: an impact is spread over the few
samples that the noise asks for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded

if TYPE_CHECKING:
    from scipy.sparse import csr_array

DEGREE = 5
PENALISED = 3
"""Derivative whose differences are penalised: the third, jerk."""
MOST_KNOTS = 4000
FEWEST_SAMPLES = 5
SMOOTHNESS = 10.0 ** np.arange(-4.0, 6.01, 1 / 3)
"""Standard deviations of a coefficient's third difference, in noise standard deviations, that are tried."""


@dataclass(frozen=True)
class Smooth:
    """A smoothed signal of `dim` components that share their noise."""

    knots: np.ndarray
    """Shape (n + 6,)."""
    coefficient: np.ndarray
    """Shape (n, dim)."""
    factor: np.ndarray
    """Banded Cholesky factor of the posterior precision of the coefficients of a component, shape (6, n)."""
    noise: float
    """Standard deviation of the noise that was taken."""
    span: tuple[float, float]
    """First and last reading [s]."""

    def at(self, time: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the signal (0), its velocity (1) or its acceleration (2) at `time` (T,) [s], shape (T, dim)."""
        return _rows(self.knots, time, order) @ self.coefficient

    def covariance(self, time: np.ndarray) -> np.ndarray:
        """Return the covariance of signal, velocity and acceleration of a component at `time` (T,), (T, 3, 3)."""
        basis = np.stack([_rows(self.knots, time, order).toarray() for order in range(3)], axis=1)
        flat = basis.reshape(-1, basis.shape[2])
        solved = cho_solve_banded((self.factor, False), flat.T).T.reshape(basis.shape)
        return np.einsum("tin,tjn->tij", basis, solved)


def smooth(
    time: np.ndarray,
    value: np.ndarray,
    noise: float,
    velocity: tuple[np.ndarray, np.ndarray, float] | None = None,
) -> Smooth | None:
    """Fit a smoothing spline.

    Args:
        time: Readings' times [s], shape (T,), increasing.
        value: Readings, shape (T, dim); rows with NaN are left out.
        noise: Their standard deviation.
        velocity: Readings of the velocity, if there are any: times (S,), values (S, dim), standard deviation.

    Returns:
        The spline, or None where there are fewer than `FEWEST_SAMPLES` readings.
    """
    valid = np.isfinite(value).all(axis=1)
    time, value = np.asarray(time, float)[valid], np.asarray(value, float)[valid]
    if len(time) < FEWEST_SAMPLES:
        return None
    knots = _even_knots(time)
    count = len(knots) - DEGREE - 1
    design = _rows(knots, time, 0)
    normal = (design.T @ design) / noise**2
    right = design.T @ value / noise**2
    square = float((value**2).sum()) / noise**2
    if velocity is not None:
        clock, speed, std = velocity
        kept = np.isfinite(speed).all(axis=1) & (clock >= time[0]) & (clock <= time[-1])
        rate = _rows(knots, clock[kept], 1)
        normal = normal + (rate.T @ rate) / std**2
        right = right + rate.T @ speed[kept] / std**2
        square += float((speed[kept] ** 2).sum()) / std**2
    data = _upper_bands(normal)
    penalty = _penalty_bands(count)
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for scale in SMOOTHNESS * noise:
        factor = cholesky_banded(data + penalty / scale**2 + _ridge(data, scale), lower=False)
        coefficient = cho_solve_banded((factor, False), right)
        evidence = float((right * coefficient).sum() - square)
        evidence -= value.shape[1] * (2 * np.log(factor[-1]).sum() + 2 * (count - PENALISED) * np.log(scale))
        if best is None or evidence > best[0]:
            best = evidence, coefficient, factor
    assert best is not None
    return Smooth(knots, best[1], best[2], noise, (float(time[0]), float(time[-1])))


def _even_knots(time: np.ndarray) -> np.ndarray:
    """Return even knots about as far apart as the readings, reaching over both ends, shape (n + 6,)."""
    length = time[-1] - time[0]
    pieces = int(np.clip(round(length / float(np.median(np.diff(time)))), 1, MOST_KNOTS))
    step = length / pieces
    return time[0] + step * np.arange(-DEGREE, pieces + DEGREE + 1)


def _rows(knots: np.ndarray, time: np.ndarray, order: int) -> csr_array:
    """Return the matrix that takes coefficients to the derivative of some order at `time` (T,), sparse, (T, n)."""
    from scipy.sparse import csr_array, diags_array

    inside = np.clip(np.asarray(time, float), knots[DEGREE], knots[-DEGREE - 1])
    trimmed = knots[order : len(knots) - order]
    matrix = csr_array(BSpline.design_matrix(inside, trimmed, DEGREE - order))
    step = knots[1] - knots[0]
    for left in range(order):
        size = len(knots) - DEGREE - 1 - (order - 1 - left)
        difference = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(size - 1, size)) / step  # pyright: ignore
        matrix = csr_array(matrix @ difference)
    return matrix


def _upper_bands(matrix: csr_array) -> np.ndarray:
    """Return the upper bands of a symmetric banded matrix as `scipy.linalg` wants them, shape (6, n)."""
    count = int(matrix.diagonal().size)
    bands = np.zeros((DEGREE + 1, count))
    for offset in range(min(DEGREE + 1, count)):
        bands[DEGREE - offset, offset:] = matrix.diagonal(offset)
    return bands


def _penalty_bands(count: int) -> np.ndarray:
    """Return the upper bands of D'D, D the third differences of `count` coefficients, shape (6, count)."""
    from scipy.sparse import csr_array, diags_array

    third = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - PENALISED, count))  # pyright: ignore
    return _upper_bands(csr_array(third.T @ third))


def _ridge(data: np.ndarray, scale: float) -> np.ndarray:
    """Return bands that keep coefficients definite where a gap leaves them to the penalty alone."""
    bands = np.zeros_like(data)
    bands[-1] = 1e-10 * max(float(data[-1].max()), 1 / scale**2)
    return bands
