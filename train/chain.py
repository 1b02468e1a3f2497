"""Stages one after the other: when a target event counts as met, and which stage a demonstrated moment belongs to.

Paper, section 3.2.1 and appendix B: every state of a stage is rewarded for its one target event. A world moves on to the
next stage when all contact pairs of its target have been within a tolerance for some steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from concent_warp.train.cfg import ChainCfg, TrainError

if TYPE_CHECKING:
    from concent_warp.train.task import Task


@dataclass(frozen=True)
class DemonstratedStages:
    """The stage that a world would be in, had it come along the demonstration."""

    stage: np.ndarray
    """Stage at each step, shape (K,) int."""
    start: dict[int, float]
    """Time at which each stage of the chain begins [s]."""
    end: dict[int, float]
    """Time until which states are taken from it [s]: to its target's fulfilment, in the last one to the target event."""


def demonstrated_stages(task: Task, cfg: ChainCfg, period: int) -> DemonstratedStages:
    """Return the stages of the demonstration by the rule by which worlds move on.

    Args:
        task: A task of several stages.
        cfg: The rule.
        period: Simulation steps between two checks.

    Raises:
        TrainError: The demonstration, as the model replays it, does not meet the target of a stage but the last.
    """
    m, replay = task.compiled, task.replay
    d = mujoco.MjData(m)
    count = len(replay.ctrl)
    stage = np.empty(count, dtype=int)
    now, held, closest = task.first, 0, np.inf
    start = {now: 0.0}
    for row in range(0, count, period):
        d.qpos[:] = replay.qpos[row]
        mujoco.mj_kinematics(m, d)
        distance = worst_distance(task, d, now)
        closest = min(closest, distance)
        held = held + 1 if distance < cfg.tolerance else 0
        stage[row : row + period] = now
        if held >= cfg.hold and now < task.stage:
            now, held, closest = now + 1, 0, np.inf
            start[now] = min(row + period, count) * replay.timestep
    if now < task.stage:
        raise TrainError(
            f"the replayed demonstration does not meet the target of stage {task.events.stages[now].name!r}",
            expected=f"all pairs within {cfg.tolerance * 1e3:g} mm for {cfg.hold} control steps",
            found=f"{closest * 1e3:.1f} mm at best",
            fix="allow more with --environment.chain.tolerance, or fit the model's contact geometry",
        )
    end = {s: start[s + 1] for s in range(task.first, task.stage)}
    end[task.stage] = max(task.events.stages[task.stage].event.time, start[task.stage])
    return DemonstratedStages(stage, start, end)


def worst_distance(task: Task, d: mujoco.MjData, stage: int) -> float:
    """Return the distance of the pair of a stage's target that is farthest apart [m]; `d` holds the poses."""
    table = task.table
    used = table.used[stage]

    def points(body: np.ndarray, local: np.ndarray) -> np.ndarray:
        return d.xpos[body] + np.einsum("kij,kj->ki", d.xmat[body].reshape(-1, 3, 3), local)

    a = points(table.body_a[stage][used], table.point_a[stage][used])
    b = points(table.body_b[stage][used], table.point_b[stage][used])
    return float(np.linalg.norm(a - b, axis=1).max(initial=0.0))
