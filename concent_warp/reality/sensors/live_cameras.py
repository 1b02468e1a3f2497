"""Colour cameras of Reality that a policy acts by: images of many worlds at once, with the faults of real cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import mujoco
import numpy as np

from concent_warp.checks import Bounds, Duration, Positive, Share
from concent_warp.reality.appearance.surroundings import furnish
from concent_warp.reality.sensors.footage import still_world, vignette
from concent_warp.scene.cameras import add_cameras

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class LiveCamerasCfg:
    """Faults of Reality's cameras: of optics, sensor, mounting and transmission."""

    noise: Annotated[float, Bounds(0, 255)] = 2.0
    """Standard deviation of the colours' noise [1/255]."""
    white_balance: tuple[float, float, float] = (1.10, 1.0, 0.84)
    """Gains of red, green and blue [-]: warmer than the simulated camera."""
    gamma: Positive = 0.85
    """Exponent of the tone curve [-]."""
    vignette: Share = 0.22
    """Share of the light that the corners lose [-]."""
    blur: Annotated[float, Bounds(0, 10)] = 0.5
    """Standard deviation of the blur of optics and demosaicing [px]."""
    samples: Annotated[int, Bounds(1, 16)] = 2
    """Rays along each edge of a pixel."""
    latency: Annotated[tuple[Duration, Duration], Bounds(0, 10, ascending=True)] = (0.02, 0.07)
    """Time from exposure to the policy [s]; sampled for each episode."""
    mounting_position: Duration = 0.003
    """Largest error per axis of where a camera is mounted [m]; sampled for each world."""
    mounting_angle: Duration = 0.5
    """Largest error of its orientation about each axis [degrees]; likewise."""


class LiveCameras:
    """Cameras of W worlds of Reality."""

    def __init__(
        self,
        cfg: LiveCamerasCfg,
        world: mujoco.MjSpec,
        objects: tuple[str, ...],
        cameras: Sequence[str],
        size: int,
        worlds: int,
        rng: np.random.Generator,
        *,
        device: str = "cpu",
        fovy: dict[str, float] | None = None,
    ) -> None:
        """Mount the cameras.

        Args:
            cfg: Their faults.
            world: Reality.
            objects: Names of the objects' bodies.
            cameras: Names of C cameras: base and wrist, or such as the scene has.
            size: Height and width of an image [px].
            worlds: W.
            rng: Source of the mounting errors and of the seed of the noise.
            device: Warp's name of the device.
            fovy: Vertical fields of view of cameras by name, where others than the scene's [degrees].
        """
        import mujoco_warp as mjw
        import torch
        import warp as wp

        spec = furnish(world, objects)
        add_cameras(spec, objects)
        for name, angle in (fovy or {}).items():
            spec.camera(name).fovy = angle
        model = still_world(spec).compile()
        rows = [model.camera(name).id for name in cameras]
        self._cfg, self._device, self._rows = cfg, wp.get_device(device), rows
        self._torch_device = str(wp.device_to_torch(self._device))
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(model, batch_sizes={"cam_pos": worlds, "cam_quat": worlds})
            self._data = mjw.make_data(model, nworld=worlds, nconmax=1, njmax=1)
            self._context = mjw.create_render_context(
                model, nworld=worlds, cam_res=(size, size), cam_active=rows, render_rgb=True, render_depth=False,
                render_seg=False, use_shadows=True, samples_per_pixel=cfg.samples,
            )  # fmt: skip
            self._colour: Any = wp.zeros((worlds, len(rows), size, size), dtype=wp.vec3)
            position, quaternion = _mounted(model, cfg, worlds, rng)
            wp.to_torch(self._model.cam_pos).copy_(torch.as_tensor(position))
            wp.to_torch(self._model.cam_quat).copy_(torch.as_tensor(quaternion))
            shade = torch.as_tensor(vignette(size, size, cfg.vignette), dtype=torch.float32)
        self._shade = shade.to(self._torch_device)[..., None]
        self._generator = torch.Generator(self._torch_device).manual_seed(int(rng.integers(2**31)))

    def expose(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return what the cameras report of states, uint8, shape (W, C, 3, size, size).

        Args:
            qpos: Positions, shape (W, nq).
            mocap: Positions [m] (W, nmocap, 3) and orientations wxyz (W, nmocap, 4) of fixed objects.
        """
        import mujoco_warp as mjw
        import torch
        import warp as wp

        with wp.ScopedDevice(self._device):
            wp.to_torch(self._data.qpos).copy_(qpos)
            if mocap[0].shape[1]:
                wp.to_torch(self._data.mocap_pos).copy_(mocap[0])
                wp.to_torch(self._data.mocap_quat).copy_(mocap[1])
            if self._device.is_cuda:
                torch.cuda.synchronize()
            mjw.kinematics(self._model, self._data)
            mjw.camlight(self._model, self._data)
            mjw.refit_bvh(self._model, self._data, self._context)
            mjw.render(self._model, self._data, self._context)
            for c in range(len(self._rows)):
                mjw.get_rgb(self._context, c, self._colour[:, c])
            wp.synchronize_device(self._device)
        light = _blurred(wp.to_torch(self._colour) * self._shade, self._cfg.blur)
        light = (light * light.new_tensor(self._cfg.white_balance)).clamp(0, 1) ** self._cfg.gamma
        noise = torch.randn(light.shape, generator=self._generator, device=light.device)
        level = (255 * light + self._cfg.noise * noise).round().clamp(0, 255)
        return level.to(torch.uint8).permute(0, 1, 4, 2, 3)


def _mounted(
    model: mujoco.MjModel, cfg: LiveCamerasCfg, worlds: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (W, ncam, 3) [m] and orientations (W, ncam, 4) of the cameras on their bodies, with errors."""
    shape = (worlds, model.ncam, 3)
    position = model.cam_pos + rng.uniform(-cfg.mounting_position, cfg.mounting_position, shape)
    turned = np.radians(rng.uniform(-cfg.mounting_angle, cfg.mounting_angle, shape))
    quaternion = np.zeros((worlds, model.ncam, 4))
    error = np.zeros(4)
    for w in range(worlds):
        for c in range(model.ncam):
            angle = float(np.linalg.norm(turned[w, c]))
            mujoco.mju_axisAngle2Quat(error, turned[w, c] / max(angle, 1e-12), angle)
            mujoco.mju_mulQuat(quaternion[w, c], model.cam_quat[c], error)
    return position, quaternion


def _blurred(light: torch.Tensor, deviation: float) -> torch.Tensor:
    """Return images (W, C, H, W', 3) under a Gaussian of a standard deviation [px]."""
    import torch
    from torch.nn.functional import conv2d, pad

    if deviation <= 0:
        return light
    reach = max(1, round(3 * deviation))
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=light.device) / deviation) ** 2)
    weights = weights / weights.sum()
    flat = pad(light.permute(0, 1, 4, 2, 3).flatten(0, 2)[:, None], (reach,) * 4, mode="replicate")
    flat = conv2d(conv2d(flat, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1))
    worlds, cameras, height, width, _ = light.shape
    return flat.view(worlds, cameras, 3, height, width).permute(0, 1, 3, 4, 2)
