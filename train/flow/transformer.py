"""The transformer that predicts the velocity of the flow: a DiT (Peebles and Xie 2023) as FLOWER has it.

One modulation (scale, shift and gate of self-attention, cross-attention and feed-forward) is computed from the time of
the flow and shared by all layers (global AdaLN). Positions in the chunk are rotary (Su et al. 2021), norms are RMSNorm
(Zhang and Sennrich 2019), feed-forwards SwiGLU (Shazeer 2020); the context comes in by cross-attention.
"""

from __future__ import annotations

import math

import torch
from torch import nn
from torch.nn import functional

TIME_WAVES = 128
"""Sines and cosines of the embedding of the flow's time."""
TIME_SCALE = 1000.0
"""Largest angular frequency of the time's embedding [rad]."""
ROTARY_BASE = 10_000.0
"""Ratio of the fastest and the slowest rotation (Su et al. 2021)."""


class RmsNorm(nn.RMSNorm):
    """RMSNorm in single precision, whatever precision is around it."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return normalised features, shape (..., W), of features (..., W)."""
        return super().forward(x.float()).to(x.dtype)


class Attention(nn.Module):
    """Attention of queries to keys, with normalised queries and keys (Henry et al. 2020)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width, bias=False)
        self.key_value = nn.Linear(width, 2 * width, bias=False)
        self.out = nn.Linear(width, width, bias=False)
        self.norm_query, self.norm_key = RmsNorm(width // heads), RmsNorm(width // heads)

    def forward(
        self,
        x: torch.Tensor,
        context: torch.Tensor,
        *,
        mask: torch.Tensor | None = None,
        causal: bool = False,
        rotation: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return what tokens take from a context, shape (N, T, W).

        Args:
            x: Tokens that ask, shape (N, T, W).
            context: Tokens that answer, shape (N, L, W).
            mask: Which of these there are, shape (N, L) bool; all by default.
            causal: Whether token t sees the first t + 1 only.
            rotation: See `rotations`; none by default.
        """
        key, value = self.key_value(context).chunk(2, dim=-1)
        query, key, value = (self._split(part) for part in (self.query(x), key, value))
        query, key = self.norm_query(query), self.norm_key(key)
        if rotation is not None:
            query, key = rotated(query, rotation), rotated(key, rotation)
        allowed = None if mask is None else mask[:, None, None, :]
        found = functional.scaled_dot_product_attention(
            query.to(value.dtype), key.to(value.dtype), value, attn_mask=allowed, is_causal=causal
        )
        return self.out(found.transpose(1, 2).flatten(2))

    def _split(self, x: torch.Tensor) -> torch.Tensor:
        """Return tokens (N, T, W) by heads, shape (N, H, T, W / H)."""
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class FeedForward(nn.Module):
    """SwiGLU."""

    def __init__(self, width: int) -> None:
        super().__init__()
        inner = 8 * math.ceil(width / 3)  # as many weights as four times the width without a gate has
        self.enter, self.out = nn.Linear(width, 2 * inner, bias=False), nn.Linear(inner, width, bias=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return tokens (..., W) of tokens (..., W)."""
        gate, value = self.enter(x).chunk(2, dim=-1)
        return self.out(functional.silu(gate) * value)


class EncoderLayer(nn.Module):
    """Layer of an encoder: self-attention and feed-forward, both after a norm."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm_attention, self.norm_feed = RmsNorm(width), RmsNorm(width)
        self.attention, self.feed = Attention(width, heads), FeedForward(width)

    def forward(self, x: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Return tokens (N, L, W) of tokens (N, L, W), of which a mask (N, L) bool tells which there are."""
        normed = self.norm_attention(x)
        x = x + self.attention(normed, normed, mask=mask)
        return x + self.feed(self.norm_feed(x))


class FlowBlock(nn.Module):
    """Layer of the transformer; what modulates it is given."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm = RmsNorm(width, elementwise_affine=False)
        self.attention, self.cross = Attention(width, heads), Attention(width, heads)
        self.feed = FeedForward(width)

    def forward(
        self,
        x: torch.Tensor,
        modulation: torch.Tensor,
        context: torch.Tensor,
        mask: torch.Tensor,
        rotation: torch.Tensor,
        *,
        causal: bool,
    ) -> torch.Tensor:
        """Return tokens (N, T, W) of tokens (N, T, W); `modulation` has shape (N, 9, W)."""
        scale, shift, gate = (modulation[:, k::3, None] for k in range(3))
        normed = self.norm(x) * (1 + scale[:, 0]) + shift[:, 0]
        x = x + gate[:, 0] * self.attention(normed, normed, causal=causal, rotation=rotation)
        normed = self.norm(x) * (1 + scale[:, 1]) + shift[:, 1]
        x = x + gate[:, 1] * self.cross(normed, context, mask=mask)
        normed = self.norm(x) * (1 + scale[:, 2]) + shift[:, 2]
        return x + gate[:, 2] * self.feed(normed)


class FlowTransformer(nn.Module):
    """Velocity of the flow at a noised chunk, given the tokens of a context."""

    rotation: torch.Tensor

    def __init__(self, actions: int, chunk: int, width: int, layers: int, heads: int, *, causal: bool) -> None:
        super().__init__()
        self.causal = causal
        self.enter = nn.Linear(actions, width)
        self.time = nn.Sequential(nn.Linear(TIME_WAVES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.modulation = nn.Linear(width, 11 * width)
        self.blocks = nn.ModuleList(FlowBlock(width, heads) for _ in range(layers))
        self.norm, self.out = RmsNorm(width, elementwise_affine=False), nn.Linear(width, actions)
        self.register_buffer("rotation", rotations(chunk, width // heads), persistent=False)
        for layer in (self.modulation, self.out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self, noised: torch.Tensor, time: torch.Tensor, context: torch.Tensor, mask: torch.Tensor
    ) -> torch.Tensor:
        """Return the velocity, shape (N, C, A).

        Args:
            noised: Between noise and normalised actions, shape (N, C, A).
            time: 0 for noise, 1 for the actions, shape (N,).
            context: Tokens of the observation, shape (N, L, W).
            mask: Which of these there are, shape (N, L) bool.
        """
        modulation = self.modulation(self.time(time_waves(time))).unflatten(-1, (11, -1))
        x = self.enter(noised)
        for block in self.blocks:
            x = block(x, modulation[:, :9], context, mask, self.rotation, causal=self.causal)
        scale, shift = modulation[:, 9, None], modulation[:, 10, None]
        return self.out(self.norm(x) * (1 + scale) + shift)


def time_waves(time: torch.Tensor) -> torch.Tensor:
    """Return cosines and sines of times 0..1 (N,) (Vaswani et al. 2017), shape (N, TIME_WAVES)."""
    share = torch.arange(TIME_WAVES // 2, device=time.device) / (TIME_WAVES // 2)
    angle = time[:, None] * TIME_SCALE ** (1 - share)
    return torch.cat([angle.cos(), angle.sin()], dim=1)


def rotations(count: int, channels: int) -> torch.Tensor:
    """Return cosines and sines of the rotations of pairs of channels at positions from 0, shape (2, count, pairs)."""
    frequency = ROTARY_BASE ** (-torch.arange(0, channels, 2) / channels)
    angle = torch.arange(count)[:, None] * frequency
    return torch.stack([angle.cos(), angle.sin()])


def rotated(x: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
    """Return queries or keys (N, H, T, D), the k-th channels of both halves rotated by their positions."""
    cos, sin = rotation[0], rotation[1]
    first, second = x.chunk(2, dim=-1)
    return torch.cat([first * cos - second * sin, first * sin + second * cos], dim=-1)
