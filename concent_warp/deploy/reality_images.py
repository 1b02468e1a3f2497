"""What a student sees in Reality: images of Reality's own cameras, as late as they come."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from concent_warp.deploy.simulated_images import base_fovy
from concent_warp.errors import RenderError
from concent_warp.reality.sensors.live_cameras import LiveCameras, LiveCamerasCfg
from concent_warp.scene.cameras import BASE, WRIST
from concent_warp.train.distil.cfg import ImagesCfg
from concent_warp.train.environment.environment import Environment


class RealityImages:
    """Cameras in the worlds of an environment that is Reality; an `ImageSource` of `train.distil`."""

    def __init__(
        self,
        environment: Environment,
        world: mujoco.MjSpec,
        images: ImagesCfg,
        cfg: LiveCamerasCfg,
        *,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        """Mount the cameras.

        Args:
            environment: The worlds.
            world: Reality, as the environment simulates it.
            images: Cameras and size of the images.
            cfg: Faults of the cameras.
            seed: Seed of mounting errors, latency and noise.
            device: Warp's name of the device that renders.

        Raises:
            RenderError: Reality has no such camera.
        """
        self.cameras, self.size, self._cfg = images.cameras, images.size, cfg
        task = environment.task
        have = [camera.name for camera in world.cameras]
        if unknown := [name for name in self.cameras if name not in (*have, BASE, WRIST)]:
            raise RenderError("Reality has no such camera", expected=f"some of {[*have, BASE, WRIST]}", found=unknown)
        rng = np.random.default_rng([seed, 4])
        objects = tuple(task.compiled.body(body).name for body in task.objects)
        self._live = LiveCameras(
            cfg, world, objects, self.cameras, self.size, environment.num_envs, rng, device=device,
            fovy=base_fovy(images, have),
        )  # fmt: skip
        self._rng, self._period = rng, environment.control_step
        self._past: list[torch.Tensor] = []
        self._latency = torch.zeros(environment.num_envs, 1)
        self._rows = int(np.ceil(cfg.latency[1] / self._period)) + 1

    def begin(self, which: torch.Tensor) -> None:
        """Begin episodes in the worlds of a mask (N,) bool, each with a latency of its own."""
        fresh = torch.as_tensor(self._rng.uniform(*self._cfg.latency, (len(which), 1)), dtype=torch.float32)
        started = which.cpu()[:, None]
        self._latency = torch.where(started, fresh, self._latency)
        self._started = started

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return the images that have arrived, see `ImageSource.render`: of the state that was when they were taken."""
        present = qpos.float().cpu().clone()
        # Where an episode begins, the state has always been so.
        self._past = [present, *(torch.where(self._started, present, past) for past in self._past)][: self._rows + 1]
        self._started = torch.zeros_like(self._started)
        ago = (self._latency / self._period).clamp(max=max(len(self._past) - 1, 0))
        state = torch.zeros_like(present)
        for k, past in enumerate(self._past):
            state += (1 - (ago - k).abs()).clamp(min=0) * past
        return self._live.expose(state, mocap)

    def state(self) -> dict[str, torch.Tensor]:
        """Return nothing: no trial in Reality is resumed."""
        return {}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Do nothing."""
        del state
