"""Robust losses: Huber's for residuals, Cauchy's for initial states.

Each comes with the weights of iteratively reweighted least squares (Holland and Welsch, Commun. Stat. 6, 1977): a
weight times its argument is the slope of the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.checks import Positive


@dataclass(frozen=True)
class RobustLossCfg:
    """Scales of the robust losses."""

    residual_limit: Positive = 4.0
    """Residual over the spread of the residuals beyond which Huber's loss is linear [-]: of normal noise, 6 samples in
    100 000 are beyond."""
    state_scale: Positive = 2.0
    """Scale of Cauchy's loss of an error of an initial state, in units of the state's spread [-]: near the 2.39 with 95
    % efficiency under normal noise (Holland and Welsch, 1977)."""


def cauchy_cost(offset: np.ndarray, cfg: RobustLossCfg | None = None) -> float:
    """Return the cost of an error of an initial state in units of its spread [-], by Cauchy's loss.

    It is half the square for small errors and grows logarithmically for large ones, as of states measured during an
    impact.
    """
    scale = (cfg or RobustLossCfg()).state_scale
    return float(0.5 * scale**2 * np.log1p((offset / scale) ** 2).sum())


def cauchy_weight(offset: np.ndarray, cfg: RobustLossCfg | None = None) -> np.ndarray:
    """Return the weight of each component in iteratively reweighted least squares, see `cauchy_cost`."""
    return 1.0 / (1.0 + (offset / (cfg or RobustLossCfg()).state_scale) ** 2)


def huber_limit(residuals: Sequence[np.ndarray], cfg: RobustLossCfg | None = None) -> float:
    """Return the residual beyond which Huber's loss is linear: `residual_limit` times the spread, at least the noise.

    The spread is estimated by 1.4826 times the median absolute residual.
    """
    pooled = np.concatenate(residuals)
    return (cfg or RobustLossCfg()).residual_limit * max(1.0, 1.4826 * float(np.median(np.abs(pooled))))


def huber(residual: np.ndarray, limit: float) -> np.ndarray:
    """Return Huber's loss, half the square up to `limit` and a straight line beyond."""
    size = np.abs(residual)
    return np.where(size <= limit, 0.5 * residual**2, limit * (size - 0.5 * limit))


def robust_noise_ratio(residuals: Sequence[np.ndarray], cfg: RobustLossCfg | None = None) -> float:
    """Return the RMS of residuals in units of noise [-], those beyond `residual_limit` with Huber's loss."""
    return float(np.sqrt(np.mean(2 * huber(np.concatenate(residuals), (cfg or RobustLossCfg()).residual_limit))))


def huber_weight(residual: np.ndarray, limit: float) -> np.ndarray:
    """Return the weights of iteratively reweighted least squares."""
    return np.minimum(1.0, limit / np.maximum(np.abs(residual), 1e-12))
