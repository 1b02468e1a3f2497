"""Settings of the shadows that splats cast."""

from __future__ import annotations

from dataclasses import dataclass

from concent_warp.errors import RenderError


@dataclass(frozen=True)
class ShadowCfg:
    """Lights and what is taken into account of the objects."""

    lights: int = 2
    """Lights in a world."""
    elevation: tuple[float, float] = (35.0, 80.0)
    """Least and largest angle of a light above the table [degrees]."""
    strength: tuple[float, float] = (0.1, 0.4)
    """Least and largest share of the light that one shadow takes away [0 to 1]."""
    softness: float = 0.008
    """Standard deviation of the blur, as a share of the image's height; 0 leaves shadows hard."""
    ground: float = 0.0
    """Height of the table [m]."""
    splats: int = 1500
    """Splats of an object that cast its shadow, spread evenly; a smaller model keeps all."""
    margin: float = 0.02
    """How far behind the surface that the simulation sees a splat's middle may be [m]: seen at a low angle, the far
    half of a shadow's spot is behind the near half."""

    def __post_init__(self) -> None:
        low, high = self.elevation
        weak, strong = self.strength
        if not (self.lights > 0 and 0 < low <= high <= 90 and 0 <= weak <= strong <= 1 and self.softness >= 0):
            raise RenderError(
                "lights that cannot be",
                expected="lights > 0, elevations in 0..90 degrees, strengths in 0..1, softness >= 0",
                found=f"{self.lights}, {self.elevation}, {self.strength}, {self.softness}",
            )  # fmt: skip
