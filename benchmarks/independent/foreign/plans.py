"""Commands of drives, by parts."""

from __future__ import annotations

import numpy as np

RATE = 125.0
"""Rate of commands [Hz]."""


def ramp(start: float, end: float, speed: float) -> np.ndarray:
    """Return a straight line at a speed [unit/s], from start (excluded) to end."""
    count = max(1, round(abs(end - start) / speed * RATE))
    return start + (end - start) * np.arange(1, count + 1) / count


def rest(value: float, duration: float) -> np.ndarray:
    """Return a constant for a duration [s]."""
    return np.full(round(duration * RATE), value)


def cosine(start: float, end: float, duration: float) -> np.ndarray:
    """Return half a cosine from start to end in a duration [s]."""
    phase = np.arange(1, round(duration * RATE) + 1) / round(duration * RATE)
    return start + (end - start) * (1 - np.cos(np.pi * phase)) / 2


def tones(
    rng: np.random.Generator, centre: float, amplitude: float, low: float, high: float, duration: float
) -> np.ndarray:
    """Return a sum of five tones between two frequencies [Hz] that fades in and out."""
    t = np.arange(1, round(duration * RATE) + 1) / RATE
    frequencies = np.geomspace(low, high, 5) * rng.uniform(0.9, 1.1, 5)
    waves = np.sin(2 * np.pi * np.outer(t, frequencies) + rng.uniform(0, 2 * np.pi, 5)) / np.sqrt(frequencies)
    fade = np.clip(np.minimum(t, duration - t) / 0.4, 0, 1)
    return centre + amplitude * fade * waves.sum(axis=1) / np.abs(waves.sum(axis=1)).max()


def timed(*parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and values of commands one after the other, shapes (T,)."""
    value = np.concatenate(parts)
    return np.arange(len(value)) / RATE, value
