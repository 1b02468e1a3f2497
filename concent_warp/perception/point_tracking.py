"""Point tracks from RGB-D video, by optical flow and rigid motion.

For each body: corners are detected in the region where the depth image agrees with the body's shape, tracked by optical
flow (`optical_flow`), lifted to 3D by their depth, and fitted by a robust rigid motion (`rigid_motion`). Points that
repeatedly disagree with this motion are dropped and new corners are detected in the current region. The body's shape
and its initial pose are taken from the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import mujoco
import numpy as np

from concent_warp.checks import MAX_COUNT, Bounds, Count, Positive, Share, check_settings
from concent_warp.errors import RecordingError
from concent_warp.perception.optical_flow import corners, depth_at, eroded, grayscale, track_pixels
from concent_warp.perception.pinhole import Pinhole
from concent_warp.perception.rigid_motion import consensus, inverse, transformed
from concent_warp.perception.visible_region import BodyShape, visible_mask
from concent_warp.recording.recording import Demonstration, ImageStream, PointTrack, Recording
from concent_warp.scene.scene import Scene


@dataclass(frozen=True)
class TrackingCfg:
    """Settings of the point tracking."""

    count: Count = 60
    """Largest number of points of a body that are tracked at a time."""
    refill_share: Share = 0.7
    """Share of `count` below which new corners are detected [-]."""
    spacing: Positive = 3.0
    """Least distance between new points [px]."""
    window: Annotated[int, Bounds(3, 1001)] = 7
    """Edge of the square that optical flow compares [px]."""
    return_tolerance: float = 0.5
    """Largest forward-backward error [px]."""
    agreement: float = 0.006
    """Distance within which a point follows the rigid motion of its body [m]; a few times the depth noise."""
    region_tolerance: float = 0.008
    """Distance within which a measured depth belongs to a body [m]."""
    margin: int = 2
    """Distance that new points keep from the outline of what is visible [px]."""
    max_outlier_frames: int = 3
    """Consecutive frames in which a point may disagree with the motion of its body before it is dropped."""
    min_points: Annotated[int, Bounds(3, MAX_COUNT)] = 6
    """Least number of points that agree with a rigid motion; with fewer, the body is lost in this frame."""
    min_visible_share: Share = 0.5
    """Share of the pixels of a lost body, at its last pose, that must be visible before it is tracked again [-]."""
    seed: int = 0
    """Seed of the random samples."""


class BodyTracker:
    """Tracks one body from frame to frame."""

    def __init__(self, shape: BodyShape, camera: Pinhole, cfg: TrackingCfg) -> None:
        """Create a tracker at the initial pose of the body, without points."""
        self.shape, self.camera, self.cfg = shape, camera, cfg
        self.rng = np.random.default_rng(cfg.seed)
        self.pose, self.step = shape.start, np.eye(4)
        self.local = np.zeros((0, 3))
        """Points [m], body frame, shape (M, 3)."""
        self.pixel = np.zeros((0, 2))
        """Where the points were seen last [px], shape (M, 2)."""
        self.alive = np.zeros(0, dtype=bool)
        """Which points are tracked, shape (M,)."""
        self.outlier_frames = np.zeros(0, dtype=int)
        """Consecutive frames in which each point disagreed with the motion of the body, shape (M,)."""
        self.history: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        """Of each frame: the pose (4, 4), the points seen (m,) and where depth put them [m], world frame, (m, 3)."""

    def advance(self, before: np.ndarray | None, image: np.ndarray, depth: np.ndarray) -> None:
        """Process one frame: brightness before and now, uint8, and depth now [m], all (H, W)."""
        if before is not None:
            self.update(before, image, depth)
        if self.alive.sum() < self.cfg.refill_share * self.cfg.count:
            self.refill(image, depth)
        rows = np.flatnonzero(self.alive & (self.outlier_frames == 0))
        seen = self.camera.lift(self.pixel[rows], depth_at(depth, self.pixel[rows]))
        self.history.append((self.pose, rows, seen))

    def update(self, before: np.ndarray, image: np.ndarray, depth: np.ndarray) -> None:
        """Update the pixels of the tracked points and the pose of the body."""
        rows = np.flatnonzero(self.alive)
        self.alive[:] = False
        expected = self.step @ self.pose
        guess = self.pixel[rows] + (
            self.camera.project(transformed(expected, self.local[rows]))[0]
            - self.camera.project(transformed(self.pose, self.local[rows]))[0]
        )
        pixel, sure = track_pixels(
            before,
            image,
            self.pixel[rows],
            guess,
            window=self.cfg.window,
            tolerance=self.cfg.return_tolerance,
        )
        distance = depth_at(depth, pixel)
        sure &= np.isfinite(distance)
        rows, pixel, distance = rows[sure], pixel[sure], distance[sure]
        result = consensus(self.local[rows], self.camera.lift(pixel, distance), self.cfg.agreement, self.rng)
        if result is None or result[1].sum() < self.cfg.min_points:
            self.step = np.eye(4)
            return
        pose, agrees = result
        self.step, self.pose = pose @ inverse(self.pose), pose
        self.pixel[rows] = pixel
        self.outlier_frames[rows] = np.where(agrees, 0, self.outlier_frames[rows] + 1)
        self.alive[rows] = self.outlier_frames[rows] <= self.cfg.max_outlier_frames

    def refill(self, image: np.ndarray, depth: np.ndarray) -> None:
        """Add corners in the visible region of the body; a lost body is tracked again once enough of it is visible."""
        expected = self.shape.depth(self.camera, self.pose, *depth.shape)
        region = visible_mask(expected, depth, self.cfg.region_tolerance)
        lost = bool(self.history) and not self.alive.any()
        if lost and region.sum() < self.cfg.min_visible_share * (expected > 0).sum():
            return
        region = eroded(region, self.cfg.margin)
        taken = self.pixel[self.alive]
        found = corners(image, region, taken, self.cfg.count - len(taken), self.cfg.spacing)
        distance = depth_at(depth, found)
        found, distance = found[np.isfinite(distance)], distance[np.isfinite(distance)]
        local = transformed(inverse(self.pose), self.camera.lift(found, distance))
        self.local = np.concatenate([self.local, local])
        self.pixel = np.concatenate([self.pixel, found])
        self.alive = np.concatenate([self.alive, np.ones(len(found), dtype=bool)])
        self.outlier_frames = np.concatenate([self.outlier_frames, np.zeros(len(found), dtype=int)])

    def track(self, time: np.ndarray) -> PointTrack:
        """Return the track of all points, at the times of the frames [s], shape (T,).

        A point of the body is the mean of all its sightings, moved back into the body frame; where it was seen, it is
        put where the body's motion takes it. So the noise of a single depth reading averages out.
        """
        total, count = np.zeros_like(self.local), np.zeros(len(self.local))
        for pose, rows, seen in self.history:
            total[rows] += transformed(inverse(pose), seen)
            count[rows] += 1
        local = total / np.maximum(count, 1)[:, None]
        value = np.full((len(time), len(local), 3), np.nan)
        visible = np.zeros((len(time), len(local)), dtype=bool)
        for t, (pose, rows, _) in enumerate(self.history):
            value[t, rows] = transformed(pose, local[rows])
            visible[t, rows] = True
        return PointTrack(np.asarray(time, float), value, visible)


def track_points(
    recording: Recording,
    demonstration: Demonstration,
    cfg: TrackingCfg | None = None,
    *,
    camera: str | None = None,
    bodies: Sequence[str] | None = None,
    qpos: np.ndarray | None = None,
    progress: Callable[[float], None] | None = None,
) -> Demonstration:
    """Return the demonstration with the points of its bodies tracked in its video.

    Args:
        recording: The recording that the demonstration is of; its scene gives the shapes of the bodies.
        demonstration: The demonstration, with an RGB-D stream.
        cfg: How points are tracked.
        camera: Name of the stream; may be left out where there is one.
        bodies: Bodies to track, each of one rigid piece; by default the objects of the scene.
        qpos: State of the scene in the first frame, shape (nq,); by default the recorded initial state.
        progress: Called with the share done, 0..1.

    Raises:
        RecordingError: There is no such stream, no initial state, or a body is not to be seen in the first frame.
    """
    cfg = cfg or TrackingCfg()
    check_settings(cfg)
    where = f"{recording.source}, {demonstration.name}"
    stream = _chosen_stream(demonstration, camera, where)
    scene = Scene(recording.scene, recording.source)
    state = demonstration.qpos if qpos is None else qpos
    if state is None or len(state) != scene.model.nq:
        raise RecordingError(
            "tracking needs the state of the scene in the first frame",
            where=where,
            expected=f"qpos of {scene.model.nq} numbers",
            found="none" if state is None else f"{len(state)} numbers",
        )
    pinhole = Pinhole.of(stream)
    trackers = {}
    for body in scene.objects() if bodies is None else bodies:
        if mujoco.mj_name2id(scene.model, mujoco.mjtObj.mjOBJ_BODY, body) < 0:
            raise RecordingError("the scene has no such body to track", where=where, found=repr(body))
        trackers[body] = BodyTracker(BodyShape(scene.model, np.asarray(state, float), body), pinhole, cfg)
    before = None
    for t in range(len(stream.time)):
        image = grayscale(stream.rgb[t])
        for body, tracker in trackers.items():
            tracker.advance(before, image, stream.depth[t])
            if t == 0 and tracker.alive.sum() < cfg.min_points:
                raise RecordingError(
                    f"body {body!r} cannot be tracked",
                    where=f"{where}, first frame",
                    expected=f"at least {cfg.min_points} corners where the initial state has it",
                    found=int(tracker.alive.sum()),
                    fix="check the initial state, the camera's pose and the resolution",
                )
        before = image
        if progress is not None:
            progress((t + 1) / len(stream.time))
    points = {body: tracker.track(stream.time) for body, tracker in trackers.items()}
    return replace(demonstration, points={**demonstration.points, **points})


def _chosen_stream(demonstration: Demonstration, camera: str | None, where: str) -> ImageStream:
    """Return the stream of a name, or the only one."""
    names = list(demonstration.image)
    if camera is None and len(names) != 1:
        raise RecordingError(
            "tracking needs one RGB-D stream",
            where=where,
            expected=f"the name of one of {names}" if names else "an image channel",
            found=f"no name and {len(names)} streams",
        )
    name = names[0] if camera is None else camera
    if name not in names:
        raise RecordingError("no such RGB-D stream", where=where, expected=f"one of {names}", found=repr(name))
    if demonstration.image[name].body is not None:
        raise RecordingError(
            "points are tracked from a camera that stands still", where=where, found=f"{name!r} on a body that moves"
        )
    return demonstration.image[name]
