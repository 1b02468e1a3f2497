"""Encoder of images and text that is small enough to be trained from random weights.

Each camera has its own convolutions with group norm, as Diffusion Policy has them (Chi et al. 2023), whose last pixels
are the tokens: nothing is pooled, so that positions stay. Text is read byte by byte. It knows the sentences that it was
trained with, not language.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn import functional

from concent_warp.errors import TrainError
from concent_warp.train.flow.cfg import SmallBackboneCfg
from concent_warp.train.flow.transformer import EncoderLayer

BYTES = 256
"""Values of a byte."""
BEGIN = BYTES
"""Token before the bytes, so that an empty text has one."""
GROUPS = 8
"""Groups of channels that are normalised together, at most."""
INITIAL_POSITION = 0.02
"""Standard deviation of the initial embeddings of positions."""


class ConvolutionLevel(nn.Module):
    """Halves an image, and adds a residual block."""

    def __init__(self, into: int, out: int) -> None:
        super().__init__()
        self.halve = nn.Conv2d(into, out, 3, stride=2, padding=1)
        self.norm_first, self.norm_second = nn.GroupNorm(_groups(out), out), nn.GroupNorm(_groups(out), out)
        self.first, self.second = nn.Conv2d(out, out, 3, padding=1), nn.Conv2d(out, out, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return features (N, out, H / 2, W / 2) of features (N, into, H, W), rounded up."""
        x = self.halve(x)
        y = self.first(functional.silu(self.norm_first(x)))
        return x + self.second(functional.silu(self.norm_second(y)))


class CameraEncoder(nn.Module):
    """Tokens of the images of one camera."""

    def __init__(self, channels: Sequence[int], edge: int, width: int) -> None:
        super().__init__()
        pairs = zip((3, *channels[:-1]), channels, strict=True)
        self.levels = nn.Sequential(*(ConvolutionLevel(into, out) for into, out in pairs))
        self.norm, self.out = nn.GroupNorm(_groups(channels[-1]), channels[-1]), nn.Linear(channels[-1], width)
        for _ in channels:
            edge = (edge + 1) // 2
        self.position = nn.Parameter(INITIAL_POSITION * torch.randn(1, edge * edge, width))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return tokens (N, L, W) of images (N, 3, S, S) in -1..1."""
        pixels = functional.silu(self.norm(self.levels(images)))
        return self.out(pixels.flatten(2).transpose(1, 2)) + self.position


class TextEncoder(nn.Module):
    """Tokens of a text, one for each byte."""

    def __init__(self, cfg: SmallBackboneCfg, width: int, heads: int) -> None:
        super().__init__()
        self.bytes = nn.Embedding(BYTES + 1, width)
        self.position = nn.Parameter(INITIAL_POSITION * torch.randn(1, cfg.text_bytes + 1, width))
        self.layers = nn.ModuleList(EncoderLayer(width, heads) for _ in range(cfg.text_layers))

    def forward(self, ids: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Return tokens (N, L, W) of bytes (N, L) int64, of which a mask (N, L) bool tells which there are."""
        x = self.bytes(ids) + self.position[:, : ids.shape[1]]
        for layer in self.layers:
            x = layer(x, mask)
        return x


class SmallBackbone(nn.Module):
    """Tokens of images and text, each of which has seen the others."""

    def __init__(self, cfg: SmallBackboneCfg, cameras: int, edge: int, width: int, heads: int) -> None:
        """Make the encoders.

        Args:
            cfg: Settings.
            cameras: Number of cameras.
            edge: Height and width of the images [px].
            width: Channels of the tokens.
            heads: Attention heads.
        """
        super().__init__()
        self.width, self._text_bytes = width, cfg.text_bytes
        self.cameras = nn.ModuleList(CameraEncoder(cfg.channels, edge, width) for _ in range(cameras))
        self.text = TextEncoder(cfg, width, heads)
        self.fusion = nn.ModuleList(EncoderLayer(width, heads) for _ in range(cfg.fusion_layers))

    def tokens_of(self, texts: Sequence[str]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the bytes of texts, shape (N, L) int64, and which of them there are, shape (N, L) bool.

        Raises:
            TrainError: A text is too long.
        """
        encoded = [text.encode() for text in texts]
        if longest := [text for text, data in zip(texts, encoded, strict=True) if len(data) > self._text_bytes]:
            expected = f"at most {self._text_bytes} bytes"
            raise TrainError("an instruction is too long", expected=expected, found=f"{longest[0][:60]!r} ...")
        length = 1 + max(map(len, encoded), default=0)
        ids = torch.full((len(texts), length), BEGIN)
        mask = torch.zeros(len(texts), length, dtype=torch.bool)
        for row, data in enumerate(encoded):
            ids[row, 1 : 1 + len(data)] = torch.tensor(list(data), dtype=torch.int64)
            mask[row, : 1 + len(data)] = True
        return ids, mask

    def forward(self, images: torch.Tensor, ids: torch.Tensor, mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return tokens (N, L', W), and which of them there are, shape (N, L') bool.

        Args:
            images: Images of K cameras in 0..1, shape (N, K, 3, S, S).
            ids: Bytes of the text, shape (N, L) int64.
            mask: Which of these there are, shape (N, L) bool.
        """
        seen = [encoder(2 * images[:, k] - 1) for k, encoder in enumerate(self.cameras)]
        x = torch.cat([*seen, self.text(ids, mask)], dim=1)
        there = torch.ones(x.shape[0], x.shape[1] - ids.shape[1], dtype=torch.bool, device=x.device)
        mask = torch.cat([there, mask], dim=1)
        for layer in self.fusion:
            x = layer(x, mask)
        return x, mask


def _groups(channels: int) -> int:
    """Return into how many groups channels are normalised: the most, up to GROUPS, that divide them."""
    return next(count for count in range(min(GROUPS, channels), 0, -1) if channels % count == 0)
