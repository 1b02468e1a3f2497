"""What a flow policy sees in the worlds of an environment: images like those of a data set that `render` wrote."""

from __future__ import annotations

import torch

from concent_warp.render.composite import HybridCamera
from concent_warp.render.filming import DatasetFilming
from concent_warp.render.networks.pairs import to_bytes


class DatasetCameras:
    """Cameras of a renderer, as `train.flow.receding_horizon.act_in` takes them."""

    def __init__(self, camera: HybridCamera) -> None:
        """Keep the renderer, with as many worlds as the environment has."""
        self.cameras = camera.cameras
        self._camera = camera

    def begin(self, which: torch.Tensor) -> None:
        """Begin episodes in the worlds of a mask (N,) bool."""
        if which.any():
            self._camera.begin(which.to(str(self._camera.stage.device)))

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return what the cameras see, uint8, shape (N, K, 3, H, W); see `WorldCameras.render`."""
        return to_bytes(self._camera.shoot(qpos, mocap).image).permute(0, 1, 4, 2, 3)


class FilmedCameras:
    """The cameras of a data set that is being filmed: a policy sees the frame that was filmed last."""

    def __init__(self, filming: DatasetFilming) -> None:
        """Keep what films."""
        self.cameras = filming.camera.cameras
        self._filming = filming

    def begin(self, which: torch.Tensor) -> None:
        """Do nothing: episodes begin with those of the data set."""
        del which

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return the frame that was filmed last, uint8, shape (N, K, 3, H, W); see `WorldCameras.render`."""
        del qpos, mocap
        return torch.from_numpy(self._filming.images).permute(0, 1, 4, 2, 3)
