"""What is known of a video while it is tracked: the newest frames and where the bodies are in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from concent_warp.perception.tracking.geometry.outline import Outline, outline
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.view import View


@dataclass(frozen=True)
class BodyState:
    """Where a body is in a moment."""

    shape: TrackedShape
    """The body."""
    pose: np.ndarray | None
    """Its pose before smoothing, shape (4, 4); None where it is lost."""
    reason: str
    """Why it is lost, in words; empty where it is not."""


@dataclass(frozen=True)
class TrackedMoment:
    """A moment of a video just after it was tracked; valid until the next one."""

    demonstration: str
    """Name of the demonstration."""
    number: int
    """Number of the moment, from 0."""
    count: int
    """Moments of the demonstration."""
    time: float
    """Its time [s]."""
    views: list[tuple[str, View]]
    """Frames, each with the name of its camera."""
    bodies: list[BodyState]
    """The tracked bodies."""
    renderer: RayRenderer
    """Scene in the state of the moment."""

    @property
    def lost(self) -> bool:
        """Whether a body is lost."""
        return any(body.pose is None for body in self.bodies)

    def outlines(self, view: View) -> dict[str, Outline]:
        """Return the outline in a frame of each body that is not lost."""
        found = [b for b in self.bodies if b.pose is not None]
        for body in found:
            self.renderer.place(body.shape.row, body.pose)
        return {b.shape.name: outline(self.renderer, view, b.shape, b.pose) for b in found if b.pose is not None}
