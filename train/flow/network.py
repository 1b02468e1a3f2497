"""The network of a flow policy: from images, proprioception and text to a chunk of actions.

The flow is the straight one of Lipman et al. (2023) and Liu et al. (2023): at time t in 0..1 the chunk is
x_t = (1 - t) x_0 + t x_1 between noise x_0 and actions x_1, and the network learns its velocity x_1 - x_0. A sample is
its integral from noise, by Euler steps. States and actions are normalised by statistics that are part of the weights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from concent_warp.train.flow.cfg import FlowPolicyCfg
from concent_warp.train.flow.florence_backbone import FlorenceBackbone
from concent_warp.train.flow.small_backbone import SmallBackbone
from concent_warp.train.flow.transformer import FlowTransformer, RmsNorm


class FlowPolicyNetwork(nn.Module):
    """Encoder of the observation and velocity of the flow."""

    state_mean: torch.Tensor
    state_std: torch.Tensor
    action_mean: torch.Tensor
    action_std: torch.Tensor

    def __init__(
        self,
        cfg: FlowPolicyCfg,
        cameras: int,
        states: int,
        actions: int,
        backbone: Mapping[str, Any] | None = None,
    ) -> None:
        """Make the network.

        Args:
            cfg: Settings.
            cameras: Number K of cameras.
            states: Numbers P of the proprioception.
            actions: Numbers A of an action.
            backbone: What `described_backbone` returned; by default the backbone of the settings, Florence-2 with the
                weights of their folder.

        Raises:
            TrainError: The weights of the backbone are missing, or it does not fit the settings.
        """
        super().__init__()
        self.cfg = cfg
        self.backbone = _backbone(cfg, cameras, backbone)
        self.project = nn.Sequential(nn.Linear(self.backbone.width, cfg.width), RmsNorm(cfg.width))
        self.state = nn.Sequential(nn.Linear(states, cfg.width), nn.SiLU(), nn.Linear(cfg.width, cfg.width))
        self.no_state = nn.Parameter(torch.zeros(cfg.width))
        self.transformer = FlowTransformer(actions, cfg.chunk, cfg.width, cfg.layers, cfg.heads, causal=cfg.causal)
        for name, size in (("state", states), ("action", actions)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def tokens_of(self, texts: Sequence[str]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the tokens of texts, shape (N, L) int64, and which of them there are, shape (N, L) bool.

        Raises:
            TrainError: A text is too long.
        """
        return self.backbone.tokens_of(texts)

    def context(
        self,
        images: torch.Tensor,
        state: torch.Tensor,
        ids: torch.Tensor,
        mask: torch.Tensor,
        blank: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the tokens of an observation (N, L', W), and which of them there are, shape (N, L') bool.

        Args:
            images: Images of K cameras in 0..1, shape (N, K, 3, S, S).
            state: Proprioception in its own units, shape (N, P).
            ids: Tokens of the text, shape (N, L) int64.
            mask: Which of these there are, shape (N, L) bool.
            blank: Whose proprioception is hidden, shape (N,) bool; nobody's by default.
        """
        seen, there = self.backbone(images, ids, mask)
        seen = self.project(seen)
        if not self.cfg.proprioception:
            return seen, there
        felt = self.state((state - self.state_mean) / self.state_std).to(seen.dtype)
        if blank is not None:
            felt = torch.where(blank[:, None], self.no_state.to(felt.dtype), felt)
        return torch.cat([seen, felt[:, None]], dim=1), torch.cat([there, torch.ones_like(there[:, :1])], dim=1)

    def loss(
        self, context: torch.Tensor, mask: torch.Tensor, actions: torch.Tensor, noise: torch.Tensor, time: torch.Tensor
    ) -> torch.Tensor:
        """Return the mean squared error of the velocity of each sample, shape (N,).

        Args:
            context: Tokens of the observation, shape (N, L, W).
            mask: Which of these there are, shape (N, L) bool.
            actions: Chunks in their own units, shape (N, C, A).
            noise: Normally distributed numbers, shape (N, C, A).
            time: Uniformly distributed times of the flow, shape (N,).
        """
        wanted = (actions - self.action_mean) / self.action_std
        share = time[:, None, None]
        velocity = self.transformer((1 - share) * noise + share * wanted, time, context, mask)
        return functional.mse_loss(velocity.float(), wanted - noise, reduction="none").mean(dim=(1, 2))

    def sample(self, context: torch.Tensor, mask: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Return chunks of actions in their own units, shape (N, C, A), from noise (N, C, A)."""
        x, steps = noise, self.cfg.euler_steps
        for step in range(steps):
            time = torch.full_like(noise[:, 0, 0], step / steps)
            x = x + self.transformer(x, time, context, mask).float() / steps
        return x * self.action_std + self.action_mean

    def described_backbone(self) -> dict[str, Any]:
        """Return what is needed to make the backbone anew without its folder, as plain data."""
        if isinstance(self.backbone, FlorenceBackbone):
            return {"settings": self.backbone.settings, "tokenizer": self.backbone.tokenizer}
        return {}


def _backbone(
    cfg: FlowPolicyCfg, cameras: int, described: Mapping[str, Any] | None
) -> SmallBackbone | FlorenceBackbone:
    """Return the backbone of settings."""
    if cfg.backbone == "small":
        return SmallBackbone(cfg.small, cameras, cfg.edge, cfg.width, cfg.heads)
    if described:
        return FlorenceBackbone(described["settings"], described["tokenizer"], cameras, cfg.edge)
    return FlorenceBackbone.load(cfg.weights or Path(), cameras, cfg.edge)


def prepared(images: torch.Tensor, edge: int) -> torch.Tensor:
    """Return images (N, H, W, 3) uint8 in the size of a policy, shape (N, S, S, 3) uint8.

    Other shapes than squares are stretched; pixels are averaged where images become smaller.
    """
    if images.shape[1:3] == (edge, edge):
        return images
    moved = images.permute(0, 3, 1, 2).float()
    small = functional.interpolate(moved, (edge, edge), mode="bilinear", align_corners=False, antialias=True)
    return small.round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)
