"""Super-resolution by a factor of 4, after EDSR (Lim et al. 2017; paper, appendix E).

Residual blocks without batch normalisation, PixelShuffle (Shi et al. 2016), and bicubic upsampling past all of it; one
forward pass, trained with L1.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

from concent_warp.render.networks.cfg import SuperResolutionCfg

SCALE_FACTOR = 4
"""Enlargement of an edge."""


class ResidualBlock(nn.Module):
    """Two convolutions past which the input goes."""

    def __init__(self, width: int, scale: float) -> None:
        super().__init__()
        self.first, self.second = (_convolution(width, width) for _ in range(2))
        self.scale = scale

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return features of the shape of `x`, (N, width, H, W)."""
        return x + self.scale * self.second(functional.relu(self.first(x)))


class SuperResolution(nn.Module):
    """Enlarges images four times."""

    def __init__(self, cfg: SuperResolutionCfg) -> None:
        super().__init__()
        self.entry = _convolution(3, cfg.width)
        self.body = nn.Sequential(
            *(ResidualBlock(cfg.width, cfg.scale) for _ in range(cfg.blocks)), _convolution(cfg.width, cfg.width)
        )
        self.exit = nn.Sequential(_convolution(cfg.width, 3 * SCALE_FACTOR**2), nn.PixelShuffle(SCALE_FACTOR))
        for parameter in self.exit.parameters():
            nn.init.zeros_(parameter)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return images (N, 3, 4 H, 4 W) of images (N, 3, H, W), both in -1..1 or thereabouts."""
        x = self.entry(image)
        return _enlarged(image) + self.exit(x + self.body(x))


def _convolution(into: int, out: int) -> nn.Conv2d:
    """Return a convolution that takes what is beyond the edge to be as the edge is, so that it leaves no frame."""
    return nn.Conv2d(into, out, 3, padding=1, padding_mode="replicate")


def _enlarged(image: torch.Tensor) -> torch.Tensor:
    """Return images (N, 3, 4 H, 4 W) by bicubic interpolation."""
    return functional.interpolate(image, scale_factor=SCALE_FACTOR, mode="bicubic", align_corners=False)


def downsampled(image: torch.Tensor, size: int) -> torch.Tensor:
    """Return images (N, 3, size, size) by bilinear interpolation without aliasing, as the paper resizes them."""
    return functional.interpolate(image, size=(size, size), mode="bilinear", align_corners=False, antialias=True)
