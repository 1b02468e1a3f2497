"""Episodes of a policy, step by step, for those who look on: images, say, for a data set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from concent_warp.train.environment.environment import Environment
from concent_warp.train.policy.evaluate import PolicyFunction


@dataclass(frozen=True)
class Step:
    """What has happened in N worlds since they were looked at."""

    command: np.ndarray
    """What was commanded, shape (N, nu)."""
    ended: np.ndarray
    """Whether the episode ended by it, shape (N,) bool."""
    success: np.ndarray
    """Whether it ended in success, shape (N,) bool."""


def start(environment: Environment, rows: Sequence[int]) -> None:
    """Start an episode in every world from the initial states of these rows, as many as are needed of them in turn."""
    worlds = environment.num_envs
    environment.start_from([rows[k % len(rows)] for k in range(worlds)])


def steps(environment: Environment, policy: PolicyFunction) -> Iterator[Step]:
    """Act for as long as the longest episode lasts; look at the worlds' states before each step is asked for.

    A world whose episode has ended begins another one, which is nobody's.
    """
    worlds = environment.num_envs
    before = environment.physics.ctrl.detach().cpu().numpy().copy()
    open_ = np.ones(worlds, dtype=bool)
    for k in range(int(environment.max_episode_length)):
        with torch.inference_mode():
            _, _, done, _ = environment.step(policy(environment.get_observations()))
        ended = done.cpu().numpy().astype(bool) & open_
        if k == int(environment.max_episode_length) - 1:
            ended = open_.copy()
        failed = environment.failure.cpu().numpy().any(axis=1)
        command = environment.physics.ctrl.detach().cpu().numpy().copy()
        # The commands of a world that has begun anew are those of its next episode.
        command[ended] = before[ended]
        yield Step(command, ended, ended & environment.success.cpu().numpy().astype(bool) & ~failed)
        before = command
        open_ &= ~ended
        if not open_.any():
            return
