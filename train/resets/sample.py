"""Initial states along the demonstration that keep the contact chain (paper, section 3.2.1 and appendix D).

At a demonstrated time the robot grasps object 1 or not, and object 1 touches object 2 or not.

1. No grasp: robot joints and objects are displaced independently.
2. Object 1 is grasped: hand and object are displaced together; inverse kinematics gives the joints.
3. Object 1 is grasped and touches object 2: hand and both objects are displaced together.

For one stage, object 2 stays where it is fixed, and states between cases 2 and 3 are sampled: as demonstrated on object
2, or displaced and lifted off it. For a chain of stages, objects are placed anywhere, and states of the whole
demonstration are sampled (`ChainedResetSampler`).

States are discarded, and counted, if inverse kinematics fails, objects overlap, or the contact chain breaks while the
state settles.
"""

from __future__ import annotations

from collections.abc import Callable

from concent_warp.train.reset_cfg import ResetCfg
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
    """Return sampled initial states of the task's stage, or of all stages of a chain.

    Args:
        task: The task.
        cfg: Displacements and thresholds.
        seed: Seed.
        count: Number of states; `cfg.states` by default.
        device: Warp's name of the device for the inverse kinematics.
        progress: Called with the share done.

    Raises:
        TrainError: Too many of the sampled states were discarded.
    """
    sampler = ResetSampler if task.demonstrated is None else ChainedResetSampler
    return sampler(task, cfg, seed, device).sample(cfg.states if count is None else count, progress)
