"""Replay of a recording: its commands through an engine, its measurements predicted at their own times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.scene.sensor_frame import SensorFrame, sensor_frame
from concent_warp.simulate.engine import Contacts, Engine, Rollout, Variants
from concent_warp.simulate.initial_joints import FRAMES, LENGTHS, InitialReadings, with_unmeasured_joints

if TYPE_CHECKING:
    from collections.abc import Sequence

    from concent_warp.model import Model
    from concent_warp.recording.recording import Channel, Demonstration

UNIT_QUATERNION_SENSORS = (mujoco.mjtSensor.mjSENS_FRAMEQUAT, mujoco.mjtSensor.mjSENS_BALLQUAT)


def step_count(demonstration: Demonstration, timestep: float, duration: float | None = None) -> int:
    """Return how many steps of `timestep` [s] cover the demonstration, or its first `duration` seconds.

    Raises:
        RecordingError: They are more than `Limits` allow.
    """
    steps = np.ceil((demonstration.duration if duration is None else duration) / timestep - 1e-9)
    if not steps <= (most := limits().steps):
        raise RecordingError(
            "the replay takes too many steps",
            where=demonstration.name,
            expected=f"at most {most:,}",
            found=f"{steps:,.0f} of {timestep:g} s",
            fix=f"cut the recording or take a larger time step; {raising('steps')}",
        )
    return int(steps)


def commands(model: mujoco.MjModel, demonstration: Demonstration, steps: int, start: float = 0.0) -> np.ndarray:
    """Return the recorded commands at each step, zero-order hold, shape (steps, nu).

    Step k starts at `start` + k * dt and holds the last command given by then (the first one before that).

    Raises:
        RecordingError: An actuator has no commands, or commands name an actuator that the model lacks.
    """
    names = [model.actuator(i).name for i in range(model.nu)]
    if unknown := sorted(set(demonstration.action) - set(names)):
        raise RecordingError(
            "commands for actuators that the scene lacks",
            where=demonstration.name,
            expected=f"actuators among {names}",
            found=unknown,
        )
    if missing := [name for name in names if name not in demonstration.action]:
        raise RecordingError(
            "actuators without commands", where=demonstration.name, expected="an action for each", found=missing
        )
    time = start + np.arange(steps) * model.opt.timestep
    ctrl = np.zeros((steps, model.nu))
    for i, name in enumerate(names):
        channel = demonstration.action[name]
        row = np.searchsorted(channel.time, time + 1e-9, side="right") - 1
        ctrl[:, i] = channel.value[np.maximum(row, 0)]
    return ctrl


def initial_state(model: mujoco.MjModel, demonstration: Demonstration) -> tuple[np.ndarray, np.ndarray]:
    """Return the state at time 0, qpos (nq,) and qvel (nv,).

    What the recording does not say is taken from the first valid sample of joint and frame sensors, of positions for
    each component, and of joints without a sensor from what else tells them (`with_unmeasured_joints`), else from the
    model's reference pose; velocities are then zero.
    """
    if demonstration.qpos is not None and len(demonstration.qpos) != model.nq:
        raise RecordingError(
            "wrong number of positions in the initial state",
            where=demonstration.name,
            expected=model.nq,
            found=len(demonstration.qpos),
        )
    if demonstration.qvel is not None and len(demonstration.qvel) != model.nv:
        raise RecordingError(
            "wrong number of velocities in the initial state",
            where=demonstration.name,
            expected=model.nv,
            found=len(demonstration.qvel),
        )
    qvel = np.zeros(model.nv) if demonstration.qvel is None else np.array(demonstration.qvel, dtype=float)
    if demonstration.qpos is not None:
        return np.array(demonstration.qpos, dtype=float), qvel
    qpos = model.qpos0.copy()
    framed: list[tuple[int, SensorFrame, np.ndarray]] = []
    joints: list[int] = []
    others = InitialReadings()
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
        known = np.isfinite(channel.value)
        first = channel.value[known.all(axis=1)]
        if row < 0 or not known.any():
            continue
        kind = mujoco.mjtSensor(int(model.sensor_type[row]))
        if kind == mujoco.mjtSensor.mjSENS_JOINTPOS:
            qpos[model.jnt_qposadr[model.sensor_objid[row]]] = first[0, 0]
            joints.append(int(model.sensor_objid[row]))
            continue
        if int(kind) in LENGTHS:
            others.length.append((row, float(first[0, 0])))
            continue
        frame = sensor_frame(model, row)
        if frame is None or int(kind) not in FRAMES:
            continue
        joint = model.body_jntadr[frame.body]
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            if kind == mujoco.mjtSensor.mjSENS_FRAMEPOS:
                others.place.append((frame, _first_of_each(channel.value)))
            elif len(first):
                others.turn.append((frame, first[0]))
            continue
        address = int(model.jnt_qposadr[joint])
        if kind == mujoco.mjtSensor.mjSENS_FRAMEPOS:
            framed.append((address, frame, _first_of_each(channel.value)))
        elif kind == mujoco.mjtSensor.mjSENS_FRAMEQUAT and len(first):
            qpos[address + 3 : address + 7] = frame.body_in_world(first[0]).as_quat(scalar_first=True)
    # Of several frames on a body, its own says where it is.
    for address, frame, value in sorted(framed, key=lambda f: f[1].is_body):
        turned = Rotation.from_quat(qpos[address + 3 : address + 7], scalar_first=True)
        place = frame.place_in_world(value) - turned.apply(frame.offset)
        seen = np.isfinite(place)
        qpos[address : address + 3][seen] = place[seen]
    return with_unmeasured_joints(model, qpos, joints, others), qvel


def _first_of_each(value: np.ndarray) -> np.ndarray:
    """Return the first reading of each component of values (T, n), shape (n,), NaN where there is none."""
    known = np.isfinite(value)
    return np.array([value[k, i][0] if (k := known[:, i]).any() else np.nan for i in range(value.shape[1])])


def replay(
    model: Model,
    demonstration: Demonstration,
    engine: Engine,
    *,
    record: Sequence[int] | np.ndarray | None = None,
    bodies: Sequence[str] | None = None,
    contacts: Contacts = "none",
) -> Rollout:
    """Run the recorded commands, as the model's effects change them, from the recorded initial state.

    One variant, see `Engine.run`.
    """
    compiled = model.scene.model
    steps = step_count(demonstration, engine.timestep)
    qpos, qvel = initial_state(compiled, demonstration)
    ctrl = commands(compiled, demonstration, steps)
    for added in model.effects:
        ctrl = added.effect.command(compiled, ctrl, added.array)
    variants = Variants(1, qpos=qpos[None], qvel=qvel[None])
    return engine.run(variants, ctrl, record=record, bodies=bodies, contacts=contacts)


def bracketing(time: np.ndarray, timestep: float, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the steps to record so that values at `time` can be interpolated.

    Returns:
        record: Steps, increasing, shape (R,).
        lower: Row in `record` of the step at or before each time, shape (T,); the next row is the one after it.
        weight: Share of the later row, in 0..1, shape (T,).
    """
    position = np.clip(time / timestep, 0, steps)
    floor = np.minimum(np.floor(position + 1e-9).astype(int), max(steps - 1, 0))
    record = np.unique(np.concatenate([floor, floor + 1]))
    return record, np.searchsorted(record, floor), np.clip(position - floor, 0.0, 1.0)


def predict(model: mujoco.MjModel, rollout: Rollout, sensor: str, channel: Channel, variant: int = 0) -> np.ndarray:
    """Return what `sensor` reads at the channel's times, interpolated linearly, shape (T, dim).

    Quaternions are interpolated after aligning signs, and normalised. Times beyond the rollout give its last value.
    """
    row = model.sensor(sensor).id
    address, dim = model.sensor_adr[row], model.sensor_dim[row]
    value = np.asarray(rollout.sensordata[variant][:, address : address + dim], dtype=float)
    if int(model.sensor_type[row]) in UNIT_QUATERNION_SENSORS:
        flips = np.where((value[1:] * value[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        value = value * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
        result = interpolate(rollout.time, value, channel.time)
        return result / np.linalg.norm(result, axis=1, keepdims=True)
    return interpolate(rollout.time, value, channel.time)


def interpolate(time: np.ndarray, value: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return `value` (R, dim), sampled at `time` (R,), linearly interpolated at `at` (T,), shape (T, dim)."""
    return np.stack([np.interp(at, time, value[:, i]) for i in range(value.shape[1])], axis=1)
