"""Replay of a recording: its commands through an engine, its measurements predicted at their own times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.effects.select import servo_gain
from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.scene.sensor_frame import SensorFrame, sensor_frame
from concent_warp.simulate.engine import Contacts, Engine, Rollout, Variants
from concent_warp.simulate.initial_joints import FRAMES, LENGTHS, InitialReadings, with_unmeasured_joints

if TYPE_CHECKING:
    from collections.abc import Sequence

    from concent_warp.model import Model
    from concent_warp.recording.recording import Channel, Demonstration

RESTING = 0.03
"""Time [s] over which a joint that is at rest when a recording begins does not move yet."""
MIN_RESTING = 3
"""Readings at least in that time."""
FOLLOWING = 1.0
"""Time [s] within which it has followed a step of its command."""
JUMP_SHARE = 0.1
"""Least step of the command over the range of the joint in the recording [-]: less may be sag or an offset."""
MOVED_SHARE = 0.05
"""Share of the step up to which a joint is at rest [-]."""
FOLLOWED_SHARE = 0.5
"""Share of the step that it follows at least [-]."""
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

    Step k starts at `start` + k * dt and holds the last command given by then; before that the first one, or the one
    that held a robot at rest which the first one makes jump, see `resting_commands`.

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
    for i, held in resting_commands(model, demonstration).items() if start < 0 else ():
        ctrl[time + 1e-9 < demonstration.action[names[i]].time[0], i] = held
    return ctrl


def resting_commands(m: mujoco.MjModel, demonstration: Demonstration) -> dict[int, float]:
    """Return the commands before the first ones, where these are the first of a jump, of actuators by their row.

    A recording that begins with a step of the command does not say what was commanded before; a joint with a position
    servo that is at rest then, and follows the step later, was held where it is. Delays and lags reach back there.
    """
    jumping: dict[int, tuple[np.ndarray, float]] = {}
    for i in range(m.nu):
        if servo_gain(m, i) <= 0 or m.actuator_trntype[i] != int(mujoco.mjtTrn.mjTRN_JOINT):
            continue
        first = float(demonstration.action[m.actuator(i).name].value[0])
        read = _readings(m, demonstration, int(m.actuator_trnid[i, 0]))
        if read is not None and _follows_a_jump(read[0], value := float(m.actuator_gear[i, 0]) * read[1], first):
            jumping[i] = value, first
    if not jumping:
        return {}
    d, found = mujoco.MjData(m), {}
    d.qpos[:] = initial_state(m, demonstration)[0]
    mujoco.mj_forward(m, d)
    for i, (value, first) in jumping.items():
        dof = int(m.jnt_dofadr[m.actuator_trnid[i, 0]])
        load = float(d.qfrc_bias[dof] - d.qfrc_passive[dof])
        held = float(value[0]) + load / (servo_gain(m, i) * float(m.actuator_gear[i, 0]))
        if _is_jump(first - held, value):
            found[i] = held
    return found


def _readings(m: mujoco.MjModel, demonstration: Demonstration, joint: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return times and readings (n,) of a joint's position; None where it was not measured, or hardly."""
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row < 0 or m.sensor_type[row] != int(mujoco.mjtSensor.mjSENS_JOINTPOS) or m.sensor_objid[row] != joint:
            continue
        value = np.asarray(channel.value, dtype=float).reshape(len(channel.time), -1)[:, 0]
        known = np.isfinite(value)
        return (channel.time[known], value[known]) if known.sum() > MIN_RESTING else None
    return None


def _follows_a_jump(time: np.ndarray, value: np.ndarray, command: float) -> bool:
    """Return whether readings (n,) rest at first, away from the command, and then follow it most of the way."""
    jump = command - value[0]
    if not _is_jump(jump, value):
        return False
    resting = (time <= time[0] + RESTING) | (np.arange(len(time)) < MIN_RESTING)
    share = (value - value[0]) / jump
    return bool(
        np.abs(share[resting]).max() < MOVED_SHARE and share[time <= time[0] + FOLLOWING].max() > FOLLOWED_SHARE
    )


def _is_jump(jump: float, value: np.ndarray) -> bool:
    """Return whether a step of the command is more than sag, or an offset, beside the range of all readings."""
    return abs(jump) > JUMP_SHARE * np.ptp(value)


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

    One variant, see `Engine.run`, with the payloads of the demonstration; bodies are those of the model without.
    """
    compiled = model.scene.model
    if demonstration.payloads and bodies is None:
        bodies = [engine.compiled.body(b).name for b in range(engine.compiled.nbody)]
    engine = engine.carrying(demonstration.payloads) if demonstration.payloads else engine
    steps = step_count(demonstration, engine.timestep)
    qpos, qvel = initial_state(compiled, demonstration)
    ctrl = acting_commands(model, compiled, demonstration, steps)
    variants = Variants(1, qpos=qpos[None], qvel=qvel[None])
    return engine.run(variants, ctrl, record=record, bodies=bodies, contacts=contacts)


def acting_commands(model: Model, m: mujoco.MjModel, demonstration: Demonstration, steps: int) -> np.ndarray:
    """Return the recorded commands at each step as the model's effects change them, shape (steps, nu)."""
    before = int(np.ceil(max((a.effect.history for a in model.effects), default=0.0) / m.opt.timestep))
    ctrl = commands(m, demonstration, before + steps, -before * m.opt.timestep)
    for added in model.effects:
        ctrl = added.effect.command(m, ctrl, added.array)
    return ctrl[before:]


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
