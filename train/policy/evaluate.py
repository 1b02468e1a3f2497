"""How often a policy succeeds: one episode from each initial state, judged by geometry at its end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.train.environment.environment import Environment
from concent_warp.train.policy.episodes import MISSED, SUCCESS, Episodes, PolicyFunction
from concent_warp.train.resets.sample import ResetStates

Watch = Callable[[np.ndarray, np.ndarray], None]
"""Takes the episodes that are running, ids (R,) int, and their positions (R, nq)."""


@dataclass(frozen=True)
class Evaluation:
    """Outcomes of E episodes.

    Example:
        >>> import concent_warp as cw
        >>> result = cw.evaluate(cw.load_policy("shape_sorter"), world="simulation", episodes=2, device="cpu")
        >>> result.counts()
        {'success': 2}
    """

    success: np.ndarray
    """Whether each ended with object 1 in place, shape (E,) bool."""
    outcome: tuple[str, ...]
    """"success", "missed" where time was up, or what made it fail."""
    length: np.ndarray
    """Steps of each, shape (E,) int."""
    stages: tuple[str, ...] = ()
    """Stages whose targets were to be met, in their order; none where a single one was trained."""
    reached: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """How many of the targets each episode met, in their order, shape (E,) int."""
    videos: tuple[Path, ...] = ()
    """Videos that were written."""

    @property
    def rate(self) -> float:
        """Share of successes."""
        return float(self.success.mean())

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share."""
        return wilson(int(self.success.sum()), len(self.success))

    def counts(self) -> dict[str, int]:
        """Return how many episodes came to each outcome."""
        return {name: self.outcome.count(name) for name in sorted(set(self.outcome))}

    @property
    def met(self) -> dict[str, int]:
        """How many episodes met each stage's target, and those of all stages before it."""
        return {name: int((self.reached > k).sum()) for k, name in enumerate(self.stages)}

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {
            "episodes": len(self.success),
            "successes": int(self.success.sum()),
            "rate": self.rate,
            "interval": list(self.interval),
            "outcomes": list(self.outcome),
            "steps": self.length.tolist(),
            "stages met": [{"stage": name, "episodes": count} for name, count in self.met.items()],
        }

    def sentence(self) -> str:
        """Return the result in words."""
        low, high = self.interval
        others = ", ".join(f"{count} {name}" for name, count in self.counts().items() if name != "success")
        text = f"{int(self.success.sum())} of {len(self.success)} succeed: {self.rate:.1%} ({low:.1%} to {high:.1%})"
        text = f"{text}; {others}" if others else text
        met = ", ".join(f"{name} {count / len(self.success):.1%}" for name, count in self.met.items())
        return f"{text}; stage targets met in order: {met}" if met else text


def run_episodes(
    environment: Environment,
    policy: PolicyFunction,
    states: ResetStates,
    *,
    progress: Callable[[float], None] | None = None,
    watch: Watch | None = None,
) -> Evaluation:
    """Run one episode from each of the states that an environment was made with.

    Args:
        environment: The worlds.
        policy: From observations to actions, without exploration.
        states: The environment's initial states.
        progress: Called with the share done.
        watch: Called before each step with what is there.
    """
    count, worlds = len(states.qpos), environment.num_envs
    success, length = np.zeros(count, dtype=bool), np.zeros(count, dtype=int)
    outcome, reached = [MISSED] * count, np.zeros(count, dtype=int)
    longest = int(environment.max_episode_length)
    for first in range(0, count, worlds):
        counted = first + np.arange(worlds) < count
        episodes = Episodes(environment, policy, (first + np.arange(worlds)) % count)
        while episodes.running.any():
            if watch is not None:
                watched = np.flatnonzero(episodes.running & counted)
                watch(first + watched, environment.physics.qpos.cpu().numpy()[watched])
            for world, how in episodes.step().outcome.items():
                if counted[world]:
                    row = first + world
                    success[row], outcome[row] = how == SUCCESS, how
                    length[row], reached[row] = episodes.length, int(environment.reached[world])
            if progress is not None:
                progress((first + worlds * episodes.length / longest) / (math.ceil(count / worlds) * worlds))
    task = environment.task
    stages = tuple(task.events.stages[s].name for s in task.chained) if len(task.chained) > 1 else ()
    return Evaluation(success, tuple(outcome), length, stages, reached)


def wilson(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """Return Wilson's interval of a share (Wilson, J. Am. Stat. Assoc. 22, 1927), 95 % by default."""
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    centre = share + z * z / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max((centre - spread) / scale, 0.0), min((centre + spread) / scale, 1.0)
