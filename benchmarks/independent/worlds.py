"""All data sets of all worlds, and how to make them.

A world on MuJoCo is in `mujoco_sets` and `mujoco_world`, one on Drake in `drake_world`, one on Bullet in
`bullet_world`; the lists of sets import neither Drake nor Bullet.
"""

from __future__ import annotations

from benchmarks.independent.bullet_world import bullet_sets, make_bullet
from benchmarks.independent.data_set import Data, DataSet
from benchmarks.independent.drake_world import drake_sets, make_drake
from benchmarks.independent.mujoco_sets import mujoco_sets


def all_sets() -> list[DataSet]:
    """Return the data sets of all worlds, in a fixed order, with names that differ."""
    return [*mujoco_sets(), *drake_sets(), *bullet_sets()]


def make(case: DataSet) -> Data:
    """Return the recordings of a data set, the user's scene, and the truth."""
    if case.world == "drake":
        return make_drake(case)
    if case.world == "bullet":
        return make_bullet(case)
    from benchmarks.independent.mujoco_world import make_mujoco

    return make_mujoco(case)
