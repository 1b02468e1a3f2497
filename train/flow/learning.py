"""Training of a flow policy's network: AdamW on the loss of the flow, a running mean of the weights, checkpoints.

All random numbers of a step follow from the seed and the number of the step, so that a continued training is identical
to one that was not interrupted.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.optim.swa_utils import AveragedModel

from concent_warp.checkpoint_file import check_state, read_checkpoint, write_checkpoint
from concent_warp.errors import TrainError
from concent_warp.limits import limits, raising
from concent_warp.run_folder import TRAIN_CHECKPOINT, plain
from concent_warp.train.distil.augmentation import augmented
from concent_warp.train.flow.cfg import TrainFlowCfg
from concent_warp.train.flow.dataset import FlowDataset
from concent_warp.train.flow.frames import FrameFiles
from concent_warp.train.flow.network import FlowPolicyNetwork
from concent_warp.train.learning.metrics import Point, curve

MIN_STD = 1e-4
"""Smallest standard deviation by which numbers are normalised, in their unit: that of a constant is 0."""
STATE_COPIES = 4
"""Copies of the weights in a checkpoint: weights, running mean and the two moments of AdamW."""
WEIGHTS = ("network", "mean")
"""Parts of a checkpoint that hold weights."""


@dataclass(frozen=True)
class FlowStep:
    """Where a training is."""

    done: int
    """Steps so far."""
    steps: int
    """Steps in all."""
    loss: float
    """Mean loss since the last report [-]."""
    validation: float | None
    """Loss in the last validation [-]; None before the first, and without one."""
    left: float
    """Time left, from the pace of this process [s]."""


class FlowTraining:
    """A network in training on a data set."""

    def __init__(
        self, data: FlowDataset, cfg: TrainFlowCfg, folder: Path | None = None, *, device: str = "cpu"
    ) -> None:
        """Make the network.

        Args:
            data: The data set.
            cfg: Settings.
            folder: Where checkpoints and metrics go; None for nowhere.
            device: Torch's name of the device.

        Raises:
            TrainError: The weights of the backbone are missing, an instruction is too long, or a checkpoint would be
                larger than what can be read.
        """
        self.data, self.cfg, self.folder, self.device = data, cfg, folder, torch.device(device)
        self.done, self.seconds = 0, 0.0
        self.validation: float | None = None
        self.losses: list[torch.Tensor] = []
        self._between = True
        self.training, self.held = data.split(cfg.data.validation, cfg.seed)
        features = data.features
        with _random(self.device):
            torch.manual_seed(cfg.seed)
            self.network = FlowPolicyNetwork(
                cfg.policy, len(features.cameras), len(features.state), len(features.action)
            )
        _set_statistics(self.network, data, self.training)
        self.ids, self.mask = (part.to(self.device) for part in self.network.tokens_of(features.tasks))
        self.network.to(self.device)
        self.mean = AveragedModel(self.network, multi_avg_fn=_running_mean(cfg.ema))
        self.optimiser = torch.optim.AdamW(
            _groups(self.network, cfg.weight_decay), lr=cfg.peak, betas=(0.9, 0.95), fused=self.device.type == "cuda"
        )
        if folder is not None:
            self._check_size()
        self._state, self._action = (torch.from_numpy(values).to(self.device) for values in (data.state, data.action))
        self._task, self._last = (torch.from_numpy(v).to(self.device) for v in (data.task, data.last()))
        self._take_labels()
        self._images: torch.Tensor | list[np.ndarray] = []

    def learn(self, report: Callable[[FlowStep], None] | None = None) -> None:
        """Train until all steps are done; a checkpoint is left when interrupted.

        Raises:
            TrainError: The loss became non-finite.
        """
        cfg, begun, first, before = self.cfg, time.monotonic(), self.done, self.seconds
        saved = reported = begun
        with _random(self.device), self._curve() as write, ThreadPoolExecutor(1) as pool:
            self.network.train()
            waiting = pool.submit(self._batch, self.done)
            try:
                if self.losses and self._is_validated_now():  # which an interruption prevented
                    self._validate(write)
                while self.done < cfg.steps:
                    rows, images = waiting.result()
                    if self.done + 1 < cfg.steps:
                        waiting = pool.submit(self._batch, self.done + 1)
                    self.losses.append(self._step(rows, images))
                    now, validated = time.monotonic(), self._is_validated_now()
                    if not (validated or self.done % LOSSES == 0 or now - reported > REPORT_PERIOD):
                        continue
                    loss, reported = self._mean_loss(), now
                    self.seconds = before + now - begun
                    if validated:
                        self._validate(write)
                    elif self.done % LOSSES == 0:
                        self.losses = []
                    left = (now - begun) / (self.done - first) * (cfg.steps - self.done)
                    if report is not None:
                        report(FlowStep(self.done, cfg.steps, loss, self.validation, left))
                    if now - saved > cfg.checkpoint:
                        self.save()
                        saved = now
            except TrainError:
                raise  # weights that are not finite are not worth keeping
            except BaseException:
                if self._between:  # else the last checkpoint is the latest whole state
                    self.save()
                raise
        self.save()

    def _is_validated_now(self) -> bool:
        """Return whether there is a validation after the present number of steps."""
        return self.done % self.cfg.validate == 0 or self.done == self.cfg.steps

    def _validate(self, write: Callable[[Point], None]) -> None:
        """Compute the loss of the validation, if there is one, and write the metrics of this step."""
        if len(self.held):
            self.validation = self.validated()
        write(self._point(self._mean_loss()))
        self.losses = []

    def _mean_loss(self) -> float:
        """Return the mean of the latest losses.

        Raises:
            TrainError: It is not finite.
        """
        loss = float(torch.stack(self.losses).mean())
        if not math.isfinite(loss):
            fix = "lower the learning rate"
            raise TrainError(f"the loss is not finite after {self.done} steps", found=loss, fix=fix)
        return loss

    def _step(self, rows: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
        """Take an optimiser step on frames (N,) with images (N, K, S, S, 3) uint8, and return the loss."""
        torch.manual_seed(step_seed(self.cfg.seed, self.done))
        rows, images = rows.to(self.device), images.to(self.device)
        for group in self.optimiser.param_groups:
            group["lr"] = self.cfg.peak * self.rate()
        with self._half():
            shown = augmented(images.permute(0, 1, 4, 2, 3).float() / 255, self.cfg.augment)
            blank = torch.rand(len(rows), device=self.device) < self.cfg.blank_state
            loss = self._loss(self.network, rows, shown, blank=blank).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.cfg.gradient)
        self._between = False
        self.optimiser.step()
        self.mean.update_parameters(self.network)
        self.done += 1
        self._between = True
        return loss.detach()

    def _loss(
        self,
        network: FlowPolicyNetwork,
        rows: torch.Tensor,
        images: torch.Tensor,
        *,
        blank: torch.Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> torch.Tensor:
        """Return the losses of frames (N,) with images (N, K, 3, S, S) in 0..1, shape (N,)."""
        task = self._task[rows]
        context, mask = network.context(images, self._state[rows], self.ids[task], self.mask[task], blank)
        actions = self._chunks(rows)
        given: dict[str, Any] = {"device": self.device, "generator": generator}
        noise = torch.randn(actions.shape, **given)
        return network.loss(context, mask, actions, noise, torch.rand(len(rows), **given))

    def _take_labels(self) -> None:
        """Keep the labels of the frames that have one.

        Raises:
            TrainError: They are shorter than the policy's chunks.
        """
        labels, length = self.data.labels, self.cfg.policy.chunk
        self._labels: tuple[torch.Tensor, torch.Tensor] | None = None
        if labels is None:
            return
        if labels.shape[1] < length:
            fix = "render them with a longer --handover.chunk, choose a shorter --policy.chunk, or --data.no-labels"
            raise TrainError(
                "labels of the data set are shorter than the policy's chunks", expected=f"at least {length} commands",
                found=labels.shape[1], fix=fix,
            )  # fmt: skip
        rows = np.flatnonzero(np.isfinite(labels[:, 0, 0]))
        row_of = np.zeros(len(labels), dtype=np.int64)  # row 0 stands for none
        row_of[rows] = 1 + np.arange(len(rows))
        kept = np.concatenate([np.zeros_like(labels[:1, :length]), labels[rows, :length]])
        self._labels = torch.from_numpy(row_of).to(self.device), torch.from_numpy(kept).to(self.device)

    def _chunks(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the chunks that frames (N,) are to predict, shape (N, C, A): labels where there are any."""
        shown = self._action[self._ahead(rows)]
        if self._labels is None:
            return shown
        row_of, labels = self._labels
        label = row_of[rows]
        return torch.where((label > 0)[:, None, None], labels[label], shown)

    def _ahead(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the frames whose actions are the chunks of frames (N,), shape (N, C): the last one of an episode stays
        when there are no more.
        """
        ahead = rows[:, None] + torch.arange(self.cfg.policy.chunk, device=rows.device)
        return torch.minimum(ahead, self._last[rows][:, None])

    @torch.no_grad()
    def validated(self) -> float:
        """Return the loss of the running mean of the weights on the validation's frames, noise and times the same."""
        network: Any = self.mean.module
        network.eval()
        count = min(self.cfg.validation_samples, len(self.held))
        chosen = torch.from_numpy(self.held[np.linspace(0, len(self.held) - 1, count).astype(int)])
        generator = torch.Generator(self.device).manual_seed(self.cfg.seed)
        found = []
        for rows in chosen.split(self.cfg.batch):
            images = self._gathered(rows).to(self.device).permute(0, 1, 4, 2, 3).float() / 255
            with self._half():
                found.append(self._loss(network, rows.to(self.device), images, generator=generator))
        return float(torch.cat(found).mean())

    def rate(self) -> float:
        """Return the learning rate relative to the largest."""
        if self.done < self.cfg.warm_up:
            return (self.done + 1) / self.cfg.warm_up
        share = (self.done - self.cfg.warm_up) / max(self.cfg.steps - self.cfg.warm_up, 1)
        return 0.1 + 0.9 * (1 + math.cos(math.pi * min(share, 1.0))) / 2

    def _batch(self, step: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the frames of a step (N,), chosen at random with replacement, and their images."""
        generator = np.random.default_rng([self.cfg.seed, step])
        rows = torch.from_numpy(self.training[generator.integers(len(self.training), size=self.cfg.batch)])
        return rows, self._gathered(rows)

    def _gathered(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the images of frames (N,), shape (N, K, S, S, 3) uint8."""
        if isinstance(self._images, torch.Tensor):
            return self._images[:, rows.to(self._images.device)].transpose(0, 1)
        order, back = np.unique(rows.numpy(), return_inverse=True)  # the disk is read in order
        return torch.from_numpy(np.stack([array[order][back] for array in self._images], axis=1))

    def open_images(self, frames: FrameFiles) -> None:
        """Take the images to learn from: to the GPU where there is room, else from the disk as they are needed."""
        self._images = arrays = frames.arrays()
        if self.device.type != "cuda":
            return
        free, _ = torch.cuda.mem_get_info(self.device)
        if frames.bytes > self.cfg.device_share * free:
            return
        found = torch.empty((len(arrays), *arrays[0].shape), dtype=torch.uint8, device=self.device)
        for camera, array in enumerate(arrays):
            for first in range(0, len(array), BLOCK):
                found[camera, first : first + BLOCK] = torch.from_numpy(array[first : first + BLOCK].copy())
        self._images = found

    def _half(self) -> torch.autocast:
        """Return the context of bfloat16, without effect on a CPU."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.cfg.half and self.device.type == "cuda")

    def _point(self, loss: float) -> Point:
        """Return the metrics of this step."""
        point = {
            "steps": self.done,
            "seconds": self.seconds,
            "loss": loss,
            "learning rate": self.cfg.peak * self.rate(),
        }
        return point if self.validation is None else {**point, "validation loss": self.validation}

    @contextmanager
    def _curve(self) -> Iterator[Callable[[Point], None]]:
        """Yield what writes metrics to the folder, without effect without one."""
        if self.folder is None:
            yield lambda _: None
            return
        with curve(self.folder, self.done) as write:
            yield write

    def save(self) -> None:
        """Write a checkpoint atomically."""
        if self.folder is None:
            return
        state = {
            **self.described(),
            "episodes": self.data.start.tolist(),
            "network": self.network.state_dict(),
            "mean": self.mean.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "done": self.done,
            "seconds": self.seconds,
            "validation": self.validation,
            "losses": torch.stack(self.losses).cpu() if self.losses else torch.zeros(0),
        }
        write_checkpoint(self.folder / TRAIN_CHECKPOINT, state)

    def described(self) -> dict[str, Any]:
        """Return what makes the policy without its weights, as plain data."""
        return {
            "policy": plain(replace(self.cfg.policy, weights=None)),
            "features": self.data.features.plain(),
            "backbone": self.network.described_backbone(),
        }

    def resume(self) -> None:
        """Restore the folder's checkpoint.

        Raises:
            TrainError: It was begun with other settings or another data set, or is none of a flow policy.
        """
        assert self.folder is not None
        state = read_training(self.folder)
        now = self.data.features.plain(), self.data.start.tolist()
        if (state["features"], state["episodes"]) != now:
            fix = "give the same data set, or start anew with --overwrite"
            raise TrainError("this training was begun with another data set", where=self.folder, fix=fix)
        for name, module in (("network", self.network), ("mean", self.mean)):
            check_state(
                state[name], module.state_dict(), "the checkpoint's network", where=self.folder, error=TrainError
            )
            module.load_state_dict(state[name])
        try:
            self.optimiser.load_state_dict(state["optimiser"])
        except (ValueError, KeyError, TypeError) as error:
            raise TrainError("the optimiser has another state", where=self.folder, found=error) from None
        self.done, self.seconds, self.validation = int(state["done"]), float(state["seconds"]), state["validation"]
        self.losses = list(state["losses"].to(self.device))

    def _check_size(self) -> None:
        """Raise an error where checkpoints would be too large to be read, before anything is learned."""
        weights = sum(p.numel() * p.element_size() for p in self.network.parameters())
        size, most = STATE_COPIES * weights, limits().checkpoint_bytes
        if size > most:
            fix = raising("checkpoint_bytes")
            raise TrainError("checkpoints would be too large", expected=f"at most {most} bytes", found=size, fix=fix)


LOSSES = 20
"""Latest steps whose mean loss is reported, at most."""
REPORT_PERIOD = 1.0
"""Time between reports of progress, at most [s]."""
BLOCK = 4096
"""Frames that go to the GPU at once."""


def read_training(folder: Path) -> dict[str, Any]:
    """Return the checkpoint of a training in its run folder.

    Raises:
        TrainError: It is missing or of something else, or has weights that are not finite.
    """
    keys = (
        "policy", "features", "backbone", "episodes", "network", "mean", "optimiser", "done", "seconds", "validation",
        "losses",
    )  # fmt: skip
    return read_checkpoint(folder / TRAIN_CHECKPOINT, keys=keys, finite=WEIGHTS, error=TrainError)


def step_seed(seed: int, step: int) -> int:
    """Return the seed of a step's random numbers."""
    return int.from_bytes(hashlib.sha256(f"{seed} {step}".encode()).digest()[:8]) >> 1


def _set_statistics(network: FlowPolicyNetwork, data: FlowDataset, rows: np.ndarray) -> None:
    """Set mean and standard deviation of states and actions to those of the training's frames."""
    for name, values in (("state", data.state[rows]), ("action", data.action[rows])):
        mean, std = values.mean(axis=0, dtype=float), values.std(axis=0, dtype=float)
        getattr(network, f"{name}_mean").copy_(torch.from_numpy(mean))
        getattr(network, f"{name}_std").copy_(torch.from_numpy(np.where(std < MIN_STD, 1.0, std)))


def _groups(network: torch.nn.Module, decay: float) -> list[dict[str, Any]]:
    """Return the parameters in two groups: matrices, which decay, and others."""
    parameters = [p for p in network.parameters() if p.requires_grad]
    kinds = ([p for p in parameters if p.ndim > 1], [p for p in parameters if p.ndim <= 1])
    return [{"params": p, "weight_decay": d} for p, d in zip(kinds, (decay, 0.0), strict=True)]


@contextmanager
def _random(device: torch.device) -> Iterator[None]:
    """Leave torch's own random numbers as they were before the context."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        yield


def _running_mean(
    most: float,
) -> Callable[[Sequence[torch.Tensor], Sequence[torch.Tensor], torch.Tensor | int], None]:
    """Return what moves means towards weights, the more the fewer steps there were.

    Args:
        most: Share of the mean that a step keeps, after many steps.
    """

    @torch.no_grad()
    def update(means: Any, weights: Any, count: torch.Tensor | int) -> None:
        kept = min(most, (1 + int(count)) / (10 + int(count)))
        torch._foreach_lerp_(means, weights, 1 - kept)  # pyright: ignore[reportPrivateImportUsage]

    return update
