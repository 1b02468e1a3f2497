"""Robot and background as a real camera sees them, painted frame by frame by the trained networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch

from concent_warp.checkpoint_file import check_state
from concent_warp.errors import RenderError
from concent_warp.render.cameras import Camera
from concent_warp.render.networks.cfg import FlowNetworkCfg, SuperResolutionCfg
from concent_warp.render.networks.flow import sample_images
from concent_warp.render.networks.flow_network import FlowNetwork
from concent_warp.render.networks.super_resolution import SuperResolution, downsampled
from concent_warp.render.networks.train import CHECKPOINT, ENLARGE, load_checkpoint, network_of

Network = TypeVar("Network", bound=torch.nn.Module)


class Painter:
    """Paints the frames of W worlds by C cameras; each frame follows from the one painted before."""

    def __init__(
        self,
        networks: dict[str, FlowNetwork],
        references: dict[str, torch.Tensor],
        cameras: dict[str, Camera],
        enlarge: SuperResolution,
        *,
        steps: int = 4,
        seed: int = 0,
        half: bool = False,
    ) -> None:
        """Create the painter.

        Args:
            networks: Flow by camera.
            references: Mean image of each camera, shape (3, S, S), with which painting begins.
            cameras: Where they are.
            enlarge: Super-resolution.
            steps: Steps of the flow, fewer are quicker.
            seed: Seed of the noise.
            half: Multiply in bfloat16, which is quicker on a GPU.
        """
        self.networks, self.references, self.cameras, self.enlarge = networks, references, cameras, enlarge
        self.device, self.steps, self.half = next(enlarge.parameters()).device, steps, half
        self.size = next(iter(networks.values())).cfg.size
        self._generator = torch.Generator(self.device).manual_seed(seed)
        self._previous: dict[str, torch.Tensor] = {}

    @staticmethod
    def load(folder: Path, *, device: str = "cpu", steps: int = 4, seed: int = 0, half: bool = False) -> Painter:
        """Return the painter of a run folder of `concent render-train`, with the running means of the weights.

        Raises:
            RenderError: There is nothing of the kind.
        """
        path = folder / CHECKPOINT if folder.is_dir() else folder
        state = load_checkpoint(path)
        networks, references, cameras = {}, {}, {}
        try:
            cfg, trainings = state["cfg"], state["trainings"]
            base = FlowNetworkCfg(**cfg["network"])
            for described, reference in zip(state["cameras"], state["references"], strict=True):
                camera = Camera(**described)
                sizes = network_of(base, camera)
                networks[camera.name] = _averaged(lambda sizes=sizes: FlowNetwork(sizes), trainings[camera.name], path)
                if tuple(reference.shape) != (3, base.size, base.size):
                    raise ValueError(f"a mean image of shape {tuple(reference.shape)}")
                references[camera.name], cameras[camera.name] = reference.to(device), camera
            enlarge = _averaged(
                lambda: SuperResolution(SuperResolutionCfg(**cfg["super_resolution"])), trainings[ENLARGE], path
            )
        except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
            if isinstance(error, RenderError):
                raise
            found = " ".join(str(error).split())[:200] or type(error).__name__
            raise RenderError("the networks cannot be read", where=path, found=found) from None
        networks = {name: network.to(device).eval() for name, network in networks.items()}
        return Painter(networks, references, cameras, enlarge.to(device).eval(), steps=steps, seed=seed, half=half)

    def begin(self, worlds: int, which: torch.Tensor | None = None) -> None:
        """Begin episodes in W worlds, or in those of a mask (W,) bool alone."""
        for name, reference in self.references.items():
            fresh = reference.expand(worlds, -1, -1, -1)
            before = self._previous.get(name)
            if which is None or before is None:
                self._previous[name] = fresh.clone()
            else:
                self._previous[name] = torch.where(which[:, None, None, None], fresh, before)

    @torch.no_grad()
    def paint(self, cameras: Sequence[str], simulated: torch.Tensor, poses: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the next frames, colours 0..1, shape (W, C, H, W', 3).

        Args:
            cameras: Names of the C cameras.
            simulated: The simulation's colours without the objects, 0..1, shape (W, C, H, W', 3).
            poses: Poses of the bodies that carry them, shape (W, 9) each.

        Raises:
            RenderError: There is no network for a camera, or images are not of the size that these paint.
        """
        if missing := [name for name in cameras if name not in self.networks]:
            raise RenderError(
                "no network was trained for this camera", expected=f"some of {list(self.networks)}", found=missing
            )
        if tuple(simulated.shape[2:4]) != (4 * self.size, 4 * self.size):
            raise RenderError(
                "the networks paint images of another size", expected=4 * self.size, found=tuple(simulated.shape[2:4])
            )
        frames = []
        for c, name in enumerate(cameras):
            seen = downsampled(simulated[:, c].permute(0, 3, 1, 2).to(self.device), self.size)
            # Rounded to 8 bits like the training images.
            seen = (255 * seen).round() / 127.5 - 1
            network = self.networks[name]
            pose = poses[c].to(self.device) if network.cfg.posed else None
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.half):
                painted = sample_images(
                    network, seen, self._previous[name], pose, steps=self.steps, generator=self._generator
                )
                large = self.enlarge(painted).float()
            self._previous[name] = painted
            frames.append(((large + 1) / 2).clamp(0, 1).permute(0, 2, 3, 1))
        return torch.stack(frames, dim=1)

    def small(self, camera: str) -> torch.Tensor:
        """Return what the flow painted last, before super-resolution, in -1..1, shape (W, 3, S, S)."""
        return self._previous[camera]


def _averaged(make: Callable[[], Network], training: dict[str, Any], path: Path) -> Network:
    """Return a network with the running means of the weights, which an `AveragedModel` keeps.

    Raises:
        RenderError: They are not those of such a network; its memory is not allocated then.
    """
    mean = {name.removeprefix("module."): v for name, v in training["mean"].items() if name.startswith("module.")}
    with torch.device("meta"):
        expected = make().state_dict()
    check_state(mean, expected, "a network", where=path, error=RenderError)
    network = make()
    network.load_state_dict(mean)
    return network
