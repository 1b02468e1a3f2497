"""PPO on rsl-rl, with checkpoints from which a training continues exactly."""

from __future__ import annotations

import contextlib
import gc
import io
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict

from concent_warp.array_file import write_arrays
from concent_warp.checkpoint_file import check_state, read_checkpoint, write_checkpoint
from concent_warp.checks import check_at_least
from concent_warp.errors import TrainError
from concent_warp.run_folder import TRAIN_CHECKPOINT
from concent_warp.train.cfg import PpoCfg, TrainCfg
from concent_warp.train.learning.best_policy import chosen_best
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.distribution import SquashedGaussian
from concent_warp.train.learning.metrics import curve
from concent_warp.train.learning.normalisation import bound_observations
from concent_warp.train.learning.random_state import random_state, restore_random_state, seed_everything

CHECKPOINT = TRAIN_CHECKPOINT
"""File of the latest checkpoint in a run folder."""
DIVERGED_STATE_FILE = "diverged.npz"
"""File of the state before the first divergence of a world, in a run folder."""

Sum = Callable[[torch.Tensor], torch.Tensor]
"""Sums a tensor over ranks."""


class TrainingEnvironment(Protocol):
    """Interface of an environment: rsl-rl's `VecEnv`, a log read once per iteration, and a state to resume from."""

    num_envs: int
    num_actions: int
    device: Any

    def get_observations(self) -> TensorDict: ...  # noqa: D102
    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]: ...  # noqa: D102
    def read_log(self, total: Sum | None = None) -> dict[str, float]: ...  # noqa: D102
    def diverged_state(self) -> dict[str, np.ndarray] | None: ...  # noqa: D102
    def state(self) -> dict[str, torch.Tensor]: ...  # noqa: D102
    def restore(self, state: dict[str, torch.Tensor]) -> None: ...  # noqa: D102
    @property
    def buffers(self) -> tuple[int, int] | None: ...  # noqa: D102


@dataclass
class Iteration:
    """Results of one iteration: collection of environment steps and policy update."""

    iteration: int
    """Number of iterations so far, this one included."""
    steps: int
    """Environment steps so far, of all ranks."""
    seconds: float
    """Training time so far [s], that before a resumption included."""
    collecting: float
    """Time of this iteration's environment steps [s]."""
    updating: float
    """Time of its policy update [s]."""
    rate: float = 0.0
    """Environment steps per second, of all ranks."""
    log: dict[str, float] = field(default_factory=dict)
    """Metrics of environment and losses, by name."""


Report = Callable[[Iteration], None]
Examination = Callable[[Callable[[TensorDict], torch.Tensor]], tuple[int, int]]
"""Given a policy without exploration, returns the numbers of successes and of episodes."""
MakeExamination = Callable[[], Examination]
MakeEnvironment = Callable[[tuple[int, int] | None, bool], TrainingEnvironment]
"""Makes the environment anew, with room for so many contacts and constraint rows, in the last iterations' physics."""


class Trainer:
    """Trains policy and value function in an environment."""

    def __init__(
        self,
        environment: TrainingEnvironment,
        cfg: TrainCfg,
        folder: Path | None = None,
        process: DistributedProcess | None = None,
        make_environment: MakeEnvironment | None = None,
        make_examination: MakeExamination | None = None,
    ) -> None:
        """Create policy and value function.

        Args:
            environment: The worlds to train in.
            cfg: Settings; their `environment` is not read.
            folder: Run folder for checkpoints and metrics; None writes none.
            process: This process of a data-parallel training, within its group; a single process by default.
            make_environment: Makes it with larger buffers when they overflow, and for the last iterations.
            make_examination: Makes the examination by which the best policy is kept; none by default.
        """
        self.environment, self.cfg, self.folder = environment, cfg, folder
        self._make_environment, self._warned_of_overflow = make_environment, False
        self._make_examination, self._examine = make_examination, None
        self.process = process or DistributedProcess()
        self.device = str(environment.device)
        torch.set_float32_matmul_precision("high" if cfg.ppo.tf32 else "highest")
        seed_everything(cfg.seed)  # the same networks on all ranks
        self.algorithm = _make_ppo(environment, cfg.ppo, self.process)
        if not self.process.is_rank_zero:
            seed_everything(self.process.seed(cfg.seed))
        self.iteration, self.steps, self.seconds = 0, 0, 0.0
        self.history: list[Iteration] = []
        self._has_diverged = self._finishing = False
        self._grown: tuple[int, int] | None = None
        self.best: dict[str, Any] = {}
        """The policy that did best in an examination: its weights "actor_state_dict", the "iteration", "successes" and
        "episodes"; empty before the first examination."""

    def learn(self, report: Report | None = None, *, seconds: float | None = None) -> Iteration | None:
        """Train until the last iteration, the target success or a time limit; return the last iteration.

        A checkpoint is written every `TrainCfg.checkpoint` iterations, at the end, and on interruption.

        Args:
            report: Called after every iteration.
            seconds: Time after which to stop [s].

        Raises:
            TrainError: Losses or weights became non-finite. The last checkpoint is kept.
        """
        begun = time.monotonic()
        self.algorithm.train_mode()
        observations = self.environment.get_observations()
        last: Iteration | None = None
        with self._writer() as write, self.process.watch_interrupts() as interrupted:
            try:
                while self.iteration < self.cfg.ppo.iterations:
                    self._begin_finish()
                    last, observations = self._iterate(observations)
                    self._keep_best(last)
                    write(last)
                    if report is not None:
                        report(last)
                    late = seconds is not None and time.monotonic() - begun > seconds
                    if interrupted():
                        raise KeyboardInterrupt
                    if (
                        self.cfg.target is not None and last.log["success"] >= self.cfg.target
                    ) or self._decision_of_rank_zero(late):
                        break
                    if self.iteration % self.cfg.checkpoint == 0:
                        self.save()
            except KeyboardInterrupt:
                self.save()
                raise
            self.save()
        return last

    def _begin_finish(self) -> None:
        """Go on in the physics of the last iterations where these begin."""
        if not self._finishing and self._make_environment is not None and self.iteration >= self.cfg.finish_from:
            with self.process.raise_together():
                self._rebuild(self._grown, finishing=True)

    def _keep_best(self, this: Iteration) -> None:
        """Examine the policy where it is due, note the result in the log, and keep the policy if it is the best.

        Learning goes on as if there had been no examination.
        """
        every = self.cfg.stress.every
        if self._make_examination is None or not every or self.iteration % every or not self.process.is_rank_zero:
            return
        begun, state = time.monotonic(), random_state(self.device)
        if self._examine is None:
            try:
                self._examine = self._make_examination()
            except TrainError as error:
                self._warn(f"no stress test, and the last policy is kept: {error}")
                self._make_examination = None
                restore_random_state(state, self.device)
                return
        torch.manual_seed(self.cfg.seed)  # the same chances for all policies
        successes, episodes = self._examine(self.policy())
        self.algorithm.train_mode()
        restore_random_state(state, self.device)
        this.log |= {"stress success": successes / episodes, "stress seconds": time.monotonic() - begun}
        if not self.best or successes >= self.best["successes"]:
            weights = {name: value.clone() for name, value in self.algorithm.actor.state_dict().items()}
            self.best = {"actor_state_dict": weights, "iteration": self.iteration}
            self.best |= {"successes": successes, "episodes": episodes}

    def _decision_of_rank_zero(self, late: bool) -> bool:
        """Return the decision of rank 0, since the ranks' clocks differ."""
        return late if self.process.is_single else self.process.gather(late)[0]

    def _iterate(self, observations: TensorDict) -> tuple[Iteration, TensorDict]:
        """Run one iteration: collect steps and update the policy; return it with the next observations."""
        ppo = self.algorithm
        start = time.monotonic()
        with torch.inference_mode():
            for _ in range(self.cfg.ppo.steps):
                actions = ppo.act(observations)
                observations, rewards, dones, extras = self.environment.step(actions)
                ppo.process_env_step(observations, rewards, dones, extras)
            ppo.compute_returns(observations)
        log = self.environment.read_log(self.process.sum_over_ranks)
        self._save_diverged_state(log)
        self._make_room(log.get("overflow", 0.0))
        collected = time.monotonic()
        losses = self._update()
        end = time.monotonic()
        self.iteration += 1
        self.steps += self.steps_per_iteration
        self.seconds += end - start
        log |= {f"loss {name}": value for name, value in self._averaged(losses).items()}
        log |= {"learning rate": ppo.learning_rate, "std": float(ppo.actor.output_std.detach().mean())}
        rate = self.steps_per_iteration / (end - start)
        this = Iteration(self.iteration, self.steps, self.seconds, collected - start, end - collected, rate, log)
        self.history.append(this)
        return this, observations

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps per iteration, of all ranks."""
        return self.cfg.ppo.steps * self.environment.num_envs * self.process.world_size

    def _update(self) -> dict[str, float]:
        """Update policy and value function; return the losses by name.

        Raises:
            TrainError: Losses or weights became non-finite.
        """
        found: dict[str, float] = {}
        try:
            found = self.algorithm.update()
        except RuntimeError:  # torch refuses to sample from a non-finite distribution
            if self._finite_weights():
                raise
        if not (found and np.isfinite(list(found.values())).all() and self._finite_weights()):
            raise TrainError(
                "the training diverged: losses or weights are not finite",
                where=self.folder,
                fix="train again with a lower --ppo.learning-rate; the last checkpoint is from before the divergence",
            )
        return found

    def _finite_weights(self) -> bool:
        """Return whether all weights of policy and value function are finite."""
        weights = [*self.algorithm.actor.parameters(), *self.algorithm.critic.parameters()]
        return bool(torch.stack([weight.detach().isfinite().all() for weight in weights]).all())

    def _averaged(self, losses: dict[str, float]) -> dict[str, float]:
        """Return the mean of the losses over ranks."""
        values = torch.tensor([float(value) for value in losses.values()], device=self.device)
        return dict(zip(losses, (self.process.sum_over_ranks(values) / self.process.world_size).tolist(), strict=True))

    def _save_diverged_state(self, log: dict[str, float]) -> None:
        """Save the state before the first divergence of a world, if the log of an iteration reports one."""
        if self._has_diverged or not log.get("diverged worlds"):
            return
        states = [state for state in self.process.gather(self.environment.diverged_state()) if state is not None]
        self._has_diverged = bool(states)
        if (
            not states
            or self.folder is None
            or not self.process.is_rank_zero
            or (self.folder / DIVERGED_STATE_FILE).exists()
        ):
            return
        write_arrays(self.folder / DIVERGED_STATE_FILE, states[0])

    def _make_room(self, share: float) -> None:
        """Warn of contacts that were dropped in a share of the steps, and go on with buffers twice as large.

        All ranks call it with the same share.
        """
        if not share:
            return
        buffers, text = self.environment.buffers, f"contacts were dropped in {share:.2%} of the steps"
        if buffers is None or self._make_environment is None:
            fix = "give the scene more memory (<size memory>)" if buffers is None else "enlarge the buffers"
            if not self._warned_of_overflow:
                self._warn(f"{text}: {fix}, or the training is wrong")
            self._warned_of_overflow = True
            return
        larger = 2 * buffers[0], 2 * buffers[1]
        try:
            with self.process.raise_together():
                self._rebuild(larger, finishing=self._finishing)
        except TrainError as error:
            raise TrainError(
                f"{text}, and larger buffers do not fit the memory", found=error, fix="lower --worlds"
            ) from None
        self._grown = larger
        self._warn(
            f"{text}: the training goes on with room for {larger[0]} contacts and {larger[1]} constraints a world"
        )

    def _warn(self, text: str) -> None:
        """Warn once for all ranks."""
        if self.process.is_rank_zero:
            warnings.warn(text, stacklevel=2)

    def _rebuild(self, buffers: tuple[int, int] | None, *, finishing: bool) -> None:
        """Make the environment anew with other buffers or physics, in the same state; the old one is freed before.

        Raises:
            TrainError: It does not fit the memory.
        """
        assert self._make_environment is not None
        random, state = random_state(self.device), self.environment.state()
        del self.environment
        gc.collect()
        self.environment, self._finishing = self._make_environment(buffers, finishing), finishing
        self.environment.restore(state)
        restore_random_state(random, self.device)

    @contextlib.contextmanager
    def _writer(self) -> Iterator[Report]:
        """Yield a function that writes an iteration's metrics to the run folder."""
        if self.folder is None or not self.process.is_rank_zero:
            yield lambda _: None
            return
        with curve(self.folder, self.steps) as write:

            def write_iteration(this: Iteration) -> None:
                spent = {"collecting": this.collecting, "updating": this.updating}
                point = {"iteration": this.iteration, "steps": this.steps, "seconds": this.seconds}
                # The environment's log counts the steps of this iteration alone: the totals go last and replace them.
                write({**point, **this.log, **spent, "steps_per_second": this.rate, **point})

            yield write_iteration

    def weights(self) -> dict[str, Any]:
        """Return the state of policy, value function and optimiser, with iterations, steps and seconds of training."""
        length = {"iteration": self.iteration, "steps": self.steps, "seconds": self.seconds}
        return {**self.algorithm.save(), **length, "best": self.best}

    def save(self) -> None:
        """Write a checkpoint atomically, with the environment and random number generators of all ranks."""
        if self.folder is None:
            return
        worlds = {name: value.cpu() for name, value in self.environment.state().items()}
        ranks = self.process.gather({"environment": worlds, "random": random_state(self.device)})
        document = {**self.weights(), "learning_rate": self.algorithm.learning_rate, "ranks": ranks}
        document["buffers"] = self.environment.buffers
        with self.process.raise_together():  # no rank goes on, or resumes from the file, before it is written
            if self.process.is_rank_zero:
                write_checkpoint(self.folder / CHECKPOINT, document)

    def begin_with(self, weights: Mapping[str, Any], where: object = None) -> None:
        """Load the policy of a checkpoint, without value function, optimiser and environment.

        Args:
            weights: Checkpoint that `load_checkpoint` returned.
            where: Its file, named in errors.

        Raises:
            TrainError: Its network has another architecture.
        """
        state = self.algorithm.actor.state_dict()
        check_state(weights["actor_state_dict"], state, "the policy's network", where=where, error=TrainError)
        self.algorithm.load(dict(weights), {"actor": True}, True)

    def resume(self, path: Path) -> None:
        """Restore the training of a checkpoint; it continues as if it had not stopped.

        Raises:
            TrainError: The checkpoint's network has another architecture, it has another number of ranks, it holds a
                policy alone, or its parts are of another training.
        """
        document = load_checkpoint(path)
        if "ranks" not in document:
            raise TrainError("the checkpoint holds a policy, but no training to resume", where=path)
        ranks, ppo = document["ranks"], self.algorithm
        if not isinstance(ranks, list) or len(ranks) != self.process.world_size:
            raise TrainError(
                "the training was started with another number of processes",
                where=path,
                expected=len(ranks) if isinstance(ranks, list) else "a list of them",
                found=self.process.world_size,
            )
        for name, network in (("actor", ppo.actor), ("critic", ppo.critic)):
            found = document.get(f"{name}_state_dict")
            check_state(found, network.state_dict(), f"the checkpoint's {name}", where=path, error=TrainError)
        try:
            self._restore(document, ranks[self.process.rank])
        except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
            if isinstance(error, TrainError):
                raise
            found = " ".join(str(error).split())[:200] or type(error).__name__
            raise TrainError("the checkpoint holds no training like this one", where=path, found=found) from None

    def _restore(self, document: dict[str, Any], state: dict[str, Any]) -> None:
        """Restore networks and optimiser of a checkpoint, and the environment and generators of this rank."""
        ppo = self.algorithm
        ppo.load(document, None, True)
        for group in ppo.optimizer.param_groups:
            for weight in group["params"]:
                for name in ("exp_avg", "exp_avg_sq"):
                    moment = ppo.optimizer.state.get(weight, {}).get(name, weight)
                    if moment.shape != weight.shape:
                        raise ValueError(f"{name} of shape {tuple(moment.shape)} for weights {tuple(weight.shape)}")
        ppo.learning_rate = float(document["learning_rate"])
        self.iteration, self.steps, self.seconds = (document[name] for name in ("iteration", "steps", "seconds"))
        self.best = chosen_best(document)
        buffers = document.get("buffers")
        if buffers is not None:
            contacts, constraints = buffers
            check_at_least(1, TrainError, contacts=contacts, constraints=constraints)
            buffers = int(contacts), int(constraints)
        finishing = self.iteration > self.cfg.finish_from
        if self._make_environment is not None and (finishing or buffers not in (None, self.environment.buffers)):
            self._grown = buffers
            self._rebuild(buffers, finishing=finishing)
        self.environment.restore(state["environment"])
        restore_random_state(state["random"], self.device)

    def policy(self) -> Callable[[TensorDict], torch.Tensor]:
        """Return the deterministic policy: from observations to actions, shape (N, A)."""
        self.algorithm.eval_mode()
        return self.algorithm.get_policy()


def _make_ppo(environment: TrainingEnvironment, cfg: PpoCfg, process: DistributedProcess) -> PPO:
    """Return rsl-rl's PPO for an environment; its gradients are averaged over ranks.

    The value function also sees what the environment offers beside the policy's observation (Pinto et al., "Asymmetric
    actor critic for image-based robot learning", RSS 2018).
    """
    observations = environment.get_observations()
    settings = {
        "num_steps_per_env": cfg.steps,
        "obs_groups": {"actor": ["policy"], "critic": sorted(map(str, observations.keys()))},
        "actor": network_settings(cfg, actor=True),
        "critic": network_settings(cfg, actor=False),
        "multi_gpu": process.rsl_rl(),
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
    with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints the networks
        algorithm = PPO.construct_algorithm(
            observations,
            environment,  # pyright: ignore[reportArgumentType]
            settings,
            str(environment.device),
        )
    for model in (algorithm.actor, algorithm.critic):
        bound_observations(model, cfg.max_observation)
    return algorithm


def network_settings(cfg: PpoCfg, *, actor: bool) -> dict[str, Any]:
    """Return rsl-rl's settings of the policy, or of the value function."""
    settings: dict[str, Any] = {"class_name": "MLPModel", "hidden_dims": list(cfg.hidden), "activation": cfg.activation}
    settings["obs_normalization"] = cfg.normalise
    if actor:
        settings["distribution_cfg"] = {"class_name": SquashedGaussian, "init_std": cfg.std, "std_type": "log"}
        settings["distribution_cfg"]["max_mean"] = cfg.max_mean
    return settings


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Return the checkpoint of a training, with its tensors on the CPU.

    Raises:
        TrainError: The file is missing or no checkpoint, holds more than tensors and plain data, or has weights that
            are not finite.
    """
    if not path.exists():
        raise TrainError("no such checkpoint", where=path, expected=f"a {CHECKPOINT} that concent train wrote")
    numbers = ("iteration", "steps", "seconds")
    weights = ("actor_state_dict", "critic_state_dict", "optimizer_state_dict", "learning_rate")
    keys = ("actor_state_dict", *numbers)
    document = read_checkpoint(path, keys=keys, finite=(*weights, *numbers, "best"), error=TrainError)
    for name in numbers:
        value = document[name]
        if not isinstance(value, int | float if name == "seconds" else int) or value < 0:
            raise TrainError(f"{name} of the checkpoint is no count", where=path, expected="at least 0", found=value)
    return document
