"""Settings of the networks that paint robot and background, and of their training."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import Bounds, Count, Pixels, Share, SmallShare


@dataclass(frozen=True)
class FlowNetworkCfg:
    """Sizes of the U-Net."""

    size: Pixels = 64
    """Edge of the images [px], a multiple of 2 for each level but the first."""
    width: Annotated[int, Bounds(1, 16_384)] = 64
    """Channels of the first level."""
    factors: tuple[Annotated[int, Bounds(1, 1024)], ...] = (1, 2, 4)
    """Channels of each level, relative to the first; each level halves the resolution of the one before."""
    blocks: Annotated[int, Bounds(1, 1000)] = 1
    """Residual blocks of a level, on the way down; one more on the way up."""
    posed: bool = False
    """Whether the end-effector's pose is a condition, as for a camera on the wrist."""


@dataclass(frozen=True)
class SuperResolutionCfg:
    """Sizes of the network."""

    width: Annotated[int, Bounds(1, 16_384)] = 64
    """Channels."""
    blocks: Annotated[int, Bounds(1, 1000)] = 8
    """Residual blocks."""
    scale: float = 0.1
    """Factor on what a block adds, which keeps deep networks stable."""


@dataclass(frozen=True)
class NetworkTrainCfg:
    """Training of one network."""

    steps: Count = 20_000
    """Steps of the optimiser."""
    batch: Annotated[int, Bounds(1, 100_000)] = 32
    """Images of a step."""
    learning_rate: Annotated[float, Bounds(0, 1, above_low=True)] = 3e-4
    """Learning rate after the warm-up; it falls to a tenth along a cosine."""
    warm_up: int = 200
    """Steps in which the learning rate rises."""
    ema: SmallShare = 0.999
    """Share of the running mean of the weights that a step keeps (Polyak and Juditsky 1992)."""


@dataclass(frozen=True)
class AugmentCfg:
    """Augmentation of the conditions, so that errors of generated images do not accumulate (paper: autoregressive)."""

    back: Count = 5
    """How many frames older than it is the previous image may be, at most; 1 for the very frame before. A network
    trained on these takes the robot's position from the simulated image."""
    blank: Share = 0.3
    """Share of the previous images replaced by the mean image, the initial condition of an episode."""
    noise: Annotated[float, Bounds(0, 2)] = 0.06
    """Largest deviation of noise on the previous image, of colours in -1..1."""
    colour: Share = 0.1
    """Largest change of brightness, contrast and saturation of the previous image."""
    blur: Share = 0.3
    """Share of the previous images that are blurred."""


@dataclass(frozen=True)
class RenderTrainCfg:
    """Training of all networks."""

    seed: int = 0
    """Seed of all random numbers."""
    flow: NetworkTrainCfg = field(default_factory=NetworkTrainCfg)
    """Training of the network for robot and background."""
    enlarge: NetworkTrainCfg = field(default_factory=lambda: NetworkTrainCfg(batch=16))
    """Training of the super-resolution."""
    network: FlowNetworkCfg = field(default_factory=FlowNetworkCfg)
    """Sizes of the flow's U-Net; the pose is a condition where the camera moves."""
    super_resolution: SuperResolutionCfg = field(default_factory=SuperResolutionCfg)
    """The network that enlarges images."""
    augment: AugmentCfg = field(default_factory=AugmentCfg)
    """Augmentation of previous images."""
    crop: Pixels = 24
    """Edge of the pieces that the super-resolution learns from, in its input [px]."""
    checkpoint: float = 60.0
    """Time between checkpoints [s]."""
    half: bool = False
    """Multiply in bfloat16, which is faster."""
