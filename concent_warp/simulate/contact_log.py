"""The one order of a contact log, whatever order the engine found the contacts in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from concent_warp.simulate.engine import ContactLog


def sorted_log(variant: np.ndarray, step: np.ndarray, rows: np.ndarray) -> ContactLog:
    """Return a log ordered by variant, step, geom pair, distance and position.

    Args:
        variant: Variant index, shape (C,) int.
        step: Simulation step, shape (C,) int.
        rows: Geom ids (2), the smaller first, position [m] (3), normal (3), distance [m] and force [N] (3), shape
            (C, 12).
    """
    order = np.lexsort((rows[:, 4], rows[:, 3], rows[:, 2], rows[:, 8], rows[:, 1], rows[:, 0], step, variant))
    rows = rows[order]
    return ContactLog(
        variant=variant[order],
        step=step[order],
        geom=rows[:, :2].astype(int),
        position=rows[:, 2:5],
        normal=rows[:, 5:8],
        distance=rows[:, 8],
        force=rows[:, 9:12],
    )


def collect(logs: Sequence[Sequence[tuple[int, np.ndarray]]]) -> ContactLog:
    """Join the contacts of all variants, ordered by variant, step, geom pair, distance and position."""
    parts = [(n, step, rows) for n, log in enumerate(logs) for step, rows in log]
    rows = np.concatenate([np.zeros((0, 12)), *(r for _, _, r in parts)])
    sizes = [len(r) for _, _, r in parts]
    variant = np.repeat(np.array([n for n, _, _ in parts], dtype=int), sizes)
    step = np.repeat(np.array([s for _, s, _ in parts], dtype=int), sizes)
    return sorted_log(variant, step, rows)
