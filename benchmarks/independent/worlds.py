"""All data sets of both worlds, and how to make them.

A world on MuJoCo is in `mujoco_sets` and `mujoco_world`. That on Drake is in `drake_world`, which has

    def drake_sets() -> list[DataSet]   # does not import Drake
    def make_drake(case: DataSet) -> Data
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

from benchmarks.independent.data_set import Data, DataSet

DRAKE = "benchmarks.independent.drake_world"


def all_sets() -> list[DataSet]:
    """Return the data sets of both worlds, in a fixed order, with names that differ."""
    from benchmarks.independent.mujoco_sets import mujoco_sets

    found = mujoco_sets()
    if find_spec(DRAKE) is not None:
        found += import_module(DRAKE).drake_sets()
    return found


def make(case: DataSet) -> Data:
    """Return the recordings of a data set, the user's scene, and the truth."""
    if case.world == "drake":
        return import_module(DRAKE).make_drake(case)
    from benchmarks.independent.mujoco_world import make_mujoco

    return make_mujoco(case)
