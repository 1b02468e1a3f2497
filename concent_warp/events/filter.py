"""The chatter rule: what counts as one contact in time.

A resting or sliding contact of stiff spheres flickers from step to step. Per pair of bodies:

1. breaks shorter than `max_gap` between two touches are closed, then
2. contacts shorter than `min_contact_duration` are dropped.

In this order a flickering contact becomes one contact and an isolated tap is dropped. The robot's links count as pairs
of their own; a contact between two spheres, or a link and a sphere, has its breaks closed by the same rule and counts
only while the pair of bodies does.
"""

from __future__ import annotations

import numpy as np


def true_runs(touching: np.ndarray) -> np.ndarray:
    """Return the runs of True in `touching` (K,) as first and one-past-last step, shape (n, 2) int."""
    edges = np.diff(np.concatenate([[False], touching, [False]]).astype(np.int8))
    return np.stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)], axis=1)


def close_gaps(touching: np.ndarray, max_gap: int) -> np.ndarray:
    """Return `touching` (K,) with breaks of fewer than `max_gap` steps between two touches closed."""
    result = touching.copy()
    for start, end in true_runs(~touching):
        if start > 0 and end < len(touching) and end - start < max_gap:
            result[start:end] = True
    return result


def drop_short_contacts(touching: np.ndarray, shortest: int) -> np.ndarray:
    """Return `touching` (K,) without runs of fewer than `shortest` steps."""
    result = touching.copy()
    for start, end in true_runs(touching):
        if end - start < shortest:
            result[start:end] = False
    return result


def debounce(touching: np.ndarray, max_gap: int, shortest: int) -> np.ndarray:
    """Return `touching` (K,) without contact chatter, with `max_gap` and `shortest` in steps."""
    return drop_short_contacts(close_gaps(touching, max_gap), shortest)


def steps_of(duration: float, timestep: float) -> int:
    """Return the whole number of steps of `timestep` [s] nearest to a duration [s], at least 1."""
    return max(1, round(duration / timestep))


def window_sums(value: np.ndarray, width: int) -> np.ndarray:
    """Return the sum of `value` (K, ...) over centred windows of `width` steps, cut at the ends, same shape.

    Summed shift by shift and not by differences of a running total, so that windows without contact give exact zeros.
    """
    total = np.zeros(value.shape)
    for shift in range(-((width - 1) // 2), width // 2 + 1):
        low, high = max(0, -shift), len(value) - max(0, shift)
        if low < high:
            total[low:high] += value[low + shift : high + shift]
    return total
