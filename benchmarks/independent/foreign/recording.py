"""Recordings of the worlds on other engines: readings of its motion, and what a user knows of the beginning."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.independent.foreign.rig import (
    ENCODERS,
    DriveState,
    ForeignMotion,
    ForeignRig,
    Physics,
    Sensor,
    Simulate,
)
from benchmarks.independent.instruments import Instrument, Instruments
from concent_warp.recording.recording import Channel, Demonstration, Recording

START_STD = (2e-4, 2e-3, 5e-3, 2e-2)
"""Standard deviations of the errors of a recorded initial state: position [m], orientation [rad], velocity [m/s],
angular velocity [rad/s]."""


@dataclass(frozen=True)
class Made:
    """A recording and the true initial states, which it does not say."""

    recording: Recording
    starts: tuple[tuple[np.ndarray, np.ndarray] | None, ...]
    """For each demonstration qpos (nq,) and qvel (nv,) of the nominal scene, or None where it has no free body."""


def record(rig: ForeignRig, physics: Physics, simulate: Simulate, seed: int, demonstrations: int) -> Made:
    """Return a recording, the same each time; motions, clocks and noise do not depend on what is hidden."""
    instruments = Instruments.of(seed, video=rig.throws > 1)
    taken, starts = [], []
    for k in range(demonstrations * rig.throws):
        trial = rig.plan(np.random.default_rng([seed, k, *rig.name.encode()]))
        motion = simulate(rig, physics, trial)
        rng = np.random.default_rng([seed, k, 1, *rig.name.encode()])
        measured = {s.name: _reading(rig, physics, s, motion, instruments, rng) for s in rig.sensors}
        start = _start(rig, motion) if rig.free else None
        known = (None, None) if start is None or not rig.start_recorded else _estimate(start, rng)
        action = {name: Channel(time, value) for name, (time, value) in trial.action.items()}
        taken.append(Demonstration(f"demo_{k}", rig.name, None, *known, action=action, measured=measured))
        starts.append(start)
    return Made(Recording(rig.scene.xml, tuple(taken), source=f"world on {rig.engine}, {rig.name}"), tuple(starts))


def _reading(
    rig: ForeignRig,
    physics: Physics,
    sensor: Sensor,
    motion: ForeignMotion,
    instruments: Instruments,
    rng: np.random.Generator,
) -> Channel:
    """Return what a sensor writes down."""
    value = truth_of(rig, physics, sensor, motion)
    instrument = _instrument(sensor, instruments)
    tracked = any(s.kind in ("marker", "position") for s in rig.sensors)
    late = sensor.kind in ("marker", "position", "orientation") or not tracked
    if late and physics.sensor_delay:
        instrument = replace(instrument, latency=instrument.latency + physics.sensor_delay)
    channel = instrument.read(motion.time, value, rng)
    for measure in physics.measures:
        time, seen = measure(sensor.name, channel.time, channel.value)
        channel = replace(channel, time=time, value=seen)
    return channel


def truth_of(rig: ForeignRig, physics: Physics, sensor: Sensor, motion: ForeignMotion) -> np.ndarray:
    """Return what there is to see of a sensor's target, shape (K, dim)."""
    if sensor.kind in ENCODERS:
        state = next((physics.drives[d.actuator] for d in rig.drives if d.joint == sensor.target), DriveState())
        position = motion.motors[sensor.target] if state.compliance else motion.joints[sensor.target]
        return (position - state.offset)[:, None]
    pose = motion.poses[sensor.target]
    if sensor.kind == "orientation":
        flips = np.where((pose[1:, 3:] * pose[:-1, 3:]).sum(axis=1) < 0, -1.0, 1.0)
        return pose[:, 3:] * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    offset = np.array(sensor.offset(physics.values))
    return pose[:, :3] + Rotation.from_quat(pose[:, 3:], scalar_first=True).apply(offset)


def _instrument(sensor: Sensor, instruments: Instruments) -> Instrument:
    return getattr(instruments, "position" if sensor.kind == "marker" else sensor.kind)


def _start(rig: ForeignRig, motion: ForeignMotion) -> tuple[np.ndarray, np.ndarray]:
    """Return the nominal scene's state at time 0, qpos (nq,) and qvel (nv,); driven joints stand before the body."""
    pose = motion.poses[rig.body]
    k = int(np.searchsorted(motion.time, -1e-9))
    span = motion.time[k + 2] - motion.time[k - 2]
    before, after = Rotation.from_quat(pose[[k - 2, k + 2], 3:], scalar_first=True)
    turning = (before.inv() * after).as_rotvec() / span
    driven = [motion.joints[d.joint][[k - 2, k, k + 2]] for d in rig.drives]
    rate = (pose[k + 2, :3] - pose[k - 2, :3]) / span
    joints, rates = [x[1] for x in driven], [(x[2] - x[0]) / span for x in driven]
    return np.concatenate([joints, pose[k]]), np.concatenate([rates, rate, turning])


def _estimate(start: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the state of a single free body with the errors of an estimate."""
    position, orientation, velocity, turning = START_STD
    pose, rate = start[0].copy(), start[1].copy()
    pose[:3] += rng.normal(0, position, 3)
    wrong = Rotation.from_rotvec(rng.normal(0, orientation, 3))
    pose[3:] = (Rotation.from_quat(pose[3:], scalar_first=True) * wrong).as_quat(scalar_first=True)
    rate += np.concatenate([rng.normal(0, velocity, 3), rng.normal(0, turning, 3)])
    return pose, rate
