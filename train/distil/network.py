"""The student's network: convolutions and a spatial softmax for each camera, then a perceptron.

Group normalisation and the spatial softmax follow Chi et al., "Diffusion Policy" (RSS 2023), and Levine et al.,
"End-to-end training of deep visuomotor policies" (JMLR 17, 2016).
"""

from __future__ import annotations

import warnings

import torch
from torch import nn

from concent_warp.train.distil.cfg import StudentNetworkCfg

GROUPS = 8
"""Groups of channels that are normalised together."""
POSITION_SCALE = 10.0
"""Factor on predicted positions [1/m], which brings them to the size of the entries of rotations."""


class CameraEncoder(nn.Module):
    """Images (N, channels, H, W) to positions of keypoints and their strengths, shape (N, 3 keypoints)."""

    def __init__(self, channels: int, cfg: StudentNetworkCfg, size: int) -> None:
        """Create the layers for images of a height and width."""
        super().__init__()
        layers: list[nn.Module] = []
        before = channels
        for k, width in enumerate(cfg.channels):
            kernel, stride, dilation = (5, 2, 1) if k == 0 else (3, 1, max(1, 2 ** (k - 1)))
            layers.append(nn.Conv2d(before, width, kernel, stride, dilation * (kernel // 2), dilation))
            layers += [nn.GroupNorm(GROUPS, width), nn.SiLU()]
            before = width
        layers.append(nn.Conv2d(before, cfg.keypoints, 1))
        self.layers = nn.Sequential(*layers)
        line = torch.linspace(-1, 1, (size + 1) // 2)
        v, u = torch.meshgrid(line, line, indexing="ij")
        self.register_buffer("across", u.reshape(-1), persistent=False)
        self.register_buffer("down", v.reshape(-1), persistent=False)
        self.reduced_precision = False
        """Whether convolutions compute in bfloat16; places in the image need more digits."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return the features of images in -1..1."""
        if self.reduced_precision:
            with torch.autocast("cuda", torch.bfloat16):
                scores = self.layers(images)
        else:
            scores = self.layers(images)
        scores = scores.flatten(2).float()
        share = torch.softmax(scores, dim=2)
        u, v = ((share * self.get_buffer(name)).sum(dim=2) for name in ("across", "down"))
        return torch.cat([u, v, torch.tanh((share * scores).sum(dim=2) / 10)], dim=1)


class StudentNetwork(nn.Module):
    """Images and proprioception to actions in -1..1, and to the poses of the objects."""

    def __init__(
        self, cameras: int, frames: int, size: int, proprioception: int, actions: int, objects: int,
        cfg: StudentNetworkCfg,
    ) -> None:  # fmt: skip
        """Create the layers.

        Args:
            cameras: C, number of cameras.
            frames: F, successive images of a camera.
            size: Height and width of an image [px].
            proprioception: P, numbers that the robot knows of itself.
            actions: A, length of an action.
            objects: Number of objects whose poses are predicted.
            cfg: Settings.
        """
        super().__init__()
        self.blind = cfg.blind
        self.encoders = nn.ModuleList(CameraEncoder(3 * frames, cfg, size) for _ in range(cameras))
        self.register_buffer("mean", torch.zeros(proprioception))
        self.register_buffer("std", torch.ones(proprioception))
        layers: list[nn.Module] = []
        before = 3 * cfg.keypoints * cameras + proprioception
        for width in cfg.hidden:
            layers += [nn.Linear(before, width), nn.LayerNorm(width), nn.SiLU()]
            before = width
        self.trunk = nn.Sequential(*layers)
        self.action = nn.Linear(before, actions)
        self.poses = nn.Linear(before, 9 * objects)

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

        Args:
            images: Colours 0..1, shape (N, C, 3 F, size, size).
            proprioception: Numbers as they are observed, shape (N, P).
        """
        seen = torch.zeros_like(images) if self.blind else 2 * images - 1
        features = [encoder(seen[:, c]) for c, encoder in enumerate(self.encoders)]
        own = ((proprioception - self.get_buffer("mean")) / self.get_buffer("std")).clamp(-10, 10)
        trunk = self.trunk(torch.cat([*features, own], dim=1))
        return torch.tanh(self.action(trunk)), self.poses(trunk)


def scaled_poses(poses: torch.Tensor) -> torch.Tensor:
    """Return poses (N, 9 objects) with positions in units of 1 / `POSITION_SCALE` m."""
    scale = torch.tensor([POSITION_SCALE] * 3 + [1.0] * 6, device=poses.device)
    return poses * scale.repeat(poses.shape[1] // 9)
