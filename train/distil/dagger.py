"""DAgger with images in the loop: the teacher labels the states that the student gets into.

Ross, Gordon, Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning"
(AISTATS 2011). An iteration collects samples in all worlds, then takes gradient steps on random ones of the latest.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch.nn import functional

from concent_warp.checkpoint_file import check_state, read_checkpoint, write_checkpoint
from concent_warp.errors import TrainError
from concent_warp.train.distil.augmentation import augmented
from concent_warp.train.distil.cfg import DistilCfg
from concent_warp.train.distil.images import DelayedImages, ImageSource
from concent_warp.train.distil.network import POSITION_SCALE, StudentNetwork, scaled_poses
from concent_warp.train.distil.proprioception import Proprioception
from concent_warp.train.distil.samples import Samples
from concent_warp.train.environment.environment import Environment
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.metrics import curve
from concent_warp.train.learning.ppo import CHECKPOINT, Iteration, Report
from concent_warp.train.learning.random_state import random_state, restore_random_state, seed_everything
from concent_warp.train.trials.episodes import PolicyFunction

RECENT = 200
"""Latest episodes whose share of successes is reported."""
HUBER = 0.2
"""Difference of an action from its label above which the loss is linear [-]."""
SETTLED = 1e9
"""Number of samples that mean and standard deviation of another student's proprioception count as."""
SAVING_RATIO = 10.0
"""Least time between checkpoints over that of writing one [-]."""
POSE_HUBER = 0.1
"""The same of a scaled pose: 5 mm."""


class Dagger:
    """Trains a student in the worlds of an environment."""

    def __init__(
        self,
        environment: Environment,
        teacher: PolicyFunction,
        images: ImageSource,
        cfg: DistilCfg,
        folder: Path | None = None,
        process: DistributedProcess | None = None,
    ) -> None:
        """Create the student.

        Args:
            environment: The worlds, as the teacher was trained in them.
            teacher: From observations to actions, without exploration.
            images: Cameras of the worlds.
            cfg: Settings.
            folder: Run folder for checkpoints and metrics; None writes none.
            process: This process of a data-parallel training, within its group; a single process by default.

        Raises:
            TrainError: The samples do not fit the memory.
        """
        self.environment, self.cfg, self.folder = environment, cfg, folder
        self.process = process or DistributedProcess()
        self.device = str(environment.device)
        self._teacher = teacher
        self._proprioception = Proprioception(environment.layout)
        self._images = DelayedImages(images, cfg.images.frames, cfg.images.delay)
        # A teacher that observes the past needs its observations of it, which are with sensor errors.
        self._labels_from_truth = cfg.dagger.label == "truth" and environment.history.shape[1] == 1
        seed_everything(cfg.seed)  # the same network on all ranks
        self.network = make_network(cfg, self._proprioception, environment.num_actions).to(self.device)
        if self.device.startswith("cuda"):
            self.network.reduce_precision(cfg.dagger.half)
            if cfg.dagger.compiled:
                self.network.compile_encoders(self.device)
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=cfg.dagger.learning_rate, weight_decay=cfg.dagger.decay,
            fused=self.device.startswith("cuda"),
        )  # fmt: skip
        n, d = environment.num_envs, cfg.dagger
        size, channels = cfg.images.size, 3 * cfg.images.frames
        kept = min(d.buffer, d.iterations * d.steps * n) if cfg.method == "dagger" else 1
        self.samples = Samples(
            kept,
            (len(images.cameras), channels, size, size),
            (self._proprioception.size, environment.num_actions, 9 * self._proprioception.objects),
            self.device,
        )
        seed_everything(self.process.seed(cfg.seed))
        self.iteration, self.steps, self.seconds, self.gradient_steps = 0, 0, 0.0, 0
        self._moments = torch.zeros(2 * self._proprioception.size + 1, dtype=torch.float64, device=self.device)
        self._started = torch.ones(n, dtype=torch.bool, device=self.device)
        self._taught = torch.zeros(n, dtype=torch.bool, device=self.device)
        self._outcomes = torch.zeros(4, dtype=torch.float64, device=self.device)
        self._recent: list[list[float]] = []
        self._warned, self._saved, self._saving = False, 0.0, 0.0

    @property
    def beta(self) -> float:
        """Share of episodes that the teacher drives."""
        d = self.cfg.dagger
        share = 1.0 if d.beta_iterations == 0 else min(self.iteration / d.beta_iterations, 1.0)
        return d.beta + share * (d.beta_end - d.beta)

    def learn(self, report: Report | None = None, *, seconds: float | None = None) -> Iteration | None:
        """Train until the last iteration or a time limit; return the last iteration.

        A checkpoint is written every `DistilCfg.checkpoint` seconds, at the end, and on interruption.

        Args:
            report: Called after every iteration.
            seconds: Time after which to stop [s].

        Raises:
            TrainError: The loss became non-finite. The last checkpoint is kept.
        """
        begun = self._saved = time.monotonic()
        last: Iteration | None = None
        with self._writer() as write, self.process.watch_interrupts() as interrupted:
            try:
                while self.iteration < self.cfg.dagger.iterations:
                    last = self._iterate()
                    write(last)
                    if report is not None:
                        report(last)
                    if interrupted():
                        raise KeyboardInterrupt
                    now = time.monotonic()
                    late, due = self._decisions_of_rank_zero(
                        seconds is not None and now - begun > seconds,
                        now - self._saved > max(self.cfg.checkpoint, SAVING_RATIO * self._saving),
                    )
                    if late:
                        break
                    if due:
                        self.save()
            except KeyboardInterrupt:
                self.save()
                raise
            self.save()
        return last

    def _decisions_of_rank_zero(self, late: bool, due: bool) -> tuple[bool, bool]:
        """Return the decisions of rank 0, since the ranks' clocks differ."""
        return (late, due) if self.process.is_single else self.process.gather((late, due))[0]

    def _iterate(self) -> Iteration:
        """Run one iteration: collect samples and update the student."""
        d, start, beta = self.cfg.dagger, time.monotonic(), self.beta
        self.network.eval()
        with torch.no_grad():
            for _ in range(d.steps):
                self._collect(beta)
            self._normalise()
        log = self._log()
        collected = time.monotonic()
        self.network.train()
        losses = self._learn()
        losses = self.process.sum_over_ranks(losses) / self.process.world_size
        action, poses, *positions = losses.tolist()
        if not math.isfinite(action + poses):
            raise TrainError(
                "the distillation diverged: the loss is not finite",
                where=self.folder,
                fix="start again with a lower --dagger.learning-rate; the last checkpoint is from before",
            )
        end = time.monotonic()
        steps = d.steps * self.environment.num_envs * self.process.world_size
        self.iteration += 1
        self.steps += steps
        self.seconds += end - start
        log |= {"loss action": action, "loss poses": poses, "beta": beta, "learning rate": self._rate()}
        if positions:
            log["position error"] = positions[0]
        return Iteration(
            self.iteration, self.steps, self.seconds, collected - start, end - collected, steps / (end - start), log
        )

    def _collect(self, beta: float) -> None:
        """Take one step in all worlds and keep its sample."""
        environment, started = self.environment, self._started
        seen = self._look(started).to(self.device)
        own, truth = self._proprioception.read(environment.observation).clone(), environment.truth
        given = self._teacher_observation()
        label = self._teacher(TensorDict({"policy": given}, batch_size=[len(given)])).clamp(-1, 1)
        self.samples.add(seen, own, label, scaled_poses(self._proprioception.poses(truth)))
        taught = torch.rand(len(label), device=self.device) < beta
        self._taught = torch.where(started, taught, self._taught)
        action = label
        if beta < 1 or not bool(self._taught.all()):
            action = self.network(seen.float() / 255, own)
            action = torch.where(self._taught[:, None], label, action)
        environment.step(action)
        self._count()

    def _look(self, started: torch.Tensor) -> torch.Tensor:
        """Return the images of the present states, of which some worlds look otherwise from now on."""
        share = self.cfg.looks.renewed if self.cfg.images.frames == 1 else 0.0
        renewed = torch.rand(len(started), device=started.device) < share if share else None
        return self._images.look(self.environment, started, renewed)

    def _teacher_observation(self) -> torch.Tensor:
        """Return what the teacher observes, shape (N, O)."""
        environment = self.environment
        return (environment.truth if self._labels_from_truth else environment.history.flatten(1)).clone()

    def _count(self) -> None:
        """Count the episodes that the last step ended."""
        environment = self.environment
        done = environment.done
        succeeded = done & environment.success & ~environment.failure.any(dim=1)
        counts = [done & ~self._taught, succeeded & ~self._taught, done & self._taught, succeeded & self._taught]
        self._outcomes += torch.stack(counts).sum(dim=1)
        self._started = done.clone()

    def _normalise(self) -> None:
        """Estimate mean and standard deviation of the proprioception by the latest samples of all ranks."""
        if self.iteration >= self.cfg.dagger.normalise_iterations:
            return
        values = self._latest_proprioception().double()
        added = torch.cat([values.sum(dim=0), values.square().sum(dim=0), values.new_tensor([float(len(values))])])
        self._moments += self.process.sum_over_ranks(added)
        total = self._moments[-1]
        mean, square = (self._moments[:-1] / total).chunk(2)
        self.network.get_buffer("mean").copy_(mean)
        self.network.get_buffer("std").copy_((square - mean.square()).clamp(min=1e-8).sqrt().clamp(min=1e-3))

    def _latest_proprioception(self) -> torch.Tensor:
        """Return the proprioception of this iteration's samples, shape (M, P)."""
        count = min(self.cfg.dagger.steps * self.environment.num_envs, len(self.samples))
        rows = (self.samples.next - 1 - torch.arange(count, device=self.device)) % self.samples.capacity
        return self.samples.proprioception[rows]

    def _learn(self) -> torch.Tensor:
        """Take the gradient steps of an iteration; return the mean of what `losses` returns, shape (3,)."""
        return torch.stack([self._update() for _ in range(self.cfg.dagger.updates)]).mean(dim=0)

    def _update(self) -> torch.Tensor:
        """Take a gradient step on random samples; return what `losses` returns, shape (3,)."""
        d = self.cfg.dagger
        for group in self._optimiser.param_groups:
            group["lr"] = self._rate()
        images, own, label, poses = self.samples.pick(d.batch)
        losses = self.losses(augmented(images.float() / 255, self.cfg.augment), own, label, poses)
        self._optimiser.zero_grad(set_to_none=True)
        (losses[0] + d.auxiliary * losses[1]).backward()
        self._average_gradients()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), d.gradient)
        self._optimiser.step()
        self.gradient_steps += 1
        return losses.detach()

    def losses(self, images: torch.Tensor, own: torch.Tensor, label: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
        """Return the losses of actions and of poses, and the mean error of predicted positions [m], shape (3,).

        Args:
            images: Colours 0..1, shape (N, C, 3 F, size, size).
            own: Proprioception, shape (N, P).
            label: The teacher's actions, shape (N, A).
            poses: Scaled poses of the objects, shape (N, 9 objects).
        """
        action, predicted = self.network.both(images, own)
        first = functional.smooth_l1_loss(action, label, beta=HUBER)
        second = functional.smooth_l1_loss(predicted, poses, beta=POSE_HUBER)
        positions = (predicted - poses).detach().unflatten(1, (-1, 9))[..., :3] / POSITION_SCALE
        return torch.stack([first, second, torch.linalg.vector_norm(positions, dim=2).mean()])

    def _rate(self) -> float:
        """Return the learning rate of the next gradient step."""
        d = self.cfg.dagger
        rising = min((self.gradient_steps + 1) / max(d.warm_up, 1), 1.0)
        share = min(self.gradient_steps / (d.iterations * d.updates), 1.0)
        return d.learning_rate * rising * (0.01 + 0.99 * (1 + math.cos(math.pi * share)) / 2)

    def _average_gradients(self) -> None:
        """Average the gradients over ranks."""
        if self.process.is_single:
            return
        gradients = [weight.grad for weight in self.network.parameters() if weight.grad is not None]
        flat = self.process.sum_over_ranks(torch.cat([g.reshape(-1) for g in gradients])) / self.process.world_size
        for gradient, values in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(values.view_as(gradient))

    def _log(self) -> dict[str, float]:
        """Return shares of successes, and warn of contacts that were dropped."""
        ended, succeeded, taught, taught_succeeded = self.process.sum_over_ranks(self._outcomes.clone()).tolist()
        self._outcomes.zero_()
        overflow = self.environment.read_log(self.process.sum_over_ranks)["overflow"]
        if overflow and not self._warned and self.process.is_rank_zero:
            fix = "give the scene more memory (<size memory>), or train the teacher with larger buffers"
            warnings.warn(f"contacts were dropped in {overflow:.2%} of the steps: {fix}", stacklevel=2)
            self._warned = True
        if ended:
            self._recent.append([ended, succeeded])
        while len(self._recent) > 1 and sum(one[0] for one in self._recent[1:]) >= RECENT:
            self._recent.pop(0)
        log = {"episodes": ended, "teacher episodes": taught}
        if self._recent:
            log["success"] = sum(one[1] for one in self._recent) / sum(one[0] for one in self._recent)
        if taught:
            log["teacher success"] = taught_succeeded / taught
        return log

    @contextmanager
    def _writer(self) -> Iterator[Report]:
        """Yield a function that writes an iteration's metrics to the run folder."""
        if self.folder is None or not self.process.is_rank_zero:
            yield lambda _: None
            return
        with curve(self.folder, self.steps) as write:

            def write_iteration(this: Iteration) -> None:
                point = {"iteration": this.iteration, "steps": this.steps, "seconds": this.seconds, **this.log}
                spent = {"collecting": this.collecting, "updating": this.updating}
                write({**point, **spent, "steps_per_second": this.rate})

            yield write_iteration

    def weights(self) -> dict[str, Any]:
        """Return the student's state, with iterations, steps and seconds of training."""
        state = {name: value.cpu() for name, value in self.network.state_dict().items()}
        return {"student": state, "iteration": self.iteration, "steps": self.steps, "seconds": self.seconds}

    def save(self) -> None:
        """Write a checkpoint atomically, with the worlds, generators and samples of all ranks.

        When training has ended, the samples are left out.
        """
        if self.folder is None:
            return
        begun = time.monotonic()
        ended = self.iteration >= self.cfg.dagger.iterations
        worlds = {name: value.cpu() for name, value in self.environment.state().items()}
        looks = {name: value.cpu() for name, value in self._images.source.state().items()}
        images = {name: value.cpu() for name, value in self._images.state().items()}
        rank: dict[str, Any] = {"environment": worlds, "looks": looks, "images": images}
        rank |= {"started": self._started.cpu(), "taught": self._taught.cpu(), "random": random_state(self.device)}
        rank |= {"filled": 0 if ended else len(self.samples), "next": 0 if ended else self.samples.next}
        if not ended and len(self.samples):
            with self.process.raise_together():
                self.samples.save(self._samples_file(self.iteration))
        ranks = self.process.gather(rank)
        if self.process.is_rank_zero:
            document = {**self.weights(), "optimiser": self._optimiser.state_dict(), "ranks": ranks}
            document |= {"gradient steps": self.gradient_steps, "moments": self._moments.cpu(), "recent": self._recent}
            write_checkpoint(self.folder / CHECKPOINT, document)
        self.process.gather(None)  # no rank removes its samples before the checkpoint that needs the new ones is there
        for path in self.folder.glob(f"samples_{self.process.rank}_*.bin"):
            if ended or path != self._samples_file(self.iteration):
                path.unlink()
        self._saved = time.monotonic()
        self._saving = self._saved - begun

    def _samples_file(self, iteration: int) -> Path:
        """Return the file of this rank's samples at an iteration."""
        assert self.folder is not None
        return self.folder / f"samples_{self.process.rank}_{iteration}.bin"

    def begin_with(self, weights: Mapping[str, Any], where: object = None) -> None:
        """Begin with the network of another distillation.

        Args:
            weights: As `weights` returns them.
            where: Where they are from, for errors.

        Raises:
            TrainError: The network is another one.
        """
        check_state(
            weights["student"], self.network.state_dict(), "the student to begin with", where=where, error=TrainError
        )
        self.network.load_state_dict(weights["student"])
        # Its mean and standard deviation stay, whatever the first samples are.
        mean, std = (self.network.get_buffer(name).double() for name in ("mean", "std"))
        self._moments = SETTLED * torch.cat([mean, mean.square() + std.square(), mean.new_ones(1)])

    def resume(self, path: Path) -> None:
        """Restore the training of a checkpoint; it continues as if it had not stopped.

        Raises:
            TrainError: The checkpoint is of another student or another number of ranks, or its samples are not there.
        """
        document = load_student_checkpoint(path)
        ranks = document.get("ranks")
        if not isinstance(ranks, list) or len(ranks) != self.process.world_size:
            raise TrainError(
                "the distillation was started with another number of processes",
                where=path,
                expected=len(ranks) if isinstance(ranks, list) else "a list of them",
                found=self.process.world_size,
            )
        check_state(document["student"], self.network.state_dict(), "the student", where=path, error=TrainError)
        try:
            self._restore(document, ranks[self.process.rank])
        except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
            if isinstance(error, TrainError):
                raise
            found = " ".join(str(error).split())[:200] or type(error).__name__
            raise TrainError("the checkpoint holds no distillation like this one", where=path, found=found) from None

    def _restore(self, document: dict[str, Any], rank: dict[str, Any]) -> None:
        """Restore network, optimiser, worlds, samples and generators."""
        self.network.load_state_dict(document["student"])
        self._optimiser.load_state_dict(document["optimiser"])
        self.iteration, self.steps, self.seconds = (document[name] for name in ("iteration", "steps", "seconds"))
        self.gradient_steps = int(document["gradient steps"])
        self._moments.copy_(document["moments"])
        self._recent = [[float(value) for value in one] for one in document["recent"]]
        if rank["filled"]:
            self.samples.load(self._samples_file(self.iteration), int(rank["filled"]), int(rank["next"]))
        self.environment.restore(rank["environment"])
        self._images.source.restore(rank["looks"])
        self._images.restore(rank["images"], self.device)
        self._started, self._taught = (rank[name].to(self.device) for name in ("started", "taught"))
        restore_random_state(rank["random"], self.device)


def make_network(cfg: DistilCfg, proprioception: Proprioception, actions: int) -> StudentNetwork:
    """Return a student's network with random weights, on the CPU."""
    return StudentNetwork(
        len(cfg.images.cameras), cfg.images.frames, proprioception.size, actions, proprioception.objects, cfg.network
    )


def load_student_checkpoint(path: Path) -> dict[str, Any]:
    """Return the checkpoint of a distillation, with its tensors on the CPU.

    Raises:
        TrainError: The file is missing or no checkpoint of a student, or has weights that are not finite.
    """
    keys = ("student", "iteration", "steps", "seconds")
    document = read_checkpoint(path, keys=keys, finite=("student", "optimiser", "moments"), error=TrainError)
    for name in ("iteration", "steps", "seconds"):
        value = document[name]
        if not isinstance(value, int | float) or isinstance(value, bool) or value < 0:
            raise TrainError(f"{name} of the checkpoint is no count", where=path, expected="at least 0", found=value)
    return document
