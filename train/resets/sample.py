"""Initial states along the demonstration that keep the contact chain (paper, section 3.2.1 and appendix D).

At a demonstrated moment the robot holds object 1 or does not, and object 1 touches object 2 or does not.

1. No hand on an object: robot joints and objects are displaced each by themselves.
2. Object 1 in the hand: both are moved as one, and inverse kinematics finds the joints.
3. Object 1 in the hand and on object 2: all three move as one.

Where one stage is trained, object 2 stays where it is fixed, and states between cases 2 and 3 are drawn: as
demonstrated on object 2, or displaced, and lifted off it. Where stages are chained, objects stand anywhere, and all
moments of the demonstration are drawn from (`ChainedResetSampler`).

States whose inverse kinematics fails, whose displacement makes objects overlap, or whose chain breaks while they settle
are discarded, and counted.
"""

from __future__ import annotations

from collections.abc import Callable

from concent_warp.train.cfg import ResetCfg
from concent_warp.train.resets.chained import ChainedResetSampler
from concent_warp.train.resets.reset_states import ResetSampler, ResetStates
from concent_warp.train.task.task import Task

__all__ = ["ResetStates", "sample_reset_states"]


def sample_reset_states(
    task: Task,
    cfg: ResetCfg,
    seed: int,
    *,
    count: int | None = None,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> ResetStates:
    """Draw initial states of the task's stage, or of all its stages.

    Args:
        task: The task.
        cfg: How far states are displaced, and what is discarded.
        seed: Seed.
        count: States wanted; those of the settings by default.
        device: Warp's name of the device for the inverse kinematics.
        progress: Called with the share done.

    Raises:
        TrainError: Too few of the states drawn can be used.
    """
    drawing = ResetSampler if task.demonstrated is None else ChainedResetSampler
    return drawing(task, cfg, seed, device).states(cfg.states if count is None else count, progress)
