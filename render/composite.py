"""The hybrid image: robot and background as painted by the networks, objects as splats, their shadows, in one picture.

Paper, section 3.2.3 and appendix E. What hides what is decided by the simulation's depth: splats behind a finger are
not seen, shadows fall on the visible surfaces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import mujoco
import numpy as np
import torch
import warp as wp

from concent_warp.render.networks.painter import Painter
from concent_warp.render.networks.pairs import carrier_pose
from concent_warp.render.raw import PosedWorlds, RawCamera, body_id
from concent_warp.render.shadows import ShadowCfg, Shadows, with_shadow
from concent_warp.render.splats.rasterise import Rasteriser

if TYPE_CHECKING:
    from concent_warp.render.splats.splats import Splats


@dataclass(frozen=True)
class Layers:
    """What an image is made of, for W worlds and C cameras; colours 0..1, not clipped before the image itself."""

    raw: torch.Tensor
    """The simulation as it is, objects as contact spheres where asked, shape (W, C, H, W', 3)."""
    background: torch.Tensor
    """Robot and background, and objects that have no splats, same shape."""
    objects: torch.Tensor
    """Light of the splats, premultiplied by their opacity, same shape."""
    alpha: torch.Tensor
    """Opacity of the splats, shape (W, C, H, W')."""
    shadow: torch.Tensor
    """Share of the light that shadows of the splats take away, shape (W, C, H, W')."""
    image: torch.Tensor
    """All of it in one, shape (W, C, H, W', 3), 0..1."""

    def clone(self, world: int) -> Layers:
        """Return a copy of one world on the CPU, W = 1; the layers themselves are overwritten by the next frame."""
        names = ("raw", "background", "objects", "alpha", "shadow", "image")
        return Layers(*(getattr(self, name)[world : world + 1].detach().cpu().clone() for name in names))


def _composed(
    background: torch.Tensor, objects: torch.Tensor, alpha: torch.Tensor, shadow: torch.Tensor
) -> torch.Tensor:
    """Return the image of the layers: the background in the shadow, the objects over it; shapes as in `Layers`."""
    return (objects + (1 - alpha[..., None]) * with_shadow(background, shadow)).clamp(0, 1)


class HybridCamera:
    """Cameras that see W worlds of a scene as the real ones would, as far as networks and splats are given.

    Without networks, robot and background are those of the simulation; objects without splats are as well.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        cameras: Sequence[str],
        size: tuple[int, int],
        worlds: int,
        *,
        objects: Sequence[str] = (),
        splats: Mapping[str, Splats] | None = None,
        painter: Painter | None = None,
        shadows: ShadowCfg | None = None,
        show: Literal["visual", "spheres"] = "visual",
        device: str = "cpu",
        seed: int = 0,
    ) -> None:
        """Set all layers up.

        Args:
            model: The scene with its cameras.
            cameras: Names of the C cameras.
            size: Height and width of an image [px].
            worlds: W.
            objects: Bodies that the networks do not paint.
            splats: Looks of some of these, in the body's frame.
            painter: The networks; None to show the simulation.
            shadows: Lights that the splats' shadows are cast by; None for no shadows.
            show: What the raw layer shows of bodies with contact spheres.
            device: Warp's name of the device.
            seed: Seed of the lights.

        Raises:
            RenderError: A camera or a body is not there, or a size is not right.
        """
        self.stage = PosedWorlds(model, worlds, device=device)
        self.cameras, self.size, self.painter = tuple(cameras), size, painter
        given, where = dict(splats or {}), self.stage.device
        torch_device = str(wp.device_to_torch(where))
        self._bodies = torch.tensor([body_id(model, name) for name in given], dtype=torch.long, device=torch_device)
        self._raw = RawCamera(self.stage, cameras, size, objects=show)
        plain = [name for name in objects if name not in given]
        # The surfaces that hide splats: everything but the objects that the splats stand for.
        self._solid = (
            RawCamera(self.stage, cameras, size, leave_out=list(given)) if given or show != "visual" else self._raw
        )
        self._empty = (
            RawCamera(self.stage, cameras, size, leave_out=list(objects)) if painter and plain else self._solid
        )
        geoms = np.flatnonzero(np.isin(model.geom_bodyid, [body_id(model, name) for name in plain]))
        self._plain = torch.as_tensor(geoms, dtype=torch.int32, device=torch_device)
        height, width = size
        self._intrinsics = torch.as_tensor(self._raw.intrinsics(), dtype=torch.float32, device=torch_device)
        self._rasteriser = self._shadows = None
        if given:
            options = {"worlds": worlds, "cameras": len(self.cameras), "device": torch_device}
            self._rasteriser = Rasteriser(list(given.values()), width, height, **options)
            if shadows is not None:
                generator = torch.Generator().manual_seed(seed)
                self._shadows = Shadows(
                    list(given.values()), width, height, cfg=shadows, generator=generator, **options
                )
        self._carriers = (
            [] if painter is None else [painter.cameras[name] for name in cameras if name in painter.cameras]
        )
        self.begin()

    def begin(self, which: torch.Tensor | None = None) -> None:
        """Begin episodes in all worlds, or in those of a mask (W,) bool: painting starts anew, under other lights."""
        if self.painter is not None:
            self.painter.begin(self.stage.worlds, which)
        if self._shadows is not None:
            self._shadows.sample_lights(which)

    def shoot(
        self,
        qpos: torch.Tensor | np.ndarray,
        mocap: tuple[torch.Tensor | np.ndarray, torch.Tensor | np.ndarray] | None = None,
    ) -> Layers:
        """Return the next frame of every world; the next call overwrites it.

        Args:
            qpos: States, shape (W, nq).
            mocap: Places [m] (W, nmocap, 3) and orientations wxyz (W, nmocap, 4) of what is fixed where a world has it.
        """
        self.stage.place(qpos, mocap)
        whole = self._raw.render()
        solid = whole if self._solid is self._raw else self._solid.render()
        background = solid.rgb
        if self.painter is not None:
            empty = solid.rgb if self._empty is self._solid else self._empty.render().rgb
            poses = [carrier_pose(self.stage, camera) for camera in self._carriers]
            background = self.painter.paint(self.cameras, empty, poses)
            if len(self._plain):
                shown = torch.isin(solid.segmentation, self._plain)[..., None]
                background = torch.where(shown, solid.rgb, background)
        alpha = torch.zeros_like(solid.depth)
        objects, shadow = torch.zeros_like(background), alpha
        if self._rasteriser is not None:
            eyes = self.stage.camera_poses(self.cameras)
            places = torch.cat([self.stage.position[:, self._bodies], self.stage.quaternion[:, self._bodies]], dim=-1)
            layer = self._rasteriser.render(places, eyes, self._intrinsics, solid.depth)
            objects, alpha = layer.rgb, layer.alpha
            if self._shadows is not None:
                shadow = self._shadows.render(places, eyes, self._intrinsics, solid.depth)
        image = _composed(background, objects, alpha, shadow)
        return Layers(whole.rgb, background, objects, alpha, shadow, image)
