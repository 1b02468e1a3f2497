"""Training of the networks that paint robot and background: a flow for each camera, one super-resolution for all.

Checkpoints hold weights, their running mean, optimiser and generators, so that a continued training is identical.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from concent_warp.checkpoint_file import read_checkpoint, write_checkpoint
from concent_warp.checks import check_settings
from concent_warp.errors import RenderError
from concent_warp.render.cameras import Camera
from concent_warp.render.networks.cfg import FlowNetworkCfg, NetworkTrainCfg, RenderTrainCfg
from concent_warp.render.networks.flow import flow_loss
from concent_warp.render.networks.flow_network import FlowNetwork
from concent_warp.render.networks.pairs import ImagePairs, to_signed
from concent_warp.render.networks.super_resolution import SCALE_FACTOR, SuperResolution, downsampled

CHECKPOINT = "checkpoint.pt"
"""File of the state of a training."""
Report = Callable[[str, float], None]
"""Called with a network's name and its loss."""


class NetworkTraining:
    """A network in training: weights, running mean, optimiser and number of steps."""

    def __init__(self, network: torch.nn.Module, cfg: NetworkTrainCfg) -> None:
        """Create optimiser and running mean."""
        self.network, self.cfg, self.done = network, cfg, 0
        self.mean = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(cfg.ema), use_buffers=True)
        self.optimiser = torch.optim.Adam(network.parameters(), lr=cfg.learning_rate)

    def step(self, loss: torch.Tensor) -> None:
        """Take an optimiser step on a loss."""
        self.optimiser.param_groups[0]["lr"] = self.cfg.learning_rate * self.rate()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.mean.update_parameters(self.network)
        self.done += 1

    def rate(self) -> float:
        """Return the learning rate relative to the largest."""
        if self.done < self.cfg.warm_up:
            return (self.done + 1) / self.cfg.warm_up
        share = (self.done - self.cfg.warm_up) / max(self.cfg.steps - self.cfg.warm_up, 1)
        return 0.1 + 0.45 * (1 + math.cos(math.pi * min(share, 1.0)))

    def state(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        return {
            "network": self.network.state_dict(),
            "mean": self.mean.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "done": self.done,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Set the state that `state` returned."""
        self.network.load_state_dict(state["network"])
        self.mean.load_state_dict(state["mean"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.done = state["done"]


class RenderTraining:
    """All networks of a recording's cameras."""

    def __init__(
        self, pairs: Sequence[ImagePairs], cfg: RenderTrainCfg, folder: Path | None = None, *, device: str = "cpu"
    ) -> None:
        """Make the networks.

        Args:
            pairs: What to learn from, by camera.
            cfg: Settings.
            folder: Where checkpoints go; None for nowhere.
            device: Torch's name of the device.

        Raises:
            RenderError: The images are not four times as large as the flow's, or there are none.
        """
        size = cfg.network.size
        for one in pairs:
            if tuple(one.real.shape[2:]) != (SCALE_FACTOR * size, SCALE_FACTOR * size):
                raise RenderError(
                    "the camera's images have another size than the networks paint",
                    where=one.camera.name,
                    expected=f"{SCALE_FACTOR * size} x {SCALE_FACTOR * size}",
                    found=" x ".join(map(str, one.real.shape[2:])),
                    fix="crop and resize the images, or choose another size",
                )
        check_settings(cfg, RenderError)
        self.cfg, self.folder, self.device = cfg, folder, torch.device(device)
        self.pairs = [one.to(self.device) for one in pairs]
        torch.manual_seed(cfg.seed)
        self.generator = torch.Generator(self.device).manual_seed(cfg.seed)
        self.small = [_small_pairs(one, size) for one in self.pairs]
        self.reference = [to_signed(one.real).mean(dim=0) if len(one) else None for one in self.small]
        self.trainings: dict[str, NetworkTraining] = {}
        for one in self.pairs:
            network = FlowNetwork(network_of(cfg.network, one.camera))
            self.trainings[one.camera.name] = NetworkTraining(self._placed(network), cfg.flow)
        enlarge = SuperResolution(cfg.super_resolution)
        self.trainings[ENLARGE] = NetworkTraining(self._placed(enlarge), cfg.enlarge)

    def _placed(self, network: torch.nn.Module) -> torch.nn.Module:
        """Return a network on the device, channels last, which convolutions are quicker with."""
        return network.to(self.device).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @property
    def steps(self) -> int:
        """Steps of all networks together."""
        return sum(one.cfg.steps for one in self.trainings.values())

    def learn(self, report: Report | None = None) -> None:
        """Train until every network has had its steps; a checkpoint is left when interrupted."""
        saved = time.monotonic()
        try:
            for name, training in self.trainings.items():
                training.network.train()
                while training.done < training.cfg.steps:
                    with torch.autocast(self.device.type, torch.bfloat16, enabled=self.cfg.half):
                        loss = self.loss(name)
                    training.step(loss)
                    if report is not None and (training.done % 20 == 0 or training.done == training.cfg.steps):
                        report(name, float(loss.detach()))
                    if time.monotonic() - saved > self.cfg.checkpoint:
                        self.save()
                        saved = time.monotonic()
        finally:
            self.save()

    def loss(self, name: str) -> torch.Tensor:
        """Return the loss of a random batch for a network."""
        if name == ENLARGE:
            return self.enlarging_loss()
        which = [one.camera.name for one in self.pairs].index(name)
        small, reference = self.small[which], self.reference[which]
        assert reference is not None
        rows = torch.randint(len(small), (self.cfg.flow.batch,), generator=self.generator, device=self.device)
        before = small.before[rows]
        ago = torch.randint(1, self.cfg.augment.back + 1, rows.shape, generator=self.generator, device=self.device)
        for k in range(1, self.cfg.augment.back):
            older = torch.where(before >= 0, small.before[before], before)
            before = torch.where((ago > k) & (older >= 0), older, before)
        previous = torch.where((before >= 0)[:, None, None, None], to_signed(small.real[before]), reference)
        previous = self.augmented(previous, reference)
        pose = small.pose[rows] if small.camera.moves else None
        image, simulated = to_signed(small.real[rows]), to_signed(small.simulated[rows])
        return flow_loss(self.trainings[name].network, image, simulated, previous, pose, self.generator)

    def augmented(self, previous: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
        """Return previous images in -1..1, shape (N, 3, S, S), some of them degraded like generated ones."""
        import kornia.augmentation as augmentation

        cfg = self.cfg.augment
        spoil = augmentation.AugmentationSequential(
            augmentation.ColorJiggle(cfg.colour, cfg.colour, cfg.colour, 0.0, p=0.5),
            augmentation.RandomGaussianBlur((3, 3), (0.4, 1.0), p=cfg.blur),
        )
        given = {"generator": self.generator, "device": self.device}
        spoilt = 2 * spoil((previous + 1) / 2).clamp(0, 1) - 1
        level = cfg.noise * torch.rand((len(previous), 1, 1, 1), **given)
        spoilt = spoilt + level * torch.randn(previous.shape, **given)
        blank = torch.rand((len(previous), 1, 1, 1), **given) < cfg.blank
        return torch.where(blank, reference, spoilt)

    def enlarging_loss(self) -> torch.Tensor:
        """Return the super-resolution's L1 on random pieces of the real images."""
        cfg, crop = self.cfg.enlarge, self.cfg.crop
        large, small = [], []
        for _ in range(cfg.batch):
            which, row, v, u = (self.pick(n) for n in (len(self.pairs), 1 << 30, 1 << 30, 1 << 30))
            one, less = self.pairs[which], self.small[which]
            row, room = row % len(one), self.cfg.network.size - crop + 1
            v, u = v % room, u % room
            small.append(less.real[row, :, v : v + crop, u : u + crop])
            v, u, edge = SCALE_FACTOR * v, SCALE_FACTOR * u, SCALE_FACTOR * crop
            large.append(one.real[row, :, v : v + edge, u : u + edge])
        given = to_signed(torch.stack(small))
        # Images of the flow are noisier than downscaled ones.
        given = given + 0.02 * torch.randn(given.shape, generator=self.generator, device=self.device)
        return torch.nn.functional.l1_loss(self.trainings[ENLARGE].network(given), to_signed(torch.stack(large)))

    def pick(self, count: int) -> int:
        """Return a random number below `count`."""
        return int(torch.randint(count, (), generator=self.generator, device=self.device))

    def save(self) -> None:
        """Write a checkpoint atomically."""
        if self.folder is None:
            return
        state = {
            "cfg": asdict(self.cfg),
            "cameras": [asdict(one.camera) for one in self.pairs],
            "references": [reference.cpu() for reference in self.reference if reference is not None],
            "trainings": {name: training.state() for name, training in self.trainings.items()},
            "generator": self.generator.get_state(),
            "random": torch.get_rng_state(),
        }
        if self.device.type == "cuda":
            state["random of the device"] = torch.cuda.get_rng_state(self.device)
        write_checkpoint(self.folder / CHECKPOINT, state)

    def resume(self) -> None:
        """Restore the folder's checkpoint.

        Raises:
            RenderError: It was begun with other settings, or of other cameras.
        """
        assert self.folder is not None
        state = load_checkpoint(self.folder / CHECKPOINT)
        before, now = _flat(state["cfg"]), _flat(asdict(self.cfg))
        differing = [n for n in sorted(before | now) if before.get(n) != now.get(n) and n not in FREE]
        names = [camera["name"] for camera in state["cameras"]]
        if differing or names != [one.camera.name for one in self.pairs]:
            raise RenderError(
                "this training was begun with other settings",
                where=self.folder,
                expected=", ".join([f"{n} {before.get(n)}" for n in differing] or [f"cameras {names}"]),
                fix="repeat them, or start anew with --overwrite",
            )
        for name, training in self.trainings.items():
            training.restore(state["trainings"][name])
        self.generator.set_state(state["generator"].cpu())
        torch.set_rng_state(state["random"].cpu())
        if self.device.type == "cuda" and "random of the device" in state:
            torch.cuda.set_rng_state(state["random of the device"].cpu(), self.device)


ENLARGE = "super-resolution"
"""Name of the network that no camera has."""
FREE = ("checkpoint",)
"""Settings that do not affect the result."""


def network_of(cfg: FlowNetworkCfg, camera: Camera) -> FlowNetworkCfg:
    """Return the sizes of a camera's network."""
    return replace(cfg, posed=camera.moves)


def _small_pairs(pairs: ImagePairs, size: int) -> ImagePairs:
    """Return the pairs at the size that the flow paints."""

    def less(images: torch.Tensor) -> torch.Tensor:
        parts = [downsampled(part.float(), size).round().clamp(0, 255).to(torch.uint8) for part in images.split(64)]
        return torch.cat(parts)

    return replace(pairs, real=less(pairs.real), simulated=less(pairs.simulated))


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Return a checkpoint, with its tensors on the CPU.

    Raises:
        RenderError: It is missing or no checkpoint of these networks, holds more than tensors and plain data, or has
            weights that are not finite.
    """
    if not path.exists():
        raise RenderError("there are no trained networks", where=path, fix="train them with concent render-train")
    keys = ("trainings", "cfg", "cameras", "references")
    return read_checkpoint(path, keys=keys, finite=("trainings", "references"), error=RenderError)


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their dotted names."""
    if not isinstance(value, dict):
        return {prefix: list(value) if isinstance(value, tuple) else value}
    return {k: v for name, part in value.items() for k, v in _flat(part, f"{prefix}.{name}".lstrip(".")).items()}
