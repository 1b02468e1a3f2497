"""How simulations of C MuJoCo run at the same time: in threads, or in processes where each step calls Python."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

from concent_warp.checks import Count

if TYPE_CHECKING:
    from concent_warp.simulate.engine import Variants
    from concent_warp.simulate.inputs import SimulationRun

T = TypeVar("T")
_limit: ContextVar[int | None] = ContextVar("limit of simulations at a time", default=None)


@dataclass(frozen=True)
class ProcessPoolCfg:
    """When simulations whose steps call Python are distributed over processes."""

    min_processes: Count = 3
    """Fewest processes that are started [-]: with two, sending data takes as long as is saved."""
    min_steps: int = 20_000
    """Fewest steps of all simulations together for which processes are started [-]: about one second in one thread."""

    def suits(self, processes: int, steps: int) -> bool:
        """Return whether processes are started for a number of steps of all simulations together."""
        return processes >= self.min_processes and steps >= self.min_steps


def simulations_at_a_time() -> int:
    """Return how many simulations an engine of C MuJoCo runs at a time by default: one a CPU, within the limit set."""
    return min(len(os.sched_getaffinity(0)), _limit.get() or 2**31)


@contextmanager
def limit_simulations(count: int | None) -> Iterator[None]:
    """Limit engines that are made within to `count` simulations at a time; None keeps the limit."""
    token = _limit.set(_limit.get() if count is None else max(count, 1))
    try:
        yield
    finally:
        _limit.reset(token)


def in_processes(
    work: Callable[[SimulationRun], list[T]], run: SimulationRun, rows: Sequence[int], count: int
) -> list[T]:
    """Return the results of `work` for some variants of a run, in their order, computed in `count` processes.

    The processes stay alive for the next call.
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
