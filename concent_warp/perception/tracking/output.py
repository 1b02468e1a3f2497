"""Tracks as channels of a recording: pose sensors with covariances, point tracks, initial state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from xml.etree import ElementTree

import mujoco
import numpy as np

from concent_warp.perception.tracking.geometry.pose import quaternion_of
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import SPHERE
from concent_warp.perception.tracking.result import BodyTrack
from concent_warp.perception.tracking.video import Video
from concent_warp.recording.recording import Channel, Demonstration, PointTrack
from concent_warp.scene.scene import Scene

KINDS = {"framepos": mujoco.mjtSensor.mjSENS_FRAMEPOS, "framequat": mujoco.mjtSensor.mjSENS_FRAMEQUAT}
"""Elements of the sensors that read a body's pose."""
NAMES = {"framepos": "{}_position", "framequat": "{}_orientation"}
"""Their names where the scene has none to follow."""
MAX_BALL_ORIENTATION_STD = 0.15
"""Usual standard deviation of a ball's rotation from which on its orientation counts as unknown [rad]."""
MIN_COMMON_SHARE = 1e-3
"""Variance of an error that samples have in common, over that of the samples, from which on it is written [-]."""
POINT_SLACK = 0.04
"""Distance of a surface in front of a point, over the body's reach, below which the point is seen [-]."""


def pose_sensor(model: mujoco.MjModel, body: int, element: str) -> str | None:
    """Return the name of the sensor that reads a body's position or orientation in the world, or None."""
    for row in range(model.nsensor):
        of_body = model.sensor_objtype[row] == mujoco.mjtObj.mjOBJ_XBODY and model.sensor_objid[row] == body
        if of_body and model.sensor_type[row] == KINDS[element] and model.sensor_refid[row] < 0:
            return model.sensor(row).name
    return None


def with_pose_sensors(scene: Scene, bodies: Sequence[str]) -> Scene:
    """Return the scene with sensors of position and orientation of each body, named as those of the others are."""
    model = scene.model
    missing = [(b, e) for b in bodies for e in KINDS if pose_sensor(model, model.body(b).id, e) is None]
    if not missing:
        return scene
    root = ElementTree.fromstring(scene.xml)
    sensors = root.find("sensor")
    if sensors is None:
        sensors = ElementTree.SubElement(root, "sensor")
    taken = {model.sensor(row).name for row in range(model.nsensor)}
    for body, element in missing:
        name = _pattern(model, element).replace("{}", body)
        while name in taken:
            name += "_tracked"
        taken.add(name)
        ElementTree.SubElement(sensors, element, name=name, objtype="xbody", objname=body)
    return Scene(ElementTree.tostring(root, encoding="unicode"), scene.source)


def _pattern(model: mujoco.MjModel, element: str) -> str:
    """Return the name of such a sensor with {} for the body, as another body of the scene has it."""
    for row in range(1, model.nbody):
        body, name = model.body(row).name, pose_sensor(model, row, element)
        if body and name is not None and body in name:
            return name.replace(body, "{}", 1)
    return NAMES[element]


def pose_channels(track: BodyTrack) -> dict[str, Channel]:
    """Return position and orientation, where it is known, of a track as channels, by the kind of sensor."""
    kept, oriented = ~track.lost, has_orientation(track)
    position = np.where(kept[:, None], track.pose[:, :3, 3], np.nan)
    quaternion = np.full((len(kept), 4), np.nan)
    quaternion[kept] = [quaternion_of(pose) for pose in track.pose[kept]]
    signs = np.ones(len(kept))
    for t in range(1, len(kept)):
        turned = np.nansum(quaternion[t] * quaternion[t - 1]) < 0
        signs[t] = -signs[t - 1] if turned else signs[t - 1]
    quaternion[~oriented] = np.nan
    turn = track.pose[:, :3, :3]
    in_body = np.swapaxes(turn, 1, 2) @ track.covariance[:, 3:, 3:] @ turn
    shift, rotation = (None, None) if track.common is None else np.split(track.common, 2, axis=1)
    channels = {"framepos": _channel(track.time, position, track.covariance[:, :3, :3], shift)}
    if oriented.any():
        in_body = np.where(oriented[:, None, None], in_body, np.nan)
        rotation = None if rotation is None else np.swapaxes(turn, 1, 2) @ rotation
        channels["framequat"] = _channel(track.time, signs[:, None] * quaternion, in_body, rotation)
    return channels


def has_orientation(track: BodyTrack) -> np.ndarray:
    """Return in which moments a body's orientation is known, shape (T,) bool: never of a ball that hardly shows it."""
    known = ~track.lost
    if track.symmetry.startswith(SPHERE):
        variance = np.einsum("tii->t", track.covariance[known][:, 3:, 3:]) / 3
        known &= bool(np.median(variance) < MAX_BALL_ORIENTATION_STD**2)
    return known


def _channel(time: np.ndarray, value: np.ndarray, covariance: np.ndarray, common: np.ndarray | None) -> Channel:
    """Return a channel whose noise is the root mean square of its covariances' standard deviations.

    Args:
        time: Times [s], shape (T,).
        value: Values, shape (T, dim).
        covariance: Shape (T, 3, 3).
        common: What of it the samples share, shape (T, 3, E); None where that is not known.
    """
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    std = float(np.sqrt(np.nanmean(np.einsum("tii->ti", covariance))))
    return Channel(time, value, std, None, covariance, None if common is None else main_errors(common, covariance))


def main_errors(common: np.ndarray, covariance: np.ndarray) -> np.ndarray | None:
    """Return few errors in common that stand for many, shape (T, k, m); None where they are small.

    The principal directions over all samples are kept in which they amount to `MIN_COMMON_SHARE` of the variance.

    Args:
        common: Errors in common, shape (T, k, E); NaN where a sample is missing.
        covariance: Of the samples, shape (T, k, k).
    """
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    count, k, _ = common.shape
    directions, size, _ = np.linalg.svd(common[known].reshape(int(known.sum()) * k, -1), full_matrices=False)
    kept = size**2 > MIN_COMMON_SHARE * float(np.einsum("tii->", covariance[known]))
    if not kept.any():
        return None
    found = np.full((count, k, int(kept.sum())), np.nan)
    found[known] = (directions[:, kept] * size[kept]).reshape(-1, k, int(kept.sum()))
    return found


def point_track(
    track: BodyTrack,
    tracks: Sequence[BodyTrack],
    shapes: Sequence[TrackedShape],
    video: Video,
    model: mujoco.MjModel,
    count: int,
) -> PointTrack | None:
    """Return surface points of a body, carried by its poses where a camera sees them; None where none is ever seen.

    Args:
        track: The body's poses.
        tracks: Those of all tracked bodies of the demonstration.
        shapes: The bodies.
        video: The frames.
        model: The compiled scene.
        count: How many points.
    """
    by_name = {shape.name: shape for shape in shapes}
    shape = by_name[track.body]
    local = shape.surface.sample(count, np.random.default_rng(0))[0]
    value = np.full((len(track.time), count, 3), np.nan)
    visible = np.zeros((len(track.time), count), dtype=bool)
    renderer = RayRenderer(model)
    for t in np.flatnonzero(has_orientation(track)):
        renderer.set_state(video.qpos[t])
        for other in tracks:
            renderer.place(by_name[other.body].row, None if other.lost[t] else other.pose[t])
        points = local @ track.pose[t, :3, :3].T + track.pose[t, :3, 3]
        for view in video.views(int(t), renderer):
            pixels, depth, _ = view.pixel_rows(points)
            inside = ((pixels >= 0) & (pixels <= np.array(view.shape[::-1]) - 1)).all(axis=1) & (depth > 0)
            hits = renderer.cast(view.camera, pixels)
            visible[t] |= inside & (hits.body == shape.row) & (np.abs(hits.depth - depth) < POINT_SLACK * shape.reach)
        value[t, visible[t]] = points[visible[t]]
    if not visible.any():
        return None
    seen = visible.any(axis=0)
    return PointTrack(track.time, value[:, seen], visible[:, seen])


def written(
    demonstration: Demonstration,
    scene: Scene,
    tracks: Sequence[BodyTrack],
    shapes: Sequence[TrackedShape],
    video: Video,
    count: int,
    *,
    keep_measured: bool,
    images: bool,
) -> Demonstration:
    """Return a demonstration with what was tracked in it.

    Args:
        demonstration: The demonstration.
        scene: Scene with pose sensors of all bodies.
        tracks: Its tracks.
        shapes: The bodies.
        video: Its frames.
        count: Surface points of each body.
        keep_measured: Whether pose channels that are there stay.
        images: Whether the frames are kept.
    """
    model = scene.model
    known = {model.sensor(row).name for row in range(model.nsensor)}
    measured = {name: channel for name, channel in demonstration.measured.items() if name in known}
    points = dict(demonstration.points)
    qpos = None if demonstration.qpos is None else np.array(demonstration.qpos, float)
    qvel = None if demonstration.qvel is None else np.array(demonstration.qvel, float)
    for track in tracks:
        row = model.body(track.body).id
        channels = pose_channels(track) if not track.lost.all() else {}
        for element in KINDS:
            name = pose_sensor(model, row, element)
            assert name is not None
            if name in measured and keep_measured:
                continue
            measured.pop(name, None)
            if element in channels:
                measured[name] = channels[element]
        points.pop(track.body, None)
        made = None if track.lost.all() else point_track(track, tracks, shapes, video, model, count)
        if made is not None:
            points[track.body] = made
        joint = int(model.body_jntadr[row])
        if qpos is not None and len(qpos) == model.nq and not track.lost.all():
            pose = track.pose[int((~track.lost).argmax())]
            start = model.jnt_qposadr[joint]
            qpos[start : start + 7] = np.concatenate([pose[:3, 3], quaternion_of(pose)])
        if qvel is not None and len(qvel) == model.nv:
            start = model.jnt_dofadr[joint]
            qvel[start : start + 6] = 0.0
    image = demonstration.image if images else {}
    if qpos is not None and len(qpos) != model.nq:
        qpos = qvel = None
    return replace(demonstration, qpos=qpos, qvel=qvel, measured=measured, points=points, image=image)
