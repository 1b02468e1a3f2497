"""Settings of a fit of splats."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import Bounds, Count, OpenShare, Share, check_settings
from concent_warp.errors import RenderError


@dataclass(frozen=True)
class RatesCfg:
    """Largest steps of the parameters."""

    means: float = 0.004
    """Of centres, relative to the size of the object; it falls to a hundredth by the end."""
    quats: float = 0.002
    """Of quaternions."""
    scales: float = 0.015
    """Of the logarithms of scales."""
    opacities: float = 0.06
    """Of the logits of opacities."""
    colour: float = 0.03
    """Of the constant harmonic; that of others is a tenth."""


@dataclass(frozen=True)
class SplatFitCfg:
    """How splats are fitted."""

    iterations: Count = 2000
    """Steps of descent."""
    start: Count = 4000
    """Gaussians at first."""
    most: Count = 12000
    """Gaussians at the end, at most."""
    degree: Annotated[int, Bounds(0, 3)] = 1
    """Degree of the spherical harmonics, 0 to 3: how far colour may depend on where it is seen from."""
    views: Count = 1
    """Images in a step. More are better used by a GPU."""
    held_out: int = 8
    """Each n-th image is not fitted but judges the result; 0 fits all."""
    ssim: Share = 0.2
    """Weight s of the structural dissimilarity."""
    mask: float = 0.5
    """Weight m of the mask; without masks, 0."""
    grow: Share = 0.15
    """Share of the Gaussians that are split at a time."""
    every: Count = 100
    """Steps between splits, until two thirds of the fit are done."""
    faint: Share = 0.02
    """Opacity below which a Gaussian is taken out."""
    hull_cells: Annotated[int, Bounds(2, 1024)] = 72
    """Cells along an edge of the cube in which the visual hull of the masks is carved."""
    hull_alpha: Annotated[int, Bounds(0, 255)] = 128
    """Least alpha of a pixel that shows the object, 0 to 255: half."""
    initial_opacity: OpenShare = 0.3
    """Opacity of the first Gaussians [0 to 1]."""
    checkpoint_period: float = 20.0
    """Time between checkpoints [s]."""
    rates: RatesCfg = field(default_factory=RatesCfg)
    """Learning rates."""
    seed: int = 0
    """Seed of the order of the views."""

    def __post_init__(self) -> None:
        check_settings(self, RenderError)
