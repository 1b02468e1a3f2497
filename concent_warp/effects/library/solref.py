"""MuJoCo's two ways to state the spring and damper of a contact or limit: by time constant and ratio, or directly."""

from __future__ import annotations

import numpy as np

from concent_warp.effects.effect import Parameter

REBOUND_FACTORS = (0.6, 0.35, 0.2, 0.1)
"""Damping ratios over the model's that are tried with its stiffness: from a ball of clay to one that bounces well, the
share of the velocity that is left, exp(-pi r / sqrt(1 - r^2)), is never far from that of one of them [-]."""
DAMPED_FACTORS = (1.7, 3.0, 6.0)
"""The same above the model's."""


def compliance_parameters(time: float, ratio: float, timestep: float) -> tuple[Parameter, Parameter]:
    """Return time constant [s] and damping ratio [-] as parameters with these null values, for a time step [s]."""
    least, most = min(2 * timestep, time), max(0.2, 5 * time)
    low, high = min(0.02, 0.2 * ratio), max(5.0, 5 * ratio)
    # The damping ratio alone changes the stiffness, too, by its square: the model's time step does not resolve one
    # that bounces and has the time constant of one that does not. Along these lines the stiffness is the model's.
    lines = tuple(
        tuple((x, y) for f in line if least <= (x := time / f) <= most and low <= (y := ratio * f) <= high)
        for line in (REBOUND_FACTORS, DAMPED_FACTORS)
    )
    scan = (0.1 * ratio, 0.3 * ratio, 0.6 * ratio)
    return (
        Parameter("time_constant", "s", time, float(least), most, 0.5 * time, scan_together=lines),
        Parameter("damping_ratio", "-", ratio, low, high, 0.4, scan=scan),
    )


def as_time_and_ratio(direct: np.ndarray) -> np.ndarray:
    """Return time constant [s] and damping ratio of stiffness and damping, both shape (2,); infinite where undamped."""
    stiffness, damping = -direct
    if not (stiffness > 0 and damping > 0):
        return np.array([np.inf, 0.0])
    return np.array([2 / damping, damping / (2 * np.sqrt(stiffness))])


def scaled(solref: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Return constants, shape (n, 2), of which time constant and damping ratio are multiplied by factors (2,)."""
    direct = solref[:, :1] <= 0
    return solref * np.where(direct, [1 / np.prod(factor) ** 2, 1 / factor[0]], factor)
