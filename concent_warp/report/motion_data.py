"""What the replay on the page needs: poses of the bodies over time, simulated and measured, and tracked points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.estimation.body_signals import POSE_SENSORS
from concent_warp.estimation.object_tracks import frame_channel
from concent_warp.report.scene_data import packed
from concent_warp.simulate.replay import interpolate, replay

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Channel, Demonstration, PointTrack
    from concent_warp.simulate.engine import Engine

RATE = 25.0
"""Frames a second of the replay."""
MOST_FRAMES = 400
"""Frames of a demonstration; longer ones are shown at a lower rate."""
MOST_POINTS = 48
"""Tracked points shown of a body."""


def motion_data(
    models: Mapping[str, Model],
    engines: Mapping[str, Engine],
    demonstration: Demonstration,
    bodies: Sequence[str],
    begun: Mapping[str, Demonstration] | None = None,
) -> dict[str, Any]:
    """Return the replay of a demonstration in each model, beside what was measured, at common times.

    Args:
        models: The models by name.
        engines: What simulates them.
        demonstration: What was commanded and measured.
        bodies: Names of the bodies that are shown.
        begun: The demonstration with the initial state of each model's replay, by model; by default as it states it.
    """
    duration = demonstration.duration
    count = int(np.clip(np.ceil(duration * RATE) + 1, 2, MOST_FRAMES))
    time = np.linspace(0, duration, count)
    poses, qpos = {}, np.zeros(0)
    for name, model in models.items():
        engine = engines[name]
        steps = np.unique(np.round(time / engine.timestep).astype(int))
        started = demonstration if begun is None else begun[name]
        rollout = replay(model, started, engine, record=steps, bodies=bodies).numpy()
        rows = np.searchsorted(rollout.time, time - engine.timestep / 2).clip(0, len(rollout.time) - 1)
        pose = np.concatenate([rollout.body_position[0], rollout.body_quaternion[0]], axis=2)
        poses[name], qpos = packed(pose[rows]), rollout.qpos[0][rows]
    compiled = list(models.values())[-1].scene.model
    measured = _measured_poses(compiled, demonstration, time)
    measured = {**_measured_links(compiled, demonstration, time, qpos, measured), **measured}
    points = {
        body: _point_data(track)
        for body, track in demonstration.points.items()
        if body not in measured and _moves(compiled, body)
    }
    return {
        "time": packed(time),
        "poses": poses,
        "measured": {body: packed(pose) for body, pose in measured.items() if body in bodies},
        "points": points,
    }


def _measured_poses(compiled: mujoco.MjModel, demonstration: Demonstration, time: np.ndarray) -> dict[str, np.ndarray]:
    """Return the measured poses (T, 7) at `time` (T,) of the bodies that move and were measured in full."""
    poses = {}
    for b in range(1, compiled.nbody):
        body = compiled.body(b).name
        if not _moves(compiled, body):
            continue
        position, rotation = (frame_channel(compiled, demonstration, body, kind) for kind in POSE_SENSORS)
        if position is not None and rotation is not None:
            quaternion = _resampled(rotation, time, align=True)
            quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
            poses[body] = np.concatenate([_resampled(position, time), quaternion], axis=1)
    return poses


def _measured_links(
    compiled: mujoco.MjModel,
    demonstration: Demonstration,
    time: np.ndarray,
    qpos: np.ndarray,
    free: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Return the poses (T, 7) at `time` (T,) of the bodies that measured joints move, by forward kinematics.

    Args:
        compiled: The scene.
        demonstration: What was measured.
        time: Times [s].
        qpos: Simulated positions at these times, shape (T, nq), which stand in for joints that were not measured.
        free: Poses of free bodies that were measured, shape (T, 7) each.
    """
    state = np.array(qpos)
    known = np.zeros(compiled.nbody, dtype=bool)
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(compiled, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row >= 0 and compiled.sensor_type[row] == mujoco.mjtSensor.mjSENS_JOINTPOS:
            joint = int(compiled.sensor_objid[row])
            state[:, compiled.jnt_qposadr[joint]] = _resampled(channel, time)[:, 0]
            known[compiled.jnt_bodyid[joint]] = True
    for body, pose in free.items():
        joint = int(compiled.body_jntadr[compiled.body(body).id])
        if joint >= 0 and compiled.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            address = int(compiled.jnt_qposadr[joint])
            state[:, address : address + 7] = pose
    for b in range(1, compiled.nbody):
        known[b] |= known[compiled.body_parentid[b]]
    if not known.any():
        return {}
    data = mujoco.MjData(compiled)
    poses = np.full((len(time), compiled.nbody, 7), np.nan)
    for k in np.flatnonzero(np.isfinite(state).all(axis=1)):
        data.qpos[:] = state[k]
        mujoco.mj_kinematics(compiled, data)
        poses[k] = np.concatenate([data.xpos, data.xquat], axis=1)
    return {compiled.body(b).name or f"body{b}": poses[:, b] for b in np.flatnonzero(known)}


def _resampled(channel: Channel, time: np.ndarray, *, align: bool = False) -> np.ndarray:
    """Return a channel at other times, shape (T, dim); NaN before its first and after its last reading.

    Gaps are bridged. `align` flips quaternions to one side.
    """
    valid = np.isfinite(channel.value).all(axis=1)
    value = channel.value[valid]
    if not len(value):
        return np.full((len(time), channel.value.shape[1]), np.nan)
    if align:
        flips = np.where((value[1:] * value[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        value = value * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    found = interpolate(channel.time[valid], value, time)
    first, last = channel.time[valid][[0, -1]]
    period = (last - first) / max(len(value) - 1, 1) + float(np.ptp(time)) / max(len(time) - 1, 1)
    found[(time < first - period) | (time > last + period)] = np.nan
    return found


def _point_data(track: PointTrack) -> dict[str, Any]:
    """Return the tracked points of a body, thinned in number and time."""
    frames = np.unique(np.linspace(0, len(track.time) - 1, min(len(track.time), MOST_FRAMES // 2)).astype(int))
    chosen = np.unique(np.linspace(0, track.value.shape[1] - 1, min(track.value.shape[1], MOST_POINTS)).astype(int))
    value = np.where(track.visible[..., None], track.value, np.nan)[frames][:, chosen]
    return {"time": packed(track.time[frames]), "xyz": packed(value), "count": len(chosen)}


def _moves(compiled: mujoco.MjModel, body: str) -> bool:
    """Return whether a body can move."""
    row = mujoco.mj_name2id(compiled, mujoco.mjtObj.mjOBJ_BODY, body)
    return row >= 0 and compiled.body_weldid[row] != 0
