"""The student's network: a residual network with a spatial softmax for each camera, then a perceptron.

Group normalisation and the spatial softmax follow Chi et al., "Diffusion Policy" (RSS 2023), and Levine et al.,
"End-to-end training of deep visuomotor policies" (JMLR 17, 2016).
"""

from __future__ import annotations

import warnings

import torch
from torch import nn
from torch.nn import functional

from concent_warp.train.distil.cfg import StudentNetworkCfg

GROUPS = 8
"""Groups of channels that are normalised together."""
POSITION_SCALE = 20.0
"""Factor on predicted positions [1/m], which brings them to the size of the entries of rotations."""


class ResidualBlock(nn.Module):
    """Two convolutions whose result is added to what came in (He et al., CVPR 2016), with group normalisation."""

    def __init__(self, width: int) -> None:
        """Create the layers for a number of channels."""
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1), nn.GroupNorm(GROUPS, width), nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1), nn.GroupNorm(GROUPS, width),
        )  # fmt: skip

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return features of the same shape (N, width, H, W)."""
        return functional.silu(features + self.layers(features))


class CameraEncoder(nn.Module):
    """Images (N, channels, H, W) to positions of keypoints, their strengths and a summary, shape (N, `size`).

    Stages of residual blocks halve the resolution; what the coarser ones see is added to the second, on whose cells
    the keypoints are (Lin et al., "Feature pyramid networks", CVPR 2017).
    """

    def __init__(self, channels: int, cfg: StudentNetworkCfg) -> None:
        """Create the layers for images of a number of channels."""
        super().__init__()
        widths = cfg.channels
        self.stages = nn.ModuleList()
        before = channels
        for k, width in enumerate(widths):
            conv = nn.Conv2d(before, width, 5 if k == 0 else 3, 2, 2 if k == 0 else 1)
            blocks = [] if k == 0 else [ResidualBlock(width) for _ in range(cfg.blocks)]
            self.stages.append(nn.Sequential(conv, nn.GroupNorm(GROUPS, width), nn.SiLU(), *blocks))
            before = width
        self.finest = min(1, len(widths) - 1)
        """Stage on whose cells the keypoints are."""
        coarser = zip(widths[self.finest :], widths[self.finest + 1 :], strict=False)
        self.lifts = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in coarser)
        self.scores = nn.Conv2d(widths[self.finest], cfg.keypoints, 1)
        self.size = 3 * cfg.keypoints + widths[-1]
        """Number of features."""
        self.reduced_precision = False
        """Whether convolutions compute in bfloat16; places in the image need more digits."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return the features of images in -1..1."""
        with torch.autocast("cuda", torch.bfloat16, enabled=self.reduced_precision):
            scores, summary = self._convolved(images)
        rows, columns = scores.shape[2:]
        flat = scores.flatten(2).float()
        share = torch.softmax(flat, dim=2).unflatten(2, (rows, columns))
        u = (share.sum(dim=2) * _line(columns, flat)).sum(dim=2)
        v = (share.sum(dim=3) * _line(rows, flat)).sum(dim=2)
        strength = torch.tanh((share.flatten(2) * flat).sum(dim=2) / 10)
        return torch.cat([u, v, strength, summary.float()], dim=1)

    def _convolved(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the keypoints' scores on the cells of an image, and the means of the coarsest features."""
        maps: list[torch.Tensor] = []
        features = images
        for stage in self.stages:
            features = stage(features)
            maps.append(features)
        summary = features.mean(dim=(2, 3))
        for k in reversed(range(len(self.lifts))):
            fine = maps[self.finest + k]
            features = fine + functional.interpolate(self.lifts[k](features), size=fine.shape[2:])
        return self.scores(features), summary


def _line(count: int, like: torch.Tensor) -> torch.Tensor:
    """Return places -1..1 of the cells of a row."""
    return torch.linspace(-1, 1, count, device=like.device, dtype=like.dtype)


class StudentNetwork(nn.Module):
    """Images and proprioception to actions in -1..1, and to the poses of the objects."""

    def __init__(
        self, cameras: int, frames: int, proprioception: int, actions: int, objects: int, cfg: StudentNetworkCfg
    ) -> None:
        """Create the layers.

        Args:
            cameras: C, number of cameras.
            frames: F, successive images of a camera.
            proprioception: P, numbers that the robot knows of itself.
            actions: A, length of an action.
            objects: Number of objects whose poses are predicted.
            cfg: Settings.
        """
        super().__init__()
        self.blind = cfg.blind
        encoders = [CameraEncoder(3 * frames, cfg) for _ in range(cameras)]
        self.encoders = nn.ModuleList(encoders)
        self.register_buffer("mean", torch.zeros(proprioception))
        self.register_buffer("std", torch.ones(proprioception))
        layers: list[nn.Module] = []
        before = sum(encoder.size for encoder in encoders) + proprioception
        for width in cfg.hidden:
            layers += [nn.Linear(before, width), nn.LayerNorm(width), nn.SiLU()]
            before = width
        self.trunk = nn.Sequential(*layers)
        self.poses = nn.Linear(before, 9 * objects)
        self.action = nn.Sequential(
            nn.Linear(before + 9 * objects, before), nn.LayerNorm(before), nn.SiLU(), nn.Linear(before, actions)
        )

    def reduce_precision(self, reduced: bool) -> None:
        """Compute the convolutions in bfloat16, or not."""
        for encoder in self.encoders:
            assert isinstance(encoder, CameraEncoder)
            encoder.reduced_precision = reduced

    def compile_encoders(self, device: str) -> None:
        """Compile the convolutions for each size of batch; warn and leave them as they are where that cannot work."""
        try:
            torch.compile(torch.sin)(torch.zeros(8, device=device))
        except Exception as error:  # what is missing shows in many types: Triton, a C compiler, an old GPU
            reason = " ".join(str(error).split())[:200]
            warnings.warn(f"the student is not compiled, and learns more slowly: {reason}", stacklevel=2)
            return
        for encoder in self.encoders:
            encoder.compile(dynamic=False)

    def forward(self, images: torch.Tensor, proprioception: torch.Tensor) -> torch.Tensor:
        """Return actions, shape (N, A); see `both`."""
        return self.both(images, proprioception)[0]

    def both(self, images: torch.Tensor, proprioception: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions, shape (N, A), and the poses of the objects, shape (N, 9 objects), positions scaled.

        The actions follow from the predicted poses and what else was seen.

        Args:
            images: Colours 0..1, shape (N, C, 3 F, size, size).
            proprioception: Numbers as they are observed, shape (N, P).
        """
        seen = torch.zeros_like(images) if self.blind else 2 * images - 1
        features = [encoder(seen[:, c]) for c, encoder in enumerate(self.encoders)]
        own = ((proprioception - self.get_buffer("mean")) / self.get_buffer("std")).clamp(-10, 10)
        trunk = self.trunk(torch.cat([*features, own], dim=1))
        poses = self.poses(trunk)
        return torch.tanh(self.action(torch.cat([trunk, poses], dim=1))), poses


def scaled_poses(poses: torch.Tensor) -> torch.Tensor:
    """Return poses (N, 9 objects) with positions in units of 1 / `POSITION_SCALE` m."""
    scale = torch.tensor([POSITION_SCALE] * 3 + [1.0] * 6, device=poses.device)
    return poses * scale.repeat(poses.shape[1] // 9)
