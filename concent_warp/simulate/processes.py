"""Simulations in processes of their own: where each step calls Python, threads would wait for one another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

if TYPE_CHECKING:
    from concent_warp.simulate.engine import Variants
    from concent_warp.simulate.inputs import SimulationRun

T = TypeVar("T")
FEWEST = 3
"""Processes from which on it pays: what they are sent and send back takes its time as well."""
WORTH = 20_000
"""Steps, of all simulations together, from which on it pays to hand them over: they take a second in one thread."""


def in_processes(
    work: Callable[[SimulationRun], list[T]], run: SimulationRun, rows: Sequence[int], count: int
) -> list[T]:
    """Return what `work` finds for some variants of a run, in their order, shared among `count` processes.

    The processes stay for a while, for the next time.
    """
    from joblib import Parallel, delayed

    parts = np.array_split(np.asarray(rows), min(count, len(rows)))
    found = Parallel(n_jobs=count, backend="loky")(delayed(work)(_part_of(run, part)) for part in parts)
    return [result for part in cast("list[list[T]]", found) for result in part]


def _part_of(run: SimulationRun, rows: np.ndarray) -> SimulationRun:
    """Return a run of some of its variants."""
    return replace(run, variants=_some(run.variants, rows), ctrl=run.ctrl[rows % len(run.ctrl)])


def _some(variants: Variants, rows: np.ndarray) -> Variants:
    """Return some of the variants."""
    arrays = {
        f.name: getattr(variants, f.name) for f in fields(variants) if f.name not in ("count", "fields", "force_models")
    }
    return replace(
        variants,
        count=len(rows),
        fields={name: value[rows] for name, value in variants.fields.items()},
        force_models=None
        if variants.force_models is None
        else tuple((force_model, values[rows]) for force_model, values in variants.force_models),
        **{name: None if value is None else value[rows] for name, value in arrays.items()},
    )
