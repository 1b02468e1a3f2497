"""Settings of a fit of splats."""

from __future__ import annotations

from dataclasses import dataclass, field

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

    iterations: int = 2000
    """Steps of descent."""
    start: int = 4000
    """Gaussians at first."""
    most: int = 12000
    """Gaussians at the end, at most."""
    degree: int = 1
    """Degree of the spherical harmonics, 0 to 3: how far colour may depend on where it is seen from."""
    views: int = 1
    """Images in a step. More are better used by a GPU."""
    held_out: int = 8
    """Each n-th image is not fitted but judges the result; 0 fits all."""
    ssim: float = 0.2
    """Weight s of the structural dissimilarity."""
    mask: float = 0.5
    """Weight m of the mask; without masks, 0."""
    grow: float = 0.15
    """Share of the Gaussians that are split at a time."""
    every: int = 100
    """Steps between splits, until two thirds of the fit are done."""
    faint: float = 0.02
    """Opacity below which a Gaussian is taken out."""
    hull_cells: int = 72
    """Cells along an edge of the cube in which the visual hull of the masks is carved."""
    hull_alpha: int = 128
    """Least alpha of a pixel that shows the object, 0 to 255: half."""
    initial_opacity: float = 0.3
    """Opacity of the first Gaussians [0 to 1]."""
    checkpoint_period: float = 20.0
    """Time between checkpoints [s]."""
    rates: RatesCfg = field(default_factory=RatesCfg)
    """Learning rates."""
    seed: int = 0
    """Seed of the order of the views."""

    def __post_init__(self) -> None:
        if min(self.iterations, self.start, self.most, self.views, self.every) < 1 or self.degree not in range(4):
            raise RenderError(
                "settings of a fit that cannot be",
                expected="iterations, start, most, views and every of at least 1, and a degree of 0 to 3",
            )
