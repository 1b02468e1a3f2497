"""Posed images of an object from a recording: frames of calibrated cameras in which the pose of the object is known.

Poses are measured or tracked ones, so cameras and object may both move, and the splats come out in the frame of the
body, in metres. The mask of the object is its shape in the scene, cast into each frame; what hides it, by the scene or
by the measured depth, is left out of the fit, as are the pixels of the outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from concent_warp.checks import Count, Positive, PositiveDuration, Share, check_settings
from concent_warp.errors import RenderError
from concent_warp.perception.configuration import configurations
from concent_warp.perception.pinhole import Pinhole, pixel_grid
from concent_warp.perception.tracking.geometry.ray_renderer import HIDDEN_GROUP, RayRenderer
from concent_warp.recording.recording import Demonstration, ImageStream, Recording
from concent_warp.render.splats.views import SplatViews
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.surface import Surface

SURFACE_POINTS = 4000
"""Points of the surface that bound the object in an image."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns a camera that looks along z with y down into one that looks along -z with y up."""
POSE_SENSORS = (mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMEQUAT)


@dataclass(frozen=True)
class RecordedViewsCfg:
    """Which frames of a recording become posed images."""

    max_views: Count = 80
    """Frames, evenly spread over all in which the object is in view with a known pose."""
    max_gap: PositiveDuration = 0.05
    """Time between two measured poses above which none is interpolated [s]."""
    min_visible: Share = 0.4
    """Least share of the object's outline that nothing hides [-]."""
    depth_tolerance: Positive = 0.01
    """Difference between measured depth and the object's surface above which a pixel shows something else [m]."""
    margin: Count = 8
    """Pixels around the object that are kept [px]."""


@dataclass(frozen=True)
class _Frame:
    """One frame in which the object can be seen."""

    demonstration: Demonstration
    stream: ImageStream
    row: int
    qpos: np.ndarray
    """State with the body and other bodies where they were measured, shape (nq,)."""
    low: np.ndarray
    """First column and row of the object with its margin [px], shape (2,) int."""
    high: np.ndarray
    """Last ones."""


def recorded_views(
    recording: Recording, body: str | None = None, cameras: Sequence[str] = (), cfg: RecordedViewsCfg | None = None
) -> tuple[SplatViews, np.ndarray]:
    """Return posed images of a body, cropped to it, and points of its surface to start from.

    Args:
        recording: Recording with images, and poses of the body where it moves.
        body: The body; by default the only object of the scene.
        cameras: Cameras that are used; all by default.
        cfg: Settings.

    Returns:
        Views in the frame of the body, and points [m], shape (n, 3).

    Raises:
        RenderError: There is no such body or camera, or the body is in view with a known pose in fewer than two frames.
        SceneError: The body has no closed surface.
    """
    cfg = cfg or RecordedViewsCfg()
    check_settings(cfg, RenderError)
    scene = Scene(recording.scene, recording.source)
    name = _the_body(scene, body)
    row = scene.model.body(name).id
    points = Surface.of_body(scene, name).sample(SURFACE_POINTS, np.random.default_rng(0))[0]
    renderer = RayRenderer(scene.model)
    known = sorted({camera for one in recording.demonstrations for camera in one.image})
    if unknown := [camera for camera in cameras if camera not in known]:
        raise RenderError("no such camera", where=recording.source, expected=f"some of {known}", found=unknown)
    frames = [
        frame
        for one in recording.demonstrations
        for camera, stream in one.image.items()
        if not cameras or camera in cameras
        for frame in _frames(renderer, one, stream, row, points, cfg)
    ]
    kept = (
        [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, cfg.max_views).round().astype(int))]
        if frames
        else []
    )
    size = np.max([f.high - f.low + 1 for f in kept], axis=0) if kept else np.zeros(2, int)
    views = [view for frame in kept if (view := _view(renderer, frame, row, size, cfg)) is not None]
    if len(views) < 2:
        raise RenderError(
            "the object is hardly ever in view with a known pose", where=f"{recording.source}, {name}",
            expected="at least 2 frames with images and a measured pose", found=f"{len(views)} frames",
            fix="track it with concent track --images, which keeps the video",
        )  # fmt: skip
    rgba, poses, intrinsics, tells = (np.stack(part) for part in zip(*views, strict=True))
    return SplatViews(rgba, poses, intrinsics, True, tells), points


def _the_body(scene: Scene, body: str | None) -> str:
    """Return the body that is meant."""
    objects = scene.objects()
    if body is None and len(objects) == 1:
        return objects[0]
    names = [scene.model.body(i).name for i in range(1, scene.model.nbody)]
    if body is None or body not in names:
        what, fix = ("no such body", None) if body else ("which object is meant is not clear", "name it with --body")
        expected = f"one of {list(objects) or names}"
        raise RenderError(what, where=scene.source, expected=expected, found=body, fix=fix)
    return body


def _frames(
    renderer: RayRenderer, demonstration: Demonstration, stream: ImageStream, row: int, points: np.ndarray,
    cfg: RecordedViewsCfg,
) -> list[_Frame]:  # fmt: skip
    """Return the frames of a camera in which the whole body is within the image and its pose is known."""
    model = renderer.model
    states = configurations(model, demonstration, stream.time)[0]
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    tracks = {
        int(model.jnt_bodyid[j]): _measured_poses(model, demonstration, int(model.jnt_bodyid[j]), stream.time, cfg)
        for j in free
    }
    found = []
    for t, state in enumerate(states):
        if row in tracks and not np.isfinite(tracks[row][t]).all():
            continue
        renderer.set_state(state)
        for other, track in tracks.items():
            start = model.jnt_qposadr[model.body_jntadr[other]]
            if np.isfinite(track[t]).all():
                renderer.data.qpos[start : start + 7] = track[t]
            elif other != row:
                renderer.place(other, None)
        renderer.update()
        pose = renderer.pose(row)
        pixels, depth = _camera(renderer, stream).project(points @ pose[:3, :3].T + pose[:3, 3])
        if not (depth > 0).all():
            continue
        low = np.floor(pixels.min(axis=0)).astype(int) - cfg.margin
        high = np.ceil(pixels.max(axis=0)).astype(int) + cfg.margin
        height, width = stream.rgb.shape[1:3]
        if (low >= 0).all() and high[0] < width and high[1] < height:
            found.append(_Frame(demonstration, stream, t, renderer.data.qpos.copy(), low, high))
    return found


def _measured_poses(
    model: mujoco.MjModel, demonstration: Demonstration, body: int, time: np.ndarray, cfg: RecordedViewsCfg
) -> np.ndarray:
    """Return position [m] and quaternion wxyz of a body at times (T,) [s], NaN where unknown, shape (T, 7)."""
    channels = []
    for kind in POSE_SENSORS:
        names = [
            name
            for name in demonstration.measured
            if model.sensor_type[row := model.sensor(name).id] == kind
            and model.sensor_objtype[row] == mujoco.mjtObj.mjOBJ_XBODY
            and model.sensor_objid[row] == body
            and model.sensor_refid[row] < 0
        ]
        if not names:
            return np.full((len(time), 7), np.nan)
        channels.append(demonstration.measured[names[0]])
    found = np.full((len(time), 7), np.nan)
    columns = (slice(0, 3), slice(3, 7))
    for channel, part in zip(channels, columns, strict=True):
        kept = np.isfinite(channel.value).all(axis=1)
        known, value = np.asarray(channel.time)[kept], np.asarray(channel.value, float)[kept]
        if len(known) < 2:
            return np.full((len(time), 7), np.nan)
        inside = (time >= known[0]) & (time <= known[-1])
        after = np.clip(np.searchsorted(known, time, side="left"), 1, len(known) - 1)
        near = np.minimum(np.abs(time - known[after]), np.abs(time - known[after - 1])) < 1e-6
        usable = inside & (near | (known[after] - known[after - 1] <= cfg.max_gap))
        if part.stop == 3:
            found[usable, part] = np.stack([np.interp(time[usable], known, column) for column in value.T], axis=1)
        elif usable.any():
            turns = Slerp(known, Rotation.from_quat(value, scalar_first=True))(time[usable])
            found[usable, part] = turns.as_quat(scalar_first=True)
    return found


def _camera(renderer: RayRenderer, stream: ImageStream) -> Pinhole:
    """Return the camera of a stream in the present state."""
    camera = Pinhole.of(stream)
    if stream.body is None:
        return camera
    return replace(camera, pose=renderer.pose(renderer.model.body(stream.body).id) @ camera.pose)


def _view(
    renderer: RayRenderer, frame: _Frame, row: int, size: np.ndarray, cfg: RecordedViewsCfg
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return image, pose, intrinsics and known pixels of a frame, cropped to a size (width, height); None if hidden."""
    import cv2

    stream, model = frame.stream, renderer.model
    renderer.set_state(frame.qpos)
    camera = _camera(renderer, stream)
    full = np.array(stream.rgb.shape[2:0:-1])
    corner = np.clip((frame.low + frame.high + 1 - size) // 2, 0, np.maximum(full - size, 0))
    width, height = (int(v) for v in size)
    pixels = (pixel_grid(height, width) + corner).reshape(-1, 2)
    first = renderer.cast(camera, pixels)
    groups = model.geom_group.copy()
    model.geom_group[model.geom_bodyid != row] = HIDDEN_GROUP
    alone = renderer.cast(camera, pixels)
    model.geom_group[:] = groups
    outline = (alone.body == row).reshape(height, width)
    hidden = outline & (first.body != row).reshape(height, width)
    x, y = (int(v) for v in corner)
    depth = stream.depth[frame.row, y : y + height, x : x + width]
    with np.errstate(invalid="ignore"):
        off = np.abs(depth - alone.depth.reshape(height, width)) > cfg.depth_tolerance
    hidden |= outline & (depth > 0) & off
    if not outline.any() or 1 - hidden.sum() / outline.sum() < cfg.min_visible:
        return None
    square = np.ones((3, 3), np.uint8)
    mask = outline.astype(np.uint8)
    rim = cv2.dilate(mask, square) != cv2.erode(mask, square)
    known = ~rim & ~cv2.dilate(hidden.astype(np.uint8), square).astype(bool)
    rgba = np.dstack([stream.rgb[frame.row, y : y + height, x : x + width], 255 * mask])
    matrix = camera.intrinsics.copy()
    matrix[:2, 2] -= corner
    return rgba, np.linalg.inv(renderer.pose(row)) @ camera.pose @ OPENGL, matrix, known
