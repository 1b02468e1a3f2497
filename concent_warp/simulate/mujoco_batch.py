"""Several variants of a model in one call of `mujoco.rollout`: what a variant costs besides its steps is paid once.

Simulations of a fit are short, and making a model and its data for each takes as long as some hundred steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.checks import Count
from concent_warp.simulate.mujoco_steps import VariantResult

if TYPE_CHECKING:
    from concent_warp.simulate.inputs import SimulationRun

EXTRA_STEPS = 2
"""Steps beyond those asked for [-]: the first gives the sensors of the last state, the second shows whether the first
raised a warning."""


@dataclass(frozen=True)
class BatchCfg:
    """How variants are distributed over calls."""

    max_variants: Count = 64
    """Most variants of one call [-]; each may have a model of its own in memory."""
    max_steps: Count = 200_000
    """Most steps of one call [-], but for those of one variant: about a second, after which the process reacts to an
    interrupt again."""
    calls_per_thread: Count = 4
    """Least calls for each thread where there are several [-], so that none waits long for another."""

    def parts(self, rows: Sequence[int], steps: int, threads: int) -> list[list[int]]:
        """Return variants in parts, one for each call."""
        size = min(self.max_variants, max(self.max_steps // max(steps, 1), 1))
        if threads > 1:
            size = min(size, -(-len(rows) // (threads * self.calls_per_thread)))
        return [list(rows[i : i + size]) for i in range(0, len(rows), size)]


def distinct(rows: Sequence[int], arrays: Sequence[np.ndarray]) -> list[int]:
    """Return for each of some rows of arrays (N, ...) the first of these rows that is equal to it in all of them."""
    first: dict[bytes, int] = {}
    return [first.setdefault(b"".join(a[n].tobytes() for a in arrays), n) for n in rows]


def simulate_batch(
    models: Sequence[mujoco.MjModel], d: mujoco.MjData, run: SimulationRun, rows: Sequence[int]
) -> list[VariantResult | None]:
    """Simulate some variants as `mujoco_steps.simulate_in_one_call` does one; None for those with warnings.

    Args:
        models: Model of each.
        d: Data of such a model, overwritten.
        run: What is asked for.
        rows: Indices of the variants.
    """
    from mujoco import rollout

    m, steps, count = models[0], run.steps + EXTRA_STEPS, len(rows)
    start = np.zeros((count, 1 + m.nq + m.nv))
    given = run.variants.qpos
    start[:, 1 : 1 + m.nq] = [model.qpos0 for model in models] if given is None else given[rows]
    if run.variants.qvel is not None:
        start[:, 1 + m.nq :] = run.variants.qvel[rows]
    ctrl = None
    if m.nu:
        ctrl = np.empty((count, steps, m.nu))
        ctrl[:, : run.steps] = run.ctrl[np.asarray(rows) % len(run.ctrl)]
        ctrl[:, run.steps :] = ctrl[:, run.steps - 1 : run.steps]
    state, sensordata = np.empty((count, steps, start.shape[1])), np.empty((count, steps, m.nsensordata))
    mujoco.mj_resetData(m, d)
    try:
        rollout.Rollout(nthread=0).rollout(
            list(models), [d], start, ctrl, skip_checks=True, nstep=steps, state=state, sensordata=sensordata
        )
    except mujoco.FatalError:  # of one of them; each by itself tells of which
        return [None] * count
    # After a warning, states are repeated.
    sane = state[:, -1, 0] > state[:, -2, 0]
    before = np.maximum(run.record - 1, 0)
    found: list[VariantResult | None] = []
    for i in range(count):
        if not sane[i]:
            found.append(None)
            continue
        result = VariantResult.empty(m, run)
        result.qpos, result.qvel = state[i, before, 1 : 1 + m.nq], state[i, before, 1 + m.nq :]
        first = run.record == 0
        result.qpos[first], result.qvel[first] = start[i, 1 : 1 + m.nq], start[i, 1 + m.nq :]
        result.sensordata = sensordata[i, run.record]
        found.append(result)
    return found
