"""Robust losses: Huber's for residuals, Cauchy's for initial states.

Each comes with the weights of iteratively reweighted least squares (Holland and Welsch, Commun. Stat. 6, 1977): a
weight times its argument is the slope of the loss.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

HUBER = 4.0
"""Residual over the spread of the residuals beyond which Huber's loss is linear [-]."""
TRUSTED = 2.0
"""Scale of Cauchy's loss, in units of the initial state's spread [-]."""


def cauchy_cost(offset: np.ndarray) -> float:
    """Return the cost of an error of an initial state in units of its spread [-], by Cauchy's loss.

    It is half the square for small errors and grows logarithmically for large ones, as of states measured during an
    impact.
    """
    return float(0.5 * TRUSTED**2 * np.log1p((offset / TRUSTED) ** 2).sum())


def cauchy_weight(offset: np.ndarray) -> np.ndarray:
    """Return the weight of each component in iteratively reweighted least squares, see `cauchy_cost`."""
    return 1.0 / (1.0 + (offset / TRUSTED) ** 2)


def huber_limit(residuals: Sequence[np.ndarray]) -> float:
    """Return the residual from which Huber's loss is linear: `HUBER` times the spread, at least that of the noise."""
    pooled = np.concatenate(residuals)
    return HUBER * max(1.0, 1.4826 * float(np.median(np.abs(pooled))))


def huber(residual: np.ndarray, limit: float) -> np.ndarray:
    """Return Huber's loss, half the square up to `limit` and a straight line beyond."""
    size = np.abs(residual)
    return np.where(size <= limit, 0.5 * residual**2, limit * (size - 0.5 * limit))


def robust_noise_ratio(residuals: Sequence[np.ndarray]) -> float:
    """Return the root mean square of residuals in units of noise [-], those beyond `HUBER` with Huber's loss."""
    return float(np.sqrt(np.mean(2 * huber(np.concatenate(residuals), HUBER))))


def huber_weight(residual: np.ndarray, limit: float) -> np.ndarray:
    """Return the weights of iteratively reweighted least squares."""
    return np.minimum(1.0, limit / np.maximum(np.abs(residual), 1e-12))
