"""A keyframe of tracked points: which points of a body they are, and where later frames show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.perception.backends.protocols import CameraFrames, PixelTracks, PointTracker
from concent_warp.perception.tracking.alignment.rows import Crop, rendered_crop
from concent_warp.perception.tracking.cfg import RegistrationCfg
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.view import View
from concent_warp.perception.tracking.points.registration import SeenPoints

MOST = 20_000
"""Largest number of the body's pixels that are looked at."""


@dataclass(frozen=True)
class CameraPoints:
    """Points of a keyframe in one camera."""

    first: int
    """Frame of the camera."""
    points: np.ndarray
    """Positions on the body [m], body frame, shape (n, 3)."""
    tracks: PixelTracks
    """Where the frames from the first on show them."""

    def seen(self, frame: int, view: View) -> SeenPoints:
        """Return the points that a frame shows on the body's mask."""
        k = frame - self.first
        if not 0 <= k < self.tracks.visible.shape[1]:
            return NOTHING
        rows = np.flatnonzero(self.tracks.visible[:, k])
        rows = rows[view.may_show(self.tracks.pixels[rows, k])]
        return SeenPoints(self.points[rows], self.tracks.pixels[rows, k])


NOTHING = SeenPoints(np.zeros((0, 3)), np.zeros((0, 2)))
"""No points."""


@dataclass(frozen=True)
class PointKeyframe:
    """Points of a body in one moment."""

    number: int
    """Number among the body's keyframes of points."""
    moment: int
    """The moment."""
    pose: np.ndarray
    """Pose of the body, shape (4, 4)."""
    cameras: dict[int, CameraPoints]
    """By the number of the camera."""

    @property
    def count(self) -> int:
        """Number of its points."""
        return sum(len(camera.points) for camera in self.cameras.values())

    def seen(self, frames: Sequence[tuple[int, int]], views: Sequence[View]) -> list[SeenPoints]:
        """Return the points that each frame of a moment shows; `frames` are camera and frame of each view."""
        return [
            self.cameras[c].seen(k, view) if c in self.cameras else NOTHING
            for (c, k), view in zip(frames, views, strict=True)
        ]

    def ends(self, frames: Sequence[tuple[int, int]]) -> bool:
        """Return whether the points of a camera are followed no further than these frames."""
        return any(
            c in self.cameras and k - self.cameras[c].first >= self.cameras[c].tracks.visible.shape[1] - 1
            for c, k in frames
        )


def point_keyframe(
    number: int,
    moment: int,
    frames: Sequence[tuple[int, int]],
    views: Sequence[View],
    streams: Sequence[CameraFrames],
    renderer: RayRenderer,
    shape: TrackedShape,
    pose: np.ndarray,
    tracker: PointTracker,
    cfg: RegistrationCfg,
) -> PointKeyframe | None:
    """Return points on a body at a pose, followed through the next frames; None where there are too few.

    Args:
        number: Number of the keyframe.
        moment: The moment.
        frames: Camera and frame of each view.
        views: Frames of the moment.
        streams: All frames of each camera.
        renderer: Scene in the state of the moment.
        shape: The body.
        pose: Its pose, shape (4, 4).
        tracker: Follows the points.
        cfg: Settings.
    """
    renderer.place(shape.row, pose)
    cameras: dict[int, CameraPoints] = {}
    for (c, k), view in zip(frames, views, strict=True):
        crop = rendered_crop(renderer, view, shape, pose, MOST)
        if crop is None:
            continue
        part = streams[c].part(k, k + cfg.window)
        pixels = tracker.choose(part, 0, _inner_pixels(crop, view, cfg.border), cfg.points)
        hits = renderer.cast(view.camera, pixels)
        good = hits.body == shape.row
        if not good.any():
            continue
        pixels, depth = pixels[good], hits.depth[good]
        points = (view.camera.lift(pixels, depth) - pose[:3, 3]) @ pose[:3, :3]
        queries = np.column_stack([np.zeros(len(pixels)), pixels])
        cameras[c] = CameraPoints(k, points, tracker.track(part, queries))
    keyframe = PointKeyframe(number, moment, pose, cameras)
    return keyframe if keyframe.count >= cfg.min_points else None


def _inner_pixels(crop: Crop, view: View, border: int) -> np.ndarray:
    """Return the pixels of a frame, shape (H, W) bool, that show the body, a border of its outline aside."""
    import cv2

    rows, columns = crop.rows, crop.columns
    stride = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    own = (crop.own & crop.mask).astype(np.uint8)
    # The window's edge is no edge of the body, but nothing beyond it is known.
    own = cv2.erode(own, np.ones((3, 3), np.uint8), iterations=max(1, -(-border // stride)), borderValue=0)
    size = (int(columns[-1] - columns[0]) + 1, int(rows[-1] - rows[0]) + 1)
    result = np.zeros(view.shape, dtype=bool)
    large = cv2.resize(own, size, interpolation=cv2.INTER_NEAREST) > 0
    result[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = large
    return result
