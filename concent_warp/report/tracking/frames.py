"""Frames of a video as the page shows them: compressed images, and the bodies' outlines in them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.perception.tracking.geometry.outline import Outline, outline
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.result import BodyTrack
from concent_warp.perception.tracking.video import Video
from concent_warp.report.tracking.cfg import TrackReportCfg
from concent_warp.report.tracking.spans import quality_of

TENTHS = 10
"""Coordinates of outlines are sent in tenths of a pixel."""


@dataclass(frozen=True)
class CameraFrames:
    """Frames of one camera that are shown."""

    camera: str
    moments: np.ndarray
    """Moments of the track that they belong to, shape (n,)."""
    rows: np.ndarray
    """Rows of the stream, shape (n,)."""
    images: list[str]
    """Compressed images in base64, n of them."""
    total: int
    """Frames that the camera has."""

    def thinned(self, factor: int) -> CameraFrames:
        """Return every so many of the frames."""
        keep = slice(None, None, factor)
        return CameraFrames(self.camera, self.moments[keep], self.rows[keep], self.images[keep], self.total)


def shown_frames(videos: Sequence[Video], cfg: TrackReportCfg) -> list[list[CameraFrames]]:
    """Return the frames of each camera of each demonstration that are shown, within the size that is allowed."""
    found = [[_camera_frames(video, c, cfg) for c in range(len(video.streams))] for video in videos]
    factor, shown = 1, found
    while _size(shown) > cfg.max_image_bytes and any(len(c.images) > 1 for cameras in shown for c in cameras):
        factor += 1
        shown = [[camera.thinned(factor) for camera in cameras] for cameras in found]
    return shown


def _size(frames: Sequence[Sequence[CameraFrames]]) -> int:
    """Return the size of all images [bytes]."""
    return sum(len(image) for cameras in frames for camera in cameras for image in camera.images)


def _camera_frames(video: Video, camera: int, cfg: TrackReportCfg) -> CameraFrames:
    """Return evenly spaced frames of a camera."""
    pairs = [(moment, k) for moment, frames in enumerate(video.frames) for c, k in frames if c == camera]
    keep = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), cfg.max_frames)).round().astype(int))
    moments, rows = np.array(pairs)[keep].T
    images = [_compressed(video.streams[camera].rgb[row], cfg) for row in rows]
    return CameraFrames(video.cameras[camera], moments, rows, images, len(pairs))


def _compressed(rgb: np.ndarray, cfg: TrackReportCfg) -> str:
    """Return an image (H, W, 3) as WebP in base64."""
    import cv2

    height, width = rgb.shape[:2]
    image = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGR)
    if width > cfg.image_width:
        size = (cfg.image_width, max(1, round(height * cfg.image_width / width)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, cfg.image_quality])
    if not done:
        raise RecordingError("an image cannot be compressed", found=f"{width} x {height} pixels")
    return base64.b64encode(data.tobytes()).decode()


def camera_data(
    frames: CameraFrames,
    video: Video,
    tracks: Sequence[BodyTrack],
    shapes: Sequence[TrackedShape],
    renderer: RayRenderer,
) -> dict[str, Any]:
    """Return what the page shows of a camera: its frames, and in each the outline and state of every body.

    Args:
        frames: The frames that are shown.
        video: The video that they are of.
        tracks: Tracks of the demonstration.
        shapes: Shapes of their bodies, in the same order.
        renderer: The scene.
    """
    number = video.cameras.index(frames.camera)
    stream = video.streams[number]
    bodies: list[dict[str, list[Any]]] = [{"state": [], "seen": [], "covered": []} for _ in tracks]
    for moment in frames.moments:
        renderer.set_state(video.qpos[moment])
        for track, shape in zip(tracks, shapes, strict=True):
            renderer.place(shape.row, None if track.lost[moment] else track.pose[moment])
        views = dict(video.shown(int(moment), video.views(int(moment), renderer)))
        for track, shape, body in zip(tracks, shapes, bodies, strict=True):
            lines = None
            if not track.lost[moment]:
                lines = outline(renderer, views[frames.camera], shape, track.pose[moment])
            body["state"].append(quality_of(track).state[moment])
            body["seen"].append(_coordinates(lines, covered=False))
            body["covered"].append(_coordinates(lines, covered=True))
    return {
        "name": frames.camera,
        "width": int(stream.rgb.shape[2]),
        "height": int(stream.rgb.shape[1]),
        "total": frames.total,
        "time": [round(float(stream.time[row]), 6) for row in frames.rows],
        "images": frames.images,
        "bodies": {track.body: body for track, body in zip(tracks, bodies, strict=True)},
    }


def _coordinates(lines: Outline | None, *, covered: bool) -> list[int]:
    """Return the ends of segments, column and row, in tenths of a pixel."""
    if lines is None:
        return []
    return np.round(TENTHS * lines.segments[lines.covered == covered]).astype(int).ravel().tolist()
