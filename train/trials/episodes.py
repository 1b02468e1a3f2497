"""Episodes of a policy, step by step: what evaluation, live view, data sets and benchmarks have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict

from concent_warp.train.environment.environment import Environment

PolicyFunction = Callable[[TensorDict], torch.Tensor]
"""From observations to actions, shape (N, A), without exploration."""
SUCCESS, MISSED = "success", "missed"
"""Outcomes of an episode that ended with object 1 in place, and of one whose time was over without."""
FAILURES = ("dropped", "severe", "diverged")
"""Outcomes of failed episodes, in the order of `Environment.failure`."""


@dataclass(frozen=True)
class EpisodeStep:
    """What one control step did in N worlds."""

    command: np.ndarray
    """Commands that the step applied, shape (N, nu); of an episode that it ended, those of the step before."""
    outcome: Mapping[int, str]
    """Outcomes of the episodes that ended by this step, by world: `SUCCESS`, `MISSED` or one of `FAILURES`."""


class Episodes:
    """One episode in each of N worlds, under a policy; iterates over the control steps until all have ended.

    The state before a step is in the environment's physics. A world whose episode has ended begins another one there,
    which does not count.
    """

    def __init__(self, environment: Environment, policy: PolicyFunction, rows: Sequence[int] | np.ndarray) -> None:
        """Start an episode in every world.

        Args:
            environment: The worlds.
            policy: From observations to actions, without exploration.
            rows: Initial states of the environment, of which each world takes the next one; from the first again where
                they are fewer than N.
        """
        self._environment, self._policy = environment, policy
        environment.start_from([rows[k % len(rows)] for k in range(environment.num_envs)])
        self.running = np.ones(environment.num_envs, dtype=bool)
        """Whether the episode of a world is still running, shape (N,) bool."""
        self.length = 0
        """Control steps so far."""
        self._observation = environment.get_observations()
        self._command = self._commands()

    def __iter__(self) -> Iterator[EpisodeStep]:
        """Step until all episodes have ended."""
        while self.running.any():
            yield self.step()

    def step(self) -> EpisodeStep:
        """Act once in every world."""
        environment = self._environment
        with torch.inference_mode():
            self._observation, _, done, _ = environment.step(self._policy(self._observation))
        self.length += 1
        ended = done.cpu().numpy().astype(bool) & self.running
        command = self._commands()
        command[ended] = self._command[ended]  # those of the world are already of its next episode
        self._command, self.running = command, self.running & ~ended
        return EpisodeStep(command, self._outcomes(ended))

    def _commands(self) -> np.ndarray:
        """Return the present commands, shape (N, nu)."""
        return self._environment.physics.ctrl.detach().cpu().numpy().copy()

    def _outcomes(self, ended: np.ndarray) -> dict[int, str]:
        """Return the outcomes of the episodes of a mask (N,) bool, by world."""
        if not ended.any():
            return {}
        failure = self._environment.failure.cpu().numpy()
        success = self._environment.success.cpu().numpy()
        return {int(world): _outcome(success[world], failure[world]) for world in np.flatnonzero(ended)}


def _outcome(success: bool, failure: np.ndarray) -> str:
    """Return the outcome of an episode from what `Environment` says of its last step; `failure` has shape (3,)."""
    if failure.any():
        return FAILURES[int(failure.argmax())]
    return SUCCESS if success else MISSED
