"""Masks of the bodies in a video, by a masker that the bodies' first poses prompt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from concent_warp.perception.backends.protocols import CameraFrames, Masker, MaskPrompt
from concent_warp.perception.pinhole import pixel_grid
from concent_warp.perception.tracking.alignment.rows import rendered_crop
from concent_warp.perception.tracking.body_tracker import BodyTracker
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import symmetry_of
from concent_warp.perception.tracking.geometry.view import View
from concent_warp.perception.tracking.video import Video
from concent_warp.scene.scene import Scene

MOST = 20_000
"""Largest number of a body's pixels that a prompt is made of."""
KNOWN_STRIDE = 2
"""Distance of the pixels at which robot and static scene are rendered for a masker [px]."""


@dataclass(frozen=True)
class BodyMasks:
    """Masks of bodies in all frames of all cameras."""

    by_body: Mapping[str, Mapping[int, np.ndarray]] = field(default_factory=dict)
    """Of each body, by the number of the camera, masks of all its frames, shape (T, H, W) bool; a body or camera is
    missing where none are known."""

    def on(self, views: Sequence[View], frames: Sequence[tuple[int, int]], body: str) -> list[View]:
        """Return views of a moment with the masks of a body; `frames` are camera and frame of each.

        Where a mask is empty, the masker does not know where the body is, and the whole frame is looked at.
        """
        known = self.by_body.get(body, {})
        return [
            replace(view, mask=known[c][k]) if c in known and known[c][k].any() else view
            for view, (c, k) in zip(views, frames, strict=True)
        ]


def camera_frames(scene: Scene, video: Video, shapes: Sequence[TrackedShape]) -> list[CameraFrames]:
    """Return the frames of each camera, with the depth at which robot and static scene should be seen."""
    renderer = RayRenderer(scene.model)
    moments: list[dict[int, int]] = [{} for _ in video.streams]
    for moment, group in enumerate(video.frames):
        for c, k in group:
            moments[c][k] = moment

    def known(camera: int, frame: int) -> np.ndarray:
        import cv2

        moment = moments[camera][frame]
        renderer.set_state(video.qpos[moment])
        for shape in shapes:
            renderer.place(shape.row, None)
        view = video.views(moment, renderer)[[c for c, _ in video.frames[moment]].index(camera)]
        height, width = view.shape
        grid = pixel_grid(height, width)[::KNOWN_STRIDE, ::KNOWN_STRIDE]
        depth = renderer.cast(view.camera, grid.reshape(-1, 2)).depth.reshape(grid.shape[:2])
        return cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)

    return [
        CameraFrames(stream.rgb, stream.depth, lambda frame, c=c: known(c, frame))
        for c, stream in enumerate(video.streams)
    ]


def body_masks(
    masker: Masker,
    scene: Scene,
    video: Video,
    shapes: Sequence[TrackedShape],
    first: Mapping[str, np.ndarray],
    cfg: TrackCfg,
) -> BodyMasks:
    """Return the masks of bodies, prompted by their first poses in the first moment in which they are seen.

    Args:
        masker: Makes the masks.
        scene: The scene.
        video: Its frames.
        shapes: The bodies.
        first: First poses, shape (4, 4), by body; others are searched.
        cfg: Settings.
    """
    prompts = _prompts(scene, video, shapes, first, cfg)
    result: dict[str, dict[int, np.ndarray]] = {shape.name: {} for shape in shapes}
    for c, frames in enumerate(camera_frames(scene, video, shapes)):
        mine = {body: by_camera[c] for body, by_camera in prompts.items() if c in by_camera}
        if mine:
            for body, found in masker.masks(frames, mine).items():
                result[body][c] = np.asarray(found, dtype=bool)
    return BodyMasks(result)


def _prompts(
    scene: Scene, video: Video, shapes: Sequence[TrackedShape], first: Mapping[str, np.ndarray], cfg: TrackCfg
) -> dict[str, dict[int, MaskPrompt]]:
    """Return, of each body, by camera, where it is in the first moment in which it is seen."""
    renderer, rng = RayRenderer(scene.model), np.random.default_rng(cfg.seed)
    trackers = [BodyTracker(shape, symmetry_of(shape, cfg.symmetry_tolerance), cfg) for shape in shapes]
    result: dict[str, dict[int, MaskPrompt]] = {}
    searched = -np.inf
    for moment, time in enumerate(video.time):
        if len(result) == len(shapes):
            break
        if moment and time - searched < cfg.search.interval:
            continue
        searched = float(time)
        renderer.set_state(video.qpos[moment])
        for tracker in trackers:
            renderer.place(tracker.shape.row, tracker.pose)
        views = video.views(moment, renderer)
        for tracker in trackers:
            body = tracker.shape.name
            if body in result:
                continue
            if moment == 0 and body in first:
                tracker.begin(renderer, searched, views, first[body])
                # A pose that the frames do not agree with is refused later; it may still show where to look.
                pose = first[body] if tracker.pose is None else tracker.pose
            else:
                fit = tracker.recovered(renderer, searched, views, rng)
                pose = None if fit is None else fit.pose
            tracker.pose = pose
            if pose is not None and (found := _prompted(renderer, views, video.frames[moment], tracker.shape, pose)):
                result[body] = found
    return result


def _prompted(
    renderer: RayRenderer,
    views: Sequence[View],
    frames: Sequence[tuple[int, int]],
    shape: TrackedShape,
    pose: np.ndarray,
) -> dict[int, MaskPrompt]:
    """Return, by camera, the box around what is seen of a body at a pose and its pixel farthest from the border."""
    import cv2

    renderer.place(shape.row, pose)
    result = {}
    for (c, k), view in zip(frames, views, strict=True):
        crop = rendered_crop(renderer, view, shape, pose, MOST)
        if crop is None or not crop.own.any():
            continue
        i, j = np.nonzero(crop.own)
        box = np.array([crop.columns[j.min()], crop.rows[i.min()], crop.columns[j.max()], crop.rows[i.max()]], float)
        depth = cv2.distanceTransform(np.pad(crop.own.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        row, column = np.unravel_index(int(depth.argmax()), depth.shape)
        point = np.array([[crop.columns[column], crop.rows[row]]], float)
        result[c] = MaskPrompt(k, point, box)
    return result
