"""Residuals over the measurement noise: what "x noise" means in every table, report and diagnosis.

The ratio is the root mean square residual over the standard deviation of the measurement noise, per component. It is 1
where a model leaves nothing but noise, and squared it is the chi-square statistic per reading.
"""

from __future__ import annotations

import numpy as np


def noise_ratio(residual: np.ndarray, noise: float = 1.0) -> float:
    """Return the root mean square residual over the noise [-]; 1 where only noise is left.

    Args:
        residual: Residuals of any shape: components, or lengths of residual vectors; rows with NaN are left out.
        noise: Root mean square that noise alone leaves of them, in the same unit (`rms_noise` for lengths of vectors).

    Returns:
        NaN without any residual, infinite where one is infinite.
    """
    values = residual[~np.isnan(residual)]
    if not values.size:
        return np.nan
    return float(np.sqrt(np.mean(values**2))) / noise if np.isfinite(values).all() else np.inf


def rms_noise(std: float, dim: int) -> float:
    """Return the root mean square length of a vector of `dim` components of noise with standard deviation `std`."""
    return float(std * np.sqrt(dim))
