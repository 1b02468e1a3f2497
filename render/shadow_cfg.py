"""Settings of the shadows that splats cast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from concent_warp.checks import Bounds, Count, Place, Share, check_settings
from concent_warp.errors import RenderError


@dataclass(frozen=True)
class ShadowCfg:
    """Lights and what is taken into account of the objects."""

    lights: Annotated[int, Bounds(1, 64)] = 2
    """Lights in a world."""
    elevation: Annotated[tuple[float, float], Bounds(0, 90, above_low=True, ascending=True)] = (35.0, 80.0)
    """Least and largest angle of a light above the table [degrees]."""
    strength: Annotated[tuple[float, float], Bounds(0, 1, ascending=True)] = (0.1, 0.4)
    """Least and largest share of the light that one shadow takes away [0 to 1]."""
    softness: Share = 0.008
    """Standard deviation of the blur, as a share of the image's height; 0 leaves shadows hard."""
    ground: Place = 0.0
    """Height of the table [m]."""
    splats: Count = 1500
    """Splats of an object that cast its shadow, spread evenly; a smaller model keeps all."""
    margin: float = 0.02
    """How far behind the surface that the simulation sees a splat's middle may be [m]: seen at a low angle, the far
    half of a shadow's spot is behind the near half."""

    def __post_init__(self) -> None:
        check_settings(self, RenderError)
