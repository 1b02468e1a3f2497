"""Success rate of a policy: one episode from each initial state, judged by the position of object 1 at its end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.train.environment.environment import Environment
from concent_warp.train.resets.sample import ResetStates
from concent_warp.train.trials.episodes import MISSED, SUCCESS, Episodes, PolicyFunction

Watch = Callable[[np.ndarray, np.ndarray], None]
"""Called with the indices (R,) of the running episodes and their positions (R, nq)."""


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
    """Whether an episode ended with object 1 in place, shape (E,) bool."""
    outcome: tuple[str, ...]
    """"success", "missed" after the time limit, or the failure "dropped", "severe" or "diverged", of each episode."""
    length: np.ndarray
    """Control steps of each episode, shape (E,) int."""
    stages: tuple[str, ...] = ()
    """Names of the stages of a chain, in order; empty if one stage was trained."""
    reached: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Number of stage targets that each episode met in order, shape (E,) int."""
    videos: tuple[Path, ...] = ()
    """Files of the videos."""
    recorded: Path | None = None
    """Recording of the trials; None where none were recorded."""

    @property
    def rate(self) -> float:
        """Success rate, 0..1."""
        return float(self.success.mean())

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the success rate."""
        return wilson(int(self.success.sum()), len(self.success))

    def counts(self) -> dict[str, int]:
        """Return the number of episodes by outcome."""
        return {name: self.outcome.count(name) for name in sorted(set(self.outcome))}

    @property
    def met(self) -> dict[str, int]:
        """Number of episodes that met a stage's target after those of all stages before it, by stage."""
        return {name: int((self.reached > k).sum()) for k, name in enumerate(self.stages)}

    def to_json(self) -> dict[str, Any]:
        """Return the evaluation as plain data."""
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
        """Return the result as a sentence."""
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
    """Run one episode from each initial state of an environment.

    Args:
        environment: The worlds.
        policy: From observations to actions, without exploration.
        states: The environment's initial states.
        progress: Called with the share done, 0..1.
        watch: Called before each step with the running episodes.
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
    """Return Wilson's interval of a proportion (Wilson, J. Am. Stat. Assoc. 22, 1927), 95 % by default."""
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    centre = share + z * z / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max((centre - spread) / scale, 0.0), min((centre + spread) / scale, 1.0)
