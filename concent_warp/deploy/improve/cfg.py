"""Settings of rounds of improvement; this module imports no heavy packages."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from concent_warp.checks import Count, Share, Worlds
from concent_warp.deploy.cfg import EvaluateCfg
from concent_warp.deploy.explain.cfg import ExplainCfg

ImproveWorld = Literal["robot", "reality"]
"""Where trials take place: on a robot, whose recordings are given, or in Reality."""


@dataclass(frozen=True)
class ImproveCfg:
    """Settings of rounds of improvement.

    Example:
        >>> import concent_warp as cw
        >>> cw.ImproveCfg(rounds=2, iterations=100).target
        0.95
    """

    rounds: Count = 3
    """Most rounds: trials are explained and the policy is trained on in each, and tried again after the last."""
    target: Share = 0.95
    """Success rate of trials at which it ends."""
    episodes: Count = 60
    """Trials of each round in Reality."""
    iterations: Count | None = None
    """Iterations of PPO of each round; by default as many as the given policy was trained for."""
    worlds: Worlds | None = None
    """Parallel environments; by default as many as the given policy was trained in."""
    fit_trials: Count = 4
    """Failed trials to which the effects of the model are fitted, where none is found in free motion; the effect is
    searched for in fewer, see `ExplainCfg.diagnose_trials`."""
    min_fall: Share = 0.05
    """Share of the squared residual that a fit of the model's own effects must explain where no new one is missing [-]:
    less is no reason to train again."""
    seed: int = 0
    """Seed; trainings and trials of a round have this and its number."""
    explain: ExplainCfg = field(default_factory=ExplainCfg)
    """Explanation of the failed trials."""
    evaluate: EvaluateCfg = field(default_factory=EvaluateCfg)
    """Trials in Reality; the scales of commands also hold for those of a robot."""
