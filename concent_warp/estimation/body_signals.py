"""Measured motion of free bodies: by pose sensors, velocity sensors and tracked points."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.estimation.local_polynomial import LocalPolynomialCfg
from concent_warp.estimation.object_tracks import BodyTarget, body_target, frame_channel, observed_poses
from concent_warp.estimation.signals import MeasuredBody, OrientationSignal, Signal
from concent_warp.estimation.smoothing_spline import SmoothingSplineCfg
from concent_warp.recording.recording import Channel
from concent_warp.scene.sensor_frame import SensorFrame, sensor_frame

if TYPE_CHECKING:
    from concent_warp.recording.recording import Demonstration
    from concent_warp.scene.scene import Scene

SENSOR = mujoco.mjtSensor
POSE_SENSORS = (SENSOR.mjSENS_FRAMEPOS, SENSOR.mjSENS_FRAMEQUAT)
"""Sensors of a body's position and orientation, each with readings at times of its own."""


def polynomial_bodies(
    scene: Scene, demonstration: Demonstration, cfg: LocalPolynomialCfg, qpos: np.ndarray
) -> tuple[MeasuredBody, ...]:
    """Return all free bodies, by pose and velocity sensors of the body frame or by tracked points.

    Args:
        scene: The scene.
        demonstration: What was measured.
        cfg: How readings are smoothed.
        qpos: State at the start of the demonstration, shape (nq,): locates the tracked points on the body.

    Raises:
        RecordingError: A free body was not measured.
    """
    m = scene.model
    found = []
    for joint in np.flatnonzero(m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        body = int(m.jnt_bodyid[joint])
        name = m.body(body).name
        signals = _polynomial_signals(scene, demonstration, name, cfg, qpos)
        if signals is None:
            raise RecordingError(
                "a window cannot start where a free body was not seen",
                where=demonstration.name,
                expected=f"points, or position and orientation sensors, of {name!r}",
                fix="record them, or fit whole demonstrations",
            )
        found.append(MeasuredBody(name, body, int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint]), *signals))
    return tuple(found)


def _polynomial_signals(
    scene: Scene, demonstration: Demonstration, body: str, cfg: LocalPolynomialCfg, qpos: np.ndarray
) -> tuple[Signal, OrientationSignal] | None:
    """Return position and orientation of a body; None if it was not measured."""
    place, turned = (frame_channel(scene.model, demonstration, body, kind) for kind in POSE_SENSORS)
    if place is None or turned is None or body in demonstration.points:
        target = body_target(scene, demonstration, body, qpos)
        if target is None:
            return None
        time, position, quaternion = _tracked_pose(target)
        place, turned = Channel(time, position), Channel(time, quaternion)
    linear, angular = velocity_channels(scene.model, demonstration, body)
    signal, orientation = cfg.signal(place, linear), cfg.orientation(turned, angular)
    return None if signal is None or orientation is None else (signal, orientation)


def _tracked_pose(target: BodyTarget) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (T,) [s], positions (T, 3) [m] and quaternions wxyz (T, 4) of a body from its observed points."""
    pose = observed_poses(target, np.arange(len(target.time)))
    seen = np.isfinite(pose).all(axis=1)
    return target.time[seen], pose[seen, :3], pose[seen, 3:]


def velocity_channels(
    m: mujoco.MjModel, demonstration: Demonstration, body: str
) -> tuple[Channel | None, Channel | None]:
    """Return the measured velocity [m/s, world] and angular velocity [rad/s, body frame] of a body's frame."""
    linear = frame_channel(m, demonstration, body, SENSOR.mjSENS_FRAMELINVEL)
    for name, channel in demonstration.measured.items():
        sensor = m.sensor(name).id
        site = int(m.sensor_objid[sensor])
        if int(m.sensor_type[sensor]) == int(SENSOR.mjSENS_GYRO) and int(m.site_bodyid[site]) == m.body(body).id:
            rotation = Rotation.from_quat(m.site_quat[site], scalar_first=True)
            return linear, Channel(channel.time, rotation.apply(channel.value))
    return linear, None


def spline_bodies(m: mujoco.MjModel, demonstration: Demonstration, cfg: SmoothingSplineCfg) -> tuple[MeasuredBody, ...]:
    """Return the free bodies whose position was measured, by sensors of a frame anywhere on the body."""
    found: dict[int, MeasuredBody] = {}
    posed: dict[int, dict[int, tuple[Channel, np.ndarray, Rotation]]] = {}
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        kind = int(m.sensor_type[row]) if row >= 0 else -1
        if kind in (int(SENSOR.mjSENS_FRAMEPOS), int(SENSOR.mjSENS_FRAMEQUAT)):
            frame = sensor_frame(m, row)
            if frame is not None:
                channel = _in_world(frame, kind, channel)
                posed.setdefault(frame.body, {}).setdefault(kind, (channel, frame.offset, frame.turn))
    for body, channels in posed.items():
        joint = m.body_jntadr[body]
        if joint < 0 or m.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE or int(SENSOR.mjSENS_FRAMEPOS) not in channels:
            continue
        orientation = None
        if int(SENSOR.mjSENS_FRAMEQUAT) in channels:
            channel, _, turn = channels[int(SENSOR.mjSENS_FRAMEQUAT)]
            orientation = cfg.orientation(channel, turn)
        channel, offset, _ = channels[int(SENSOR.mjSENS_FRAMEPOS)]
        shift = None
        if np.any(offset):
            if orientation is None:
                continue
            quaternion = orientation.spline.at(channel.time)
            shift = Rotation.from_quat(quaternion, scalar_first=True).apply(offset)
        position = cfg.signal(channel, kind="position", offset=shift)
        if position is not None:
            name = m.body(body).name or f"body{body}"
            addresses = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
            found[body] = MeasuredBody(name, body, *addresses, position, orientation)
    return tuple(found[body] for body in sorted(found))


def _in_world(frame: SensorFrame, kind: int, channel: Channel) -> Channel:
    """Return the measured poses of a frame in the world: positions, or orientations of the frame itself."""
    if kind == int(SENSOR.mjSENS_FRAMEPOS):
        return replace(channel, value=frame.place_in_world(channel.value))
    value, valid = np.full(channel.value.shape, np.nan), np.isfinite(channel.value).all(axis=1)
    if valid.any():
        turned = frame.base_turn * Rotation.from_quat(channel.value[valid], scalar_first=True)
        value[valid] = turned.as_quat(scalar_first=True)
    return replace(channel, value=value)
