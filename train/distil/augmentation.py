"""Random changes of images in training, of each camera and sample anew."""

from __future__ import annotations

import torch
from torch.nn import functional

from concent_warp.train.distil.cfg import AugmentCfg


def augmented(images: torch.Tensor, cfg: AugmentCfg) -> torch.Tensor:
    """Return changed images.

    Args:
        images: Colours 0..1, shape (N, C, 3 F, H, W); the F frames of a camera are changed alike.
        cfg: Largest changes.
    """
    n, cameras, depth, height, width = images.shape
    flat = images.reshape(n * cameras, depth, height, width)
    given = {"device": images.device, "dtype": images.dtype}

    def about_one(spread: float, *shape: int) -> torch.Tensor:
        return 1 + spread * (2 * torch.rand(len(flat), *shape, **given) - 1)

    if cfg.shift:
        flat = _shifted(flat, cfg.shift)
    if cfg.blur:
        chosen = torch.rand(len(flat), 1, 1, 1, **given) < cfg.blur
        flat = torch.where(chosen, _blurred(flat), flat)
    middle = flat.mean(dim=(1, 2, 3), keepdim=True)
    flat = middle + about_one(cfg.contrast, 1, 1, 1) * (flat - middle)
    gain = about_one(cfg.brightness, 1) * about_one(cfg.balance, 3)
    flat = flat * gain.repeat(1, depth // 3)[..., None, None]
    if cfg.vignette:
        v, u = (torch.linspace(-1, 1, edge, **given) for edge in (height, width))
        squared = (v[:, None] ** 2 + u[None] ** 2) / 2
        flat = flat * (1 - cfg.vignette * torch.rand(len(flat), 1, 1, 1, **given) * squared)
    low, high = cfg.gamma
    exponent = low * (high / low) ** torch.rand(len(flat), 1, 1, 1, **given)
    flat = flat.clamp(1e-4, 1) ** exponent
    if cfg.noise:
        flat = flat + cfg.noise * torch.rand(len(flat), 1, 1, 1, **given) * torch.randn_like(flat)
    return flat.clamp(0, 1).reshape(images.shape)


def _shifted(images: torch.Tensor, most: int) -> torch.Tensor:
    """Return images (B, D, H, W) shifted by whole pixels, up to `most` along each axis; edges are repeated.

    Yarats et al., "Mastering visual continuous control" (ICLR 2022).
    """
    count, _, height, width = images.shape
    padded = functional.pad(images, (most,) * 4, mode="replicate")
    move = torch.randint(0, 2 * most + 1, (count, 2), device=images.device)
    rows = move[:, :1] + torch.arange(height, device=images.device)
    columns = move[:, 1:] + torch.arange(width, device=images.device)
    index = torch.arange(count, device=images.device)[:, None, None]
    # Channels last while indexing: the three indices pick whole pixels.
    return padded.permute(0, 2, 3, 1)[index, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def _blurred(images: torch.Tensor) -> torch.Tensor:
    """Return images (B, D, H, W) under a binomial filter, whose standard deviation is a pixel."""
    weights = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0], device=images.device, dtype=images.dtype) / 16
    depth = images.shape[1]
    padded = functional.pad(images, (2, 2, 2, 2), mode="replicate")
    across = functional.conv2d(padded, weights.view(1, 1, 1, 5).expand(depth, 1, 1, 5), groups=depth)
    return functional.conv2d(across, weights.view(1, 1, 5, 1).expand(depth, 1, 5, 1), groups=depth)
