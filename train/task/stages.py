"""Stages of a chain: when a target event is met, and to which stage a demonstrated time belongs.

Every state of a stage is rewarded for its one target event (paper, section 3.2.1 and appendix B). The next stage
follows when all contact pairs of the target have been within a tolerance for some steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import TrainError
from concent_warp.events.sequence import Stage
from concent_warp.kernels.contact_pairs import PairTable
from concent_warp.train.cfg import ChainCfg


@dataclass(frozen=True)
class DemonstratedStages:
    """Stages along the demonstration, by the rule that advances the worlds."""

    stage: np.ndarray
    """Stage at each step, shape (K,) int."""
    start: dict[int, float]
    """Time at which each stage begins [s]."""
    end: dict[int, float]
    """End of the time from which its states are sampled [s]: its target is met; in the last stage, the target event."""


def demonstrated_stages(
    m: mujoco.MjModel,
    table: PairTable,
    stages: Sequence[Stage],
    qpos: np.ndarray,
    timestep: float,
    cfg: ChainCfg,
    period: int,
) -> DemonstratedStages:
    """Return the stages along a demonstration, by the rule that advances the worlds.

    Args:
        m: Compiled model.
        table: Contact pairs of the stages.
        stages: All stages in order.
        qpos: Positions of the replayed demonstration, shape (K + 1, nq).
        timestep: Time between them [s].
        cfg: The rule.
        period: Simulation steps between two checks.

    Raises:
        TrainError: The replay does not meet the target of a stage but the last.
    """
    d = mujoco.MjData(m)
    count, last = len(qpos) - 1, len(stages) - 1
    stage = np.empty(count, dtype=int)
    now, steps_within, closest = 0, 0, np.inf
    start = {now: 0.0}
    for row in range(0, count, period):
        d.qpos[:] = qpos[row]
        mujoco.mj_kinematics(m, d)
        distance = _worst_distance(table, d, now)
        closest = min(closest, distance)
        steps_within = steps_within + 1 if distance < cfg.tolerance else 0
        stage[row : row + period] = now
        if steps_within >= cfg.hold and now < last:
            now, steps_within, closest = now + 1, 0, np.inf
            start[now] = min(row + period, count) * timestep
    if now < last:
        raise TrainError(
            f"the replayed demonstration does not meet the target of stage {stages[now].name!r}",
            expected=f"all pairs within {cfg.tolerance * 1e3:g} mm for {cfg.hold} control steps",
            found=f"{closest * 1e3:.1f} mm at best",
            fix="raise --environment.chain.tolerance, or fit the model's contact geometry",
        )
    end = {s: start[s + 1] for s in range(last)}
    end[last] = max(stages[last].event.time, start[last])
    return DemonstratedStages(stage, start, end)


def _worst_distance(table: PairTable, d: mujoco.MjData, stage: int) -> float:
    """Return the largest distance of the contact pairs of a stage's target [m] at the poses of `d`."""
    used = table.used[stage]

    def points(body: np.ndarray, local: np.ndarray) -> np.ndarray:
        return d.xpos[body] + np.einsum("kij,kj->ki", d.xmat[body].reshape(-1, 3, 3), local)

    a = points(table.body_a[stage][used], table.point_a[stage][used])
    b = points(table.body_b[stage][used], table.point_b[stage][used])
    return float(np.linalg.norm(a - b, axis=1).max(initial=0.0))
