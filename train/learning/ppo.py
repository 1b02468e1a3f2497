"""PPO through rsl-rl: training that can be stopped at any time and gone on with exactly."""

from __future__ import annotations

import contextlib
import io
import random
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict

from concent_warp.errors import TrainError
from concent_warp.train.cfg import PpoCfg, TrainCfg
from concent_warp.train.learning.distributed import Ranks
from concent_warp.train.learning.distribution import SquashedGaussian
from concent_warp.train.learning.metrics import curve
from concent_warp.train.learning.normalisation import bound_observations

CHECKPOINT = "checkpoint.pt"
"""File of the latest state of a training in its run folder."""
DIVERGED_STATE_FILE = "diverged.npz"
"""File of the first state from which a world diverged."""


Total = Callable[[torch.Tensor], torch.Tensor]
"""Adds up what several processes have each for themselves."""


class TrainingEnvironment(Protocol):
    """What PPO needs of an environment: rsl-rl's `VecEnv`, a log read once a round, and states to go on from."""

    num_envs: int
    num_actions: int
    device: Any

    def get_observations(self) -> TensorDict: ...  # noqa: D102
    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]: ...  # noqa: D102
    def read_log(self, total: Total | None = None) -> dict[str, float]: ...  # noqa: D102
    def offending_state(self) -> dict[str, np.ndarray] | None: ...  # noqa: D102
    def state(self) -> dict[str, torch.Tensor]: ...  # noqa: D102
    def restore(self, state: dict[str, torch.Tensor]) -> None: ...  # noqa: D102


@dataclass
class Iteration:
    """What a round of collecting and updating came to."""

    iteration: int
    """Rounds done, this one included."""
    steps: int
    """Environment steps done in all, by all processes."""
    seconds: float
    """Time spent in all [s], over all sittings."""
    collecting: float
    """Time of this round's steps [s]."""
    updating: float
    """Time of its update [s]."""
    rate: float = 0.0
    """Environment steps a second, of all processes."""
    log: dict[str, float] = field(default_factory=dict)
    """What the environment and the losses came to."""


Report = Callable[[Iteration], None]


class Trainer:
    """A policy in training."""

    def __init__(
        self, environment: TrainingEnvironment, cfg: TrainCfg, folder: Path | None = None, ranks: Ranks | None = None
    ) -> None:
        """Make policy and value function.

        Args:
            environment: What to train in.
            cfg: Settings; of its environment part nothing is read.
            folder: Run folder for checkpoints and curves; None keeps everything in memory.
            ranks: The processes that train together, joined already; this one alone by default.
        """
        self.environment, self.cfg, self.folder = environment, cfg, folder
        self.ranks = Ranks() if ranks is None else ranks
        self.device = str(environment.device)
        torch.set_float32_matmul_precision("high" if cfg.ppo.tf32 else "highest")
        _seed_everything(cfg.seed)  # the same networks in all processes
        self.algorithm = _make_ppo(environment, cfg.ppo, self.ranks)
        if not self.ranks.first:
            _seed_everything(self.ranks.seed(cfg.seed))
        self.iteration, self.steps, self.seconds = 0, 0, 0.0
        self.history: list[Iteration] = []
        self._offended = False

    def learn(self, report: Report | None = None, *, seconds: float | None = None) -> Iteration | None:
        """Train to the last round, to the target, or for some time, and return the last round.

        A checkpoint is written every so many rounds, at the end, and when the training is interrupted.

        Args:
            report: Called after every round.
            seconds: Time after which to stop [s].

        Raises:
            TrainError: The losses or the weights are not finite any more. The last checkpoint stays as it is.
        """
        begun = time.monotonic()
        self.algorithm.train_mode()
        observations = self.environment.get_observations()
        last: Iteration | None = None
        with self._writer() as write, self.ranks.interruptions() as interrupted:
            try:
                while self.iteration < self.cfg.ppo.iterations:
                    last, observations = self._round(observations)
                    write(last)
                    if report is not None:
                        report(last)
                    late = seconds is not None and time.monotonic() - begun > seconds
                    if interrupted():
                        raise KeyboardInterrupt
                    if (self.cfg.target is not None and last.log["success"] >= self.cfg.target) or self._agreed(late):
                        break
                    if self.iteration % self.cfg.checkpoint == 0:
                        self.save()
            except KeyboardInterrupt:
                self.save()
                raise
            self.save()
        return last

    def _agreed(self, late: bool) -> bool:
        """Return what the first process thinks: clocks differ."""
        return late if self.ranks.alone else self.ranks.gathered(late)[0]

    def _round(self, observations: TensorDict) -> tuple[Iteration, TensorDict]:
        """Collect and update once."""
        ppo, environment = self.algorithm, self.environment
        start = time.monotonic()
        with torch.inference_mode():
            for _ in range(self.cfg.ppo.steps):
                actions = ppo.act(observations)
                observations, rewards, dones, extras = environment.step(actions)
                ppo.process_env_step(observations, rewards, dones, extras)
            ppo.compute_returns(observations)
        log = environment.read_log(self.ranks.total)
        self._keep_offence(log)
        collected = time.monotonic()
        losses = self._update()
        end = time.monotonic()
        means = self._averaged(losses)
        self.iteration += 1
        self.steps += self.steps_of_round
        self.seconds += end - start
        log |= {f"loss {name}": value for name, value in means.items()}
        log |= {"learning rate": ppo.learning_rate, "std": float(ppo.actor.output_std.detach().mean())}
        rate = self.steps_of_round / (end - start)
        this = Iteration(self.iteration, self.steps, self.seconds, collected - start, end - collected, rate, log)
        self.history.append(this)
        return this, observations

    @property
    def steps_of_round(self) -> int:
        """Environment steps of a round, of all processes."""
        return self.cfg.ppo.steps * self.environment.num_envs * self.ranks.count

    def _update(self) -> dict[str, float]:
        """Update policy and value function, and return the losses.

        Raises:
            TrainError: Losses or weights are not finite any more.
        """
        found: dict[str, float] = {}
        try:
            found = self.algorithm.update()
        except RuntimeError:  # torch does not draw from a distribution that is not finite
            if self._finite_weights():
                raise
        if not (found and np.isfinite(list(found.values())).all() and self._finite_weights()):
            raise TrainError(
                "the training has diverged: losses or weights are not finite any more",
                where=self.folder,
                fix="the last checkpoint is from before; start anew with a lower --ppo.learning-rate",
            )
        return found

    def _finite_weights(self) -> bool:
        """Return whether policy and value function can be worked with."""
        weights = [*self.algorithm.actor.parameters(), *self.algorithm.critic.parameters()]
        return bool(torch.stack([weight.detach().isfinite().all() for weight in weights]).all())

    def _averaged(self, losses: dict[str, float]) -> dict[str, float]:
        """Return the mean of losses over the processes."""
        values = torch.tensor([float(value) for value in losses.values()], device=self.device)
        return dict(zip(losses, (self.ranks.total(values) / self.ranks.count).tolist(), strict=True))

    def _keep_offence(self, log: dict[str, float]) -> None:
        """Save the first state from which a world diverged, where the log of a round tells of one."""
        if self._offended or not log.get("diverged worlds"):
            return
        states = [state for state in self.ranks.gathered(self.environment.offending_state()) if state is not None]
        self._offended = bool(states)
        if not states or self.folder is None or not self.ranks.first or (self.folder / DIVERGED_STATE_FILE).exists():
            return
        np.savez(self.folder / DIVERGED_STATE_FILE, **states[0])  # pyright: ignore[reportArgumentType]

    @contextlib.contextmanager
    def _writer(self) -> Iterator[Report]:
        """Give what writes a round to the run folder."""
        if self.folder is None or not self.ranks.first:
            yield _ignore
            return
        with curve(self.folder, self.steps) as write:

            def write_round(this: Iteration) -> None:
                spent = {"collecting": this.collecting, "updating": this.updating}
                point = {"iteration": this.iteration, "steps": this.steps, "seconds": this.seconds}
                # The environment's log counts the steps of this round alone: those so far go last.
                write({**point, **this.log, **spent, "steps_per_second": this.rate, **point})

            yield write_round

    def weights(self) -> dict[str, Any]:
        """Return policy, value function and optimiser as they are, and how long they were trained."""
        length = {"iteration": self.iteration, "steps": self.steps, "seconds": self.seconds}
        return {**self.algorithm.save(), **length}

    def save(self) -> None:
        """Write a checkpoint, in one piece or not at all, with the worlds and generators of all processes."""
        if self.folder is None:
            return
        worlds = {name: value.cpu() for name, value in self.environment.state().items()}
        ranks = self.ranks.gathered({"environment": worlds, "random": _random_state(self.device)})
        if not self.ranks.first:
            return
        document = {**self.weights(), "learning_rate": self.algorithm.learning_rate, "ranks": ranks}
        path = self.folder / CHECKPOINT
        partial = path.with_name(f".{path.name}.partial")
        torch.save(document, partial)
        partial.replace(path)

    def begin_with(self, path: Path) -> None:
        """Take over the policy of a checkpoint; value function and all else stay as they are.

        Raises:
            TrainError: It is of another network.
        """
        try:
            self.algorithm.load(load_checkpoint(path, self.device), {"actor": True}, True)
        except RuntimeError as error:
            raise TrainError("the policy is of another network", where=path, found=str(error)[:200]) from None

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint, as if training had not stopped.

        Raises:
            TrainError: It cannot be gone on with: it is of another network, of more or fewer processes, or holds a
                policy alone.
        """
        document = load_checkpoint(path, self.device)
        if "ranks" not in document:
            raise TrainError("the checkpoint holds a policy, but no training to go on with", where=path)
        if len(document["ranks"]) != self.ranks.count:
            raise TrainError(
                "the training was begun with another number of processes",
                where=path,
                expected=len(document["ranks"]),
                found=self.ranks.count,
            )
        mine = document["ranks"][self.ranks.rank]
        try:
            self.algorithm.load(document, None, True)
        except RuntimeError as error:
            raise TrainError("the checkpoint is of another network", where=path, found=str(error)[:200]) from None
        self.algorithm.learning_rate = document["learning_rate"]
        self.iteration, self.steps, self.seconds = (document[name] for name in ("iteration", "steps", "seconds"))
        self.environment.restore(mine["environment"])
        _restore_random_state(mine["random"], self.device)

    def policy(self) -> Callable[[TensorDict], torch.Tensor]:
        """Return the policy without exploration: from observations to actions, shape (N, A)."""
        self.algorithm.eval_mode()
        return self.algorithm.get_policy()


def _ignore(this: Iteration) -> None:
    """Do nothing with a round."""
    del this


def _make_ppo(environment: TrainingEnvironment, cfg: PpoCfg, ranks: Ranks) -> PPO:
    """Return rsl-rl's PPO for an environment; its gradients are averaged over the processes."""
    settings = {
        "num_steps_per_env": cfg.steps,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": network(cfg, actor=True),
        "critic": network(cfg, actor=False),
        "multi_gpu": ranks.rsl_rl(),
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": cfg.epochs,
            "num_mini_batches": cfg.batches,
            "clip_param": cfg.clip,
            "gamma": cfg.discount,
            "lam": cfg.lam,
            "value_loss_coef": cfg.value,
            "entropy_coef": cfg.entropy,
            "learning_rate": cfg.learning_rate,
            "schedule": cfg.schedule,
            "desired_kl": cfg.divergence,
            "max_grad_norm": cfg.gradient,
        },
    }
    with contextlib.redirect_stdout(io.StringIO()):  # it prints the networks
        algorithm = PPO.construct_algorithm(
            environment.get_observations(),
            environment,  # pyright: ignore[reportArgumentType]
            settings,
            str(environment.device),
        )
    for model in (algorithm.actor, algorithm.critic):
        bound_observations(model)
    return algorithm


def network(cfg: PpoCfg, *, actor: bool) -> dict[str, Any]:
    """Return rsl-rl's settings of the policy, or of the value function."""
    settings: dict[str, Any] = {"class_name": "MLPModel", "hidden_dims": list(cfg.hidden), "activation": cfg.activation}
    settings["obs_normalization"] = cfg.normalise
    if actor:
        settings["distribution_cfg"] = {"class_name": SquashedGaussian, "init_std": cfg.std, "std_type": "log"}
    return settings


def load_checkpoint(path: Path, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        TrainError: It is missing or not one.
    """
    if not path.is_file():
        raise TrainError("no such checkpoint", where=path, expected=f"a {CHECKPOINT} that concent train wrote")
    try:
        document = torch.load(path, map_location=device, weights_only=False)
    except Exception as error:  # torch's reader raises whatever its parsers do
        raise TrainError("not a checkpoint", where=path, found=f"{type(error).__name__}: {error}") from None
    if not isinstance(document, dict) or "actor_state_dict" not in document:
        raise TrainError("not a checkpoint of a training", where=path)
    return document


def _seed_everything(seed: int) -> None:
    """Seed all generators."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


def _random_state(device: str) -> dict[str, Any]:
    """Return the state of torch's generators on the CPU and on a device; nothing else draws while training."""
    cuda = torch.cuda.get_rng_state(device).cpu() if device.startswith("cuda") else None
    return {"cpu": torch.get_rng_state(), "cuda": cuda}


def _restore_random_state(state: dict[str, Any], device: str) -> None:
    """Bring back what `_random_state` returned."""
    torch.set_rng_state(state["cpu"].cpu())
    if state["cuda"] is not None and device.startswith("cuda"):
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)
