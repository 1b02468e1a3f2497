"""Protocols of what follows objects in the images of one camera, and what goes in and comes out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np


@dataclass(frozen=True)
class CameraFrames:
    """Consecutive RGB-D frames of one camera.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> frames = cw.CameraFrames(np.zeros((5, 48, 64, 3), np.uint8), np.zeros((5, 48, 64), np.float32))
        >>> frames.part(2, 9).count
        3
    """

    rgb: np.ndarray
    """Colour, uint8, shape (T, H, W, 3)."""
    depth: np.ndarray
    """Planar depth [m], float32, shape (T, H, W); 0 where there is none."""
    known: Callable[[int], np.ndarray] | None = None
    """Depth [m], shape (H, W), at which the camera should see robot and static scene in a frame, infinite where
    nothing; None where neither is known."""

    @property
    def count(self) -> int:
        """Number of frames T."""
        return len(self.rgb)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [px]."""
        return self.rgb.shape[1], self.rgb.shape[2]

    def part(self, start: int, stop: int) -> CameraFrames:
        """Return the frames from `start` up to, not including, `stop`."""
        known = self.known
        later = None if known is None else lambda frame: known(start + frame)
        return CameraFrames(self.rgb[start:stop], self.depth[start:stop], later)


@dataclass(frozen=True)
class MaskPrompt:
    """Where an object is in one frame.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> cw.MaskPrompt(0, points=np.array([[30.0, 20.0]])).frame
        0
    """

    frame: int
    """The frame."""
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Pixels (column, row) on the object, shape (n, 2)."""
    box: np.ndarray | None = None
    """Box around what is seen of it (left, top, right, bottom) [px], shape (4,)."""
    outside: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Pixels (column, row) that are not on the object, shape (m, 2)."""


@dataclass(frozen=True)
class PixelTracks:
    """Points followed through the frames of one camera.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> tracks = cw.PixelTracks(np.zeros((4, 10, 2)), np.ones((4, 10), bool))
        >>> tracks.visible.shape
        (4, 10)
    """

    pixels: np.ndarray
    """Pixels (column, row), (0, 0) at the centre of the first, shape (n, T, 2); undefined where not visible."""
    visible: np.ndarray
    """Whether a point is seen in a frame, shape (n, T) bool."""


@runtime_checkable
class Masker(Protocol):
    """Finds the pixels of objects in the frames of one camera.

    Example:
        >>> import concent_warp as cw
        >>> isinstance(cw.DepthMasker(), cw.Masker)
        True
    """

    def masks(self, frames: CameraFrames, prompts: Mapping[str, MaskPrompt]) -> dict[str, np.ndarray]:
        """Return the masks of each object, shape (T, H, W) bool; empty where it is not seen.

        Args:
            frames: The frames.
            prompts: Of each object by its name, where it is in one frame.
        """
        ...


@runtime_checkable
class PointTracker(Protocol):
    """Follows points through the frames of one camera.

    Example:
        >>> import concent_warp as cw
        >>> isinstance(cw.FlowTracker(), cw.PointTracker)
        True
    """

    def choose(self, frames: CameraFrames, frame: int, mask: np.ndarray, count: int) -> np.ndarray:
        """Return pixels (column, row) of a frame that can be followed, best first, shape (n, 2), n at most `count`.

        Args:
            frames: The frames.
            frame: Which of them.
            mask: Pixels that may be chosen, shape (H, W) bool.
            count: Largest number.
        """
        ...

    def track(self, frames: CameraFrames, queries: np.ndarray) -> PixelTracks:
        """Return the tracks of points.

        Args:
            frames: The frames.
            queries: Frame, column and row [px] of each point, as `choose` returned them, shape (n, 3).
        """
        ...
