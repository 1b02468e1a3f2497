"""Distillation by rsl-rl, as a baseline: the same student under rsl-rl's own `Distillation` algorithm.

The student drives from the first step on, with noise; each step of an iteration is learned from once, in its order, and
then forgotten. There is neither a buffer nor augmentation nor a prediction of poses.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import Distillation
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import nn

from concent_warp.train.distil.dagger import Dagger
from concent_warp.train.distil.network import StudentNetwork
from concent_warp.train.trials.episodes import PolicyFunction

IMAGES, OWN, STATE = "images", "proprioception", "policy"
"""Names of the observations of a step: of the student, and of the teacher."""
NOISE = 0.1
"""Standard deviation of the student's actions while it collects [-], as the default of rsl-rl's examples."""


class RslRlDagger(Dagger):
    """Trains a student as `Dagger` does, by rsl-rl's algorithm."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Create student and storage, see `Dagger`."""
        super().__init__(*arguments, **options)
        self._algorithm: Distillation | None = None

    def _collect(self, beta: float) -> None:
        """Take one step in all worlds."""
        del beta
        environment, started = self.environment, self._started
        parts = {
            IMAGES: self._look(started).clone(),
            OWN: self._proprioception.read(environment.observation).clone(),
            STATE: self._teacher_observation(),
        }
        observations = TensorDict(parts, batch_size=[environment.num_envs], device=self.device)
        algorithm = self._made(observations)
        self._taught = torch.zeros_like(self._taught)
        actions = algorithm.act(observations)
        _, rewards, dones, extras = environment.step(actions)
        algorithm.process_env_step(observations, rewards, dones, extras)
        self._count()

    def _learn(self) -> torch.Tensor:
        """Take the gradient steps of an iteration; return the losses of actions and of poses, shape (2,)."""
        algorithm = self._made(None)
        algorithm.train_mode()
        for group in algorithm.optimizer.param_groups:
            group["lr"] = self._rate()
        loss = float(algorithm.update()["behavior"])
        self.gradient_steps += self.cfg.dagger.updates  # the schedule's, whatever the number of passes
        return torch.tensor([loss, 0.0], device=self.device)

    def _latest_proprioception(self) -> torch.Tensor:
        """Return the proprioception of this iteration's samples, shape (M, P)."""
        kept: Any = self._made(None).storage.observations
        return kept[OWN].flatten(0, 1)

    def _made(self, example: TensorDict | None) -> Distillation:
        """Return the algorithm, made from the first observations."""
        if self._algorithm is None:
            assert example is not None
            d, n = self.cfg.dagger, self.environment.num_envs
            storage = RolloutStorage("distillation", n, d.steps, example, [self.environment.num_actions], self.device)
            self._algorithm = Distillation(
                _Student(self.network),  # pyright: ignore[reportArgumentType]
                _Teacher(self._teacher),  # pyright: ignore[reportArgumentType]
                storage,
                num_learning_epochs=max(1, round(d.updates / d.steps)),
                gradient_length=1,
                learning_rate=d.learning_rate,
                max_grad_norm=d.gradient,
                loss_type="huber",
                device=self.device,
                multi_gpu_cfg=self.process.rsl_rl(),
            )
            self._algorithm.optimizer = self._optimiser
        return self._algorithm


class _WithoutMemory(nn.Module):
    """What rsl-rl asks of models, for those without hidden state."""

    def reset(self, *arguments: Any, **options: Any) -> None:
        """Do nothing."""

    def detach_hidden_state(self, *arguments: Any) -> None:
        """Do nothing."""

    def get_hidden_state(self) -> None:
        """Return nothing."""

    def update_normalization(self, observations: TensorDict) -> None:
        """Do nothing."""


class _Student(_WithoutMemory):
    """The student's network as rsl-rl calls it."""

    def __init__(self, network: StudentNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, observations: TensorDict, stochastic_output: bool = False) -> torch.Tensor:
        """Return actions, shape (N, A)."""
        actions = self.network(observations[IMAGES].float() / 255, observations[OWN])
        return actions + NOISE * torch.randn_like(actions) if stochastic_output else actions


class _Teacher(_WithoutMemory):
    """The teacher as rsl-rl calls it."""

    def __init__(self, act: PolicyFunction) -> None:
        super().__init__()
        self._act = act

    def forward(self, observations: TensorDict) -> torch.Tensor:
        """Return actions, shape (N, A)."""
        return self._act(observations.select(STATE)).clamp(-1, 1)
