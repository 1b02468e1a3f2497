"""Command profiles that excite hidden effects: sweeps at constant speed, chirps, slow reversals, constants."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

COMMAND_RATE = 100.0
"""Rate of the commands [Hz]."""


def hold(value: float, duration: float) -> np.ndarray:
    """Return a constant, for a duration [s]."""
    return np.full(max(1, round(duration * COMMAND_RATE)), value)


def sweep(start: float, end: float, speed: float) -> np.ndarray:
    """Return a line from start (excluded) to end at a speed [unit/s]."""
    count = max(1, round(abs(end - start) / speed * COMMAND_RATE))
    return start + (end - start) * np.arange(1, count + 1) / count


def minimum_jerk_profile(start: float, end: float, duration: float) -> np.ndarray:
    """Return a minimum-jerk path from start (excluded) to end in a duration [s]."""
    count = max(1, round(duration * COMMAND_RATE))
    s = np.arange(1, count + 1) / count
    return start + (end - start) * s**3 * (10 - 15 * s + 6 * s**2)


def chirp(centre: float, amplitude: float, low: float, high: float, duration: float) -> np.ndarray:
    """Return a swing whose frequency rises from low to high [Hz] in a duration [s]; it fades in and out."""
    t = np.arange(1, round(duration * COMMAND_RATE) + 1) / COMMAND_RATE
    phase = 2 * np.pi * (low * t + (high - low) * t**2 / (2 * duration))
    edge = np.minimum(1, np.minimum(t, duration - t) / 0.2)
    return centre + amplitude * edge * np.sin(phase)


def joined(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and values of one part after the other, shapes (T,)."""
    value = np.concatenate(parts)
    return np.arange(len(value)) / COMMAND_RATE, value
