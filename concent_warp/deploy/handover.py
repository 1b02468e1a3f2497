"""Episodes that one policy begins and another one, the teacher, ends: data of how to recover.

A policy that imitates drifts to states that its teacher never was in. Here it drives first, for a random time, and the
teacher shows how to go on from where it has got to (Ross et al., AISTATS 2011; Kelly et al., ICRA 2019).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict

from concent_warp.deploy.cfg import HandoverCfg
from concent_warp.render.filming import DatasetFilming
from concent_warp.train.environment.environment import Environment
from concent_warp.train.trials.branches import branched_commands
from concent_warp.train.trials.episodes import PolicyFunction

STREAM = 7
"""Tells the random numbers of hand-overs from others of the same seed."""


class Handover:
    """Who drives in each of N worlds: the driver until the hand-over, then the teacher."""

    def __init__(
        self, environment: Environment, driver: PolicyFunction, teacher: PolicyFunction, cfg: HandoverCfg, seed: int
    ) -> None:
        """Keep the policies.

        Args:
            environment: The worlds.
            driver: Acts until the hand-over.
            teacher: Acts from then on.
            cfg: When that is.
            seed: Seed of the times.
        """
        self._environment, self._driver, self._teacher, self._cfg = environment, driver, teacher, cfg
        self._labels: np.ndarray | None = None
        self._seed = seed
        self._step = np.zeros(environment.num_envs, dtype=int)
        self._driving = np.zeros(environment.num_envs, dtype=bool)

    def begin(self, episodes: Sequence[int]) -> None:
        """Sample the steps of the hand-overs in episodes of these numbers, the same for the same number and seed."""
        low, high = (round(time / self._environment.control_step) for time in self._cfg.time)
        for world, episode in enumerate(episodes):
            self._step[world] = np.random.default_rng([self._seed, STREAM, episode]).integers(low, high + 1)

    def act(self, observation: TensorDict) -> torch.Tensor:
        """Return actions, shape (N, A): the driver's where it still drives."""
        self._driving = self._environment.episode_length_buf.cpu().numpy() < self._step
        self._labels = None
        if self._cfg.frames == "labelled" and self._driving.any():
            self._labels = branched_commands(self._environment, self._teacher, self._cfg.chunk).cpu().numpy()
        action = self._teacher(observation)
        if not self._driving.any():
            return action
        driven = self._driver(observation).to(action.device)
        return torch.where(torch.as_tensor(self._driving, device=action.device)[:, None], driven, action)

    def is_recorded(self, world: int) -> bool:
        """Return whether the present frame of a world is for the data set: those of the teacher, or all."""
        return self._cfg.frames != "teacher" or not self._driving[world]

    def label(self, world: int) -> np.ndarray | None:
        """Return what the teacher would command from the present frame of a world on, shape (C, nu).

        None where it drives itself, and where no labels are asked for.
        """
        return self._labels[world] if self._labels is not None and self._driving[world] else None

    def has_taken_over(self, world: int) -> bool:
        """Return whether the teacher drives in a world."""
        return not self._driving[world]


class FilmedImages:
    """Images of a data set that is being filmed, for a policy in its worlds: an `ImageSource` of `train.distil`."""

    def __init__(self, filming: DatasetFilming) -> None:
        """Keep what films."""
        self.cameras, self.size = filming.camera.cameras, filming.camera.size[0]
        self._filming = filming

    def begin(self, which: torch.Tensor) -> None:
        """Do nothing: episodes begin with those of the data set."""
        del which

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return the frame that was filmed last, uint8, shape (N, C, 3, size, size)."""
        del qpos, mocap
        return torch.from_numpy(self._filming.images).permute(0, 1, 4, 2, 3)

    def state(self) -> dict[str, torch.Tensor]:
        """Return nothing: an episode that was interrupted is filmed anew."""
        return {}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Do nothing."""
        del state
