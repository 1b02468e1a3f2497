"""The one order of a contact log, whatever order the engine found the contacts in."""

from __future__ import annotations

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
