"""Position-controlled drives of the worlds on other engines: their setpoints, and the friction of their joints."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from benchmarks.independent.foreign.rig import DriveState, Friction

CONTROL_PERIOD = 1e-3
"""Period of the drives' controllers [s]."""
RECORD_PERIOD = 5e-4
"""Spacing of the recorded true motion [s]."""
GEAR_DAMPING = 0.05
"""Damping ratio of gears, of the rotor on the spring [-]."""


class Bristle:
    """LuGre friction of one joint, its bristle integrated exactly over steps of constant velocity."""

    def __init__(self, friction: Friction, dt: float):
        self.friction, self.dt = friction, dt
        self.deflection = 0.0

    def force(self, time: float, speed: float) -> float:
        """Return the friction [N m or N] against a speed, over one step."""
        f = self.friction
        level = (f.coulomb + f.extra * np.exp(-((speed / f.speed) ** 2))) * f.scale(time)
        most = max(f.coulomb + f.extra, 1e-12)
        stiffness = most / f.bristle
        slack = level / stiffness  # deflection in steady sliding
        pace = abs(speed)
        before = self.deflection
        if slack <= 0:
            self.deflection = 0.0
        elif pace > 0:
            keep = np.exp(-pace * self.dt / slack)
            self.deflection = np.sign(speed) * slack * (1 - keep) + before * keep
        damping = 2e-3 * stiffness  # bristles come to rest within a few ms
        return stiffness * self.deflection + damping * (self.deflection - before)


def setpoints(time: np.ndarray, value: np.ndarray, ticks: np.ndarray, state: DriveState) -> np.ndarray:
    """Return what a drive controls towards at its ticks [s], shape (N,), given commands (T,)."""
    row = np.searchsorted(time, ticks - state.delay + 1e-9, side="right") - 1
    held = value[np.maximum(row, 0)]
    if not state.lag:
        return held
    share = 1 - np.exp(-CONTROL_PERIOD / state.lag)
    return np.asarray(lfilter([share], [1, share - 1], held - held[0])) + held[0]
