"""Shadows of splats on the table: flattened along random directions of light, as an augmentation (paper, appendix E).

The paper lets objects cast shadows on the plane z = 0 alone, under randomly sampled lights. Here a light is a
direction, sampled for each episode, and takes away a share of the light of what its shadow falls on. Shadows are
soft by a blur of the image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from concent_warp.render.shadow_cfg import ShadowCfg
from concent_warp.render.splats.rasterise import Rasteriser
from concent_warp.render.splats.splats import Splats


class Shadows:
    """Shadow layers of the same objects and sizes again and again.

    Args:
        objects: splats of each object, in the object's frame.
        width: width of the images [px].
        height: their height [px].
        worlds: W.
        cameras: C, cameras in a world.
        cfg: the lights.
        device: where to render.
        generator: source of the lights; on the CPU, so that they are the same for every device.
    """

    directions: torch.Tensor
    """Where the light goes, downwards, unit length, shape (W, L, 3)."""
    strengths: torch.Tensor
    """Share of the light that each takes away, shape (W, L)."""

    def __init__(
        self,
        objects: Sequence[Splats],
        width: int,
        height: int,
        worlds: int = 1,
        cameras: int = 1,
        *,
        cfg: ShadowCfg | None = None,
        device: str | torch.device = "cpu",
        generator: torch.Generator | None = None,
    ) -> None:
        self.cfg = cfg = cfg or ShadowCfg()
        self._generator = generator
        self._shape = (worlds, cameras, cfg.lights, height, width)
        self.rasteriser = Rasteriser(
            [_caster(o, cfg.splats) for o in objects], width, height, worlds, cameras * cfg.lights, device=device,
            margin=cfg.margin, ground=cfg.ground,
        )  # fmt: skip
        self.directions = torch.zeros(worlds, cfg.lights, 3, device=self.rasteriser.device)
        self.strengths = torch.zeros(worlds, cfg.lights, device=self.rasteriser.device)
        self.sample_lights()

    def sample_lights(self, which: torch.Tensor | None = None) -> None:
        """Sample new lights for all worlds or those of a mask (W,), as at the start of an episode."""
        shape = self.strengths.shape
        first, second, third = torch.rand(3, *shape, generator=self._generator)
        low, high = (math.radians(angle) for angle in self.cfg.elevation)
        elevation, azimuth = low + (high - low) * first, 2 * math.pi * second
        level = torch.cos(elevation)
        directions = torch.stack([level * azimuth.cos(), level * azimuth.sin(), -torch.sin(elevation)], dim=-1)
        weak, strong = self.cfg.strength
        strengths = weak + (strong - weak) * third
        mask = torch.ones(shape[0], dtype=torch.bool) if which is None else which.cpu()
        mask = mask[:, None]
        self.strengths.copy_(torch.where(mask, strengths, self.strengths.cpu()))
        self.directions.copy_(torch.where(mask[..., None], directions, self.directions.cpu()))

    def render(
        self,
        object_poses: torch.Tensor,
        camera_poses: torch.Tensor,
        intrinsics: torch.Tensor,
        depth: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return the share of the light that shadows take away, shape (W, C, H, W).

        Args:
            object_poses: positions [m] and quaternions wxyz, shape (W, O, 7).
            camera_poses: the same of the cameras, shape (W, C, 7) or what broadcasts to it.
            intrinsics: pinhole matrices [px], shape (3, 3) or (W, C, 3, 3) or what broadcasts to it.
            depth: planar depth that the simulation sees [m], shape (W, C, H, W), 0 where it hides nothing, as for
                `Rasteriser.render`.
        """
        worlds, cameras, lights = self._shape[:3]

        def each(tensor: torch.Tensor, *rest: int) -> torch.Tensor:
            """One for each image: cameras of a world, and for each of these the lights."""
            return tensor.expand(worlds, cameras, *rest).repeat_interleave(lights, dim=1)

        self.rasteriser.light.copy_(self.directions.repeat(1, cameras, 1))
        layer = self.rasteriser.render(
            object_poses,
            each(camera_poses, 7),
            each(intrinsics, 3, 3),
            None if depth is None else each(depth, *self._shape[3:]),
        )
        alpha = self.soft(layer.alpha).view(self._shape)
        return 1 - (1 - self.strengths[:, None, :, None, None] * alpha).prod(dim=2)

    def soft(self, alpha: torch.Tensor) -> torch.Tensor:
        """Blur layers, shape (W, C * L, H, W)."""
        sigma = self.cfg.softness * self._shape[3]
        if sigma == 0:
            return alpha
        from kornia.filters import gaussian_blur2d

        size = 2 * math.ceil(3 * sigma) + 1
        return gaussian_blur2d(alpha, (size, size), (sigma, sigma), border_type="replicate")


def with_shadow(image: torch.Tensor, shadow: torch.Tensor) -> torch.Tensor:
    """Return an image, shape (..., H, W, 3), in the shadow, shape (..., H, W)."""
    return image * (1 - shadow[..., None])


def _caster(splats: Splats, count: int) -> Splats:
    """Return at most `count` black splats that cover what all do, grown for the gaps that the others leave."""
    chosen = splats
    if len(splats) > count:
        chosen = splats.select(splats.spread(count))
    growth = (len(splats) / len(chosen)) ** 0.5
    means, quats, scales, opacities, _ = chosen.tensors()
    return Splats(means, quats, growth * scales, opacities, torch.zeros(len(chosen), 1, 3, device=means.device))
