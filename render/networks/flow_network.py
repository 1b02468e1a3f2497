"""The U-Net of the flow matching (Ronneberger et al. 2015; paper, appendix E): three images in, the denoised image out.

Each residual block is scaled and shifted (FiLM, Perez et al. 2018) by an embedding of the time, to which that of the
end-effector's pose is added where the camera is mounted on the hand.
"""

from __future__ import annotations

import math

import torch
from torch import nn
from torch.nn import functional

from concent_warp.render.networks.cfg import FlowNetworkCfg

INPUT_IMAGES = 3
"""Images in: the noised one, the simulation's, and the previous real one; 9 channels."""
POSE_SIZE = 9
"""Numbers of a pose: position [m] and the first two columns of the rotation (Zhou et al. 2019)."""


class Block(nn.Module):
    """Residual block with FiLM."""

    def __init__(self, into: int, out: int, embedding: int) -> None:
        super().__init__()
        self.norm_in, self.norm_out = nn.GroupNorm(_groups(into), into), nn.GroupNorm(_groups(out), out)
        self.first, self.second = nn.Conv2d(into, out, 3, padding=1), nn.Conv2d(out, out, 3, padding=1)
        self.film = nn.Linear(embedding, 2 * out)
        self.past = nn.Identity() if into == out else nn.Conv2d(into, out, 1)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: torch.Tensor, embedding: torch.Tensor) -> torch.Tensor:
        """Return features (N, out, S, S) of features (N, into, S, S) and embeddings (N, E)."""
        scale, shift = self.film(embedding)[:, :, None, None].chunk(2, dim=1)
        y = self.first(functional.silu(self.norm_in(x)))
        y = self.second(functional.silu(self.norm_out(y) * (1 + scale) + shift))
        return self.past(x) + y


class FlowNetwork(nn.Module):
    """Predicts the image from a noised one; the velocity of the flow follows from it."""

    def __init__(self, cfg: FlowNetworkCfg) -> None:
        super().__init__()
        widths = [cfg.width * factor for factor in cfg.factors]
        embedding = 4 * cfg.width
        self.cfg = cfg
        self.time = nn.Sequential(nn.Linear(cfg.width, embedding), nn.SiLU(), nn.Linear(embedding, embedding))
        self.pose = (
            nn.Sequential(nn.Linear(POSE_SIZE, embedding), nn.SiLU(), nn.Linear(embedding, embedding))
            if cfg.posed
            else None
        )
        self.entry = nn.Conv2d(3 * INPUT_IMAGES, cfg.width, 3, padding=1)
        # Static parts of the image depend on their position, of which convolutions are independent.
        self.place = nn.Parameter(torch.zeros(1, cfg.width, cfg.size, cfg.size))
        self.down, self.up, self.smaller, self.larger = (nn.ModuleList() for _ in range(4))
        kept, now = [cfg.width], cfg.width
        for level, width in enumerate(widths):
            stage = nn.ModuleList()
            for _ in range(cfg.blocks):
                stage.append(Block(now, width, embedding))
                now = width
                kept.append(now)
            self.down.append(stage)
            if level < len(widths) - 1:
                self.smaller.append(nn.Conv2d(now, now, 3, stride=2, padding=1))
                kept.append(now)
        self.middle = Block(now, now, embedding)
        for level, width in reversed(list(enumerate(widths))):
            stage = nn.ModuleList()
            for _ in range(cfg.blocks + 1):
                stage.append(Block(now + kept.pop(), width, embedding))
                now = width
            self.up.append(stage)
            if level:
                self.larger.append(nn.Conv2d(now, now, 3, padding=1))
        self.norm, self.exit = nn.GroupNorm(_groups(now), now), nn.Conv2d(now, 3, 3, padding=1)
        nn.init.zeros_(self.exit.weight)

    def forward(
        self,
        noised: torch.Tensor,
        time: torch.Tensor,
        simulated: torch.Tensor,
        previous: torch.Tensor,
        pose: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return the image.

        Args:
            noised: Between noise and image, shape (N, 3, S, S); images are in -1..1.
            time: 0 for noise, 1 for the image, shape (N,).
            simulated: The simulation's image, shape (N, 3, S, S).
            previous: The previous real image, shape (N, 3, S, S).
            pose: Position [m] and two columns of the rotation of the end-effector, shape (N, 9).
        """
        embedding = self.time(_waves(time, self.cfg.width))
        if self.pose is not None:
            embedding = embedding + self.pose(pose)
        x = self.entry(torch.cat([noised, simulated, previous], dim=1)) + self.place
        kept = [x]
        for level, stage in enumerate(self.down):
            for block in stage:  # pyright: ignore[reportGeneralTypeIssues]
                x = block(x, embedding)
                kept.append(x)
            if level < len(self.smaller):
                x = self.smaller[level](x)
                kept.append(x)
        x = self.middle(x, embedding)
        for level, stage in enumerate(self.up):
            for block in stage:  # pyright: ignore[reportGeneralTypeIssues]
                x = block(torch.cat([x, kept.pop()], dim=1), embedding)
            if level < len(self.larger):
                x = self.larger[level](functional.interpolate(x, scale_factor=2, mode="nearest"))
        return previous + self.exit(functional.silu(self.norm(x)))


def _groups(channels: int) -> int:
    """Return into how many groups channels are normalised: the most, up to 8, that divide them."""
    return next(count for count in range(min(8, channels), 0, -1) if channels % count == 0)


def _waves(time: torch.Tensor, count: int) -> torch.Tensor:
    """Return sines and cosines of times 0..1 (N,) of `count` numbers each (Vaswani et al. 2017), shape (N, count)."""
    half = count // 2
    frequency = torch.exp(-math.log(1000.0) * torch.arange(half, device=time.device) / max(half - 1, 1))
    angle = 1000.0 * time[:, None] * frequency
    return torch.cat([angle.sin(), angle.cos(), torch.zeros_like(time[:, None]).expand(-1, count - 2 * half)], dim=1)
