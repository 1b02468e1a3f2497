"""The motion that was measured: positions and velocities of joints and free bodies over time, with their errors.

Each joint and body is smoothed from its own channels at their own clocks; what was not measured is taken from the
model's replay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.estimation.noise import channel_noise
from concent_warp.estimation.rotations import same_sign
from concent_warp.estimation.sensors import Kind
from concent_warp.estimation.smoothing_spline import Smooth, smooth
from concent_warp.simulate.replay import commands, initial_state, interpolate, replay, step_count

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Channel, Demonstration
    from concent_warp.simulate.engine import Engine

SENSOR = mujoco.mjtSensor
SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
LEAST_NOISE = 1e-5
"""Noise taken at least, as a share of the range of the readings: a time step leaves about as much."""


@dataclass(frozen=True)
class SmoothedSignal:
    """Readings of one thing and what they smooth to."""

    time: np.ndarray
    """Shape (T,) [s]; readings that are missing are left out."""
    value: np.ndarray
    """Shape (T, dim); of orientations quaternions wxyz of the body frame, with aligned signs."""
    std: float
    """Noise per component; of orientations per component of the rotation vector [rad]."""
    smooth: Smooth


@dataclass(frozen=True)
class SmoothedJointMotion:
    """A hinge or slide whose position was measured."""

    name: str
    unit: str
    """"rad" or "m"."""
    qpos: int
    dof: int
    position: SmoothedSignal
    velocity: SmoothedSignal | None
    """Readings of the velocity, where there are any."""


@dataclass(frozen=True)
class SmoothedBodyMotion:
    """A free body whose position was measured, and its orientation as a rule."""

    name: str
    body: int
    qpos: int
    dof: int
    position: SmoothedSignal
    """Of the body frame's origin [m], world frame."""
    orientation: SmoothedSignal | None


@dataclass(frozen=True)
class MeasuredMotion:
    """What was measured of a demonstration, as motion of a model."""

    compiled: mujoco.MjModel
    joints: tuple[SmoothedJointMotion, ...]
    bodies: tuple[SmoothedBodyMotion, ...]
    base_time: np.ndarray
    """Times of the model's replay [s], shape (R,)."""
    base_qpos: np.ndarray
    """Shape (R, nq): what stands in for what was not measured."""
    base_qvel: np.ndarray
    """Shape (R, nv)."""
    ctrl: np.ndarray
    """Commands as they act on each time step of the model from time 0 on, shape (S, nu)."""

    @property
    def span(self) -> tuple[float, float]:
        """First and last instant at which all that was measured was [s]."""
        spans = [s.smooth.span for s in self.signals()]
        return max(a for a, _ in spans), min(b for _, b in spans)

    @property
    def period(self) -> float:
        """Time between readings of the slowest signal [s]."""
        return max(float(np.median(np.diff(s.time))) for s in self.signals())

    def signals(self) -> list[SmoothedSignal]:
        """Return all signals."""
        found = [j.position for j in self.joints] + [b.position for b in self.bodies]
        return found + [b.orientation for b in self.bodies if b.orientation is not None]

    def states(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoothed states at `time` (T,), qpos (T, nq) and qvel (T, nv)."""
        qpos, qvel = self.draws(time, 0, None)
        return qpos[0], qvel[0]

    def draws(self, time: np.ndarray, count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoothed states at `time` (T,), and `count` drawn from their errors after them.

        Shapes (1 + count, T, nq) and (1 + count, T, nv).
        """
        m = self.compiled
        qpos = interpolate(self.base_time, self.base_qpos, time)
        for j in range(m.njnt):
            if int(m.jnt_type[j]) not in SCALAR:
                start = m.jnt_qposadr[j] + (3 if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE else 0)
                qpos[:, start : start + 4] /= np.linalg.norm(qpos[:, start : start + 4], axis=1, keepdims=True)
        qvel = interpolate(self.base_time, self.base_qvel, time)
        qpos, qvel = np.tile(qpos, (1 + count, 1, 1)), np.tile(qvel, (1 + count, 1, 1))
        for joint in self.joints:
            position, velocity = _drawn(joint.position.smooth, time, count, rng)
            qpos[:, :, joint.qpos], qvel[:, :, joint.dof] = position[..., 0], velocity[..., 0]
        for body in self.bodies:
            position, velocity = _drawn(body.position.smooth, time, count, rng)
            qpos[:, :, body.qpos : body.qpos + 3], qvel[:, :, body.dof : body.dof + 3] = position, velocity
            if body.orientation is not None:
                quaternion, rate = _drawn(body.orientation.smooth, time, count, rng)
                qvel[:, :, body.dof + 3 : body.dof + 6] = _turning(quaternion, rate)
                quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
                qpos[:, :, body.qpos + 3 : body.qpos + 7] = quaternion
        return qpos, qvel

    def acceleration(self, time: np.ndarray) -> np.ndarray:
        """Return the smoothed accelerations at `time` (T,), shape (T, nv); 0 where nothing was measured."""
        qacc = np.zeros((len(time), self.compiled.nv))
        for joint in self.joints:
            qacc[:, joint.dof] = joint.position.smooth.at(time, 2)[:, 0]
        for body in self.bodies:
            qacc[:, body.dof : body.dof + 3] = body.position.smooth.at(time, 2)
        return qacc


def _drawn(
    signal: Smooth, time: np.ndarray, count: int, rng: np.random.Generator | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return a signal and its velocity at `time` (T,), and `count` drawn from their joint error after them.

    Shapes (1 + count, T, dim).
    """
    both = np.stack([signal.at(time), signal.at(time, 1)], axis=1)
    if rng is None or not count:
        return both[None, :, 0], both[None, :, 1]
    spread, axes = np.linalg.eigh(signal.covariance(time)[:, :2, :2])
    root = axes * np.sqrt(np.maximum(spread, 0))[:, None]
    error = np.einsum("tij,ntjd->ntid", root, rng.standard_normal((count, *both.shape)))
    both = np.concatenate([both[None], both + error])
    return both[:, :, 0], both[:, :, 1]


def _turning(quaternion: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return angular velocities in the body frame [rad/s], (..., 3), of quaternions (..., 4) and their rates (..., 4).

    omega = 2 conj(q) dq / |q|^2, vector part.
    """
    w, v = quaternion[..., :1], quaternion[..., 1:]
    vector = w * rate[..., 1:] - rate[..., :1] * v - np.cross(v, rate[..., 1:])
    return 2 * vector / (quaternion**2).sum(axis=-1, keepdims=True)


def measured_motion(model: Model, demonstration: Demonstration, engine: Engine) -> MeasuredMotion:
    """Return the motion that was measured.

    Raises:
        RecordingError: No joint position and no position of a free body was measured, or too few samples.
    """
    m = engine.compiled
    joints, bodies = _joint_motions(m, demonstration), _body_motions(m, demonstration)
    if not joints and not bodies:
        raise RecordingError(
            "no motion to locate forces in",
            where=demonstration.name,
            expected="a few readings of a joint's position (jointpos) or of a free body's (framepos)",
            found=sorted(demonstration.measured),
        )
    qpos, qvel = initial_state(m, demonstration)
    time = np.array([0.0, max(demonstration.duration, engine.timestep)])
    base = time, np.stack([qpos, qpos]), np.stack([qvel, qvel])
    ctrl = commands(m, demonstration, step_count(demonstration, engine.timestep) + 1)
    for added in model.effects:
        ctrl = added.effect.command(m, ctrl, added.array)
    covered = len(joints) + sum(3 + 3 * (b.orientation is not None) for b in bodies)
    if covered < m.nv:
        rollout = replay(model, demonstration, engine, bodies=()).numpy()
        if np.isfinite(rollout.qpos).all() and np.isfinite(rollout.qvel).all():
            base = rollout.time, np.asarray(rollout.qpos[0], float), np.asarray(rollout.qvel[0], float)
    return MeasuredMotion(m, joints, bodies, *base, ctrl)


def _joint_motions(m: mujoco.MjModel, demonstration: Demonstration) -> tuple[SmoothedJointMotion, ...]:
    """Return the measured hinges and slides."""
    found = []
    channels = _sensed(m, demonstration)
    for j in range(m.njnt):
        channel = channels.get((int(SENSOR.mjSENS_JOINTPOS), j))
        if int(m.jnt_type[j]) not in SCALAR or channel is None:
            continue
        std = _noise_of(channel, "joint")
        velocity = None
        if (rate := channels.get((int(SENSOR.mjSENS_JOINTVEL), j))) is not None:
            velocity = _signal(rate.time, rate.value, rate_std := _noise_of(rate, "joint"), rate_std)
        position = _signal(channel.time, channel.value, std, std, velocity)
        if position is not None:
            unit = "rad" if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE else "m"
            name = m.joint(j).name or f"joint{j}"
            found.append(
                SmoothedJointMotion(name, unit, int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j]), position, velocity)
            )
    return tuple(found)


def _body_motions(m: mujoco.MjModel, demonstration: Demonstration) -> tuple[SmoothedBodyMotion, ...]:
    """Return the measured free bodies; a frame sensor may sit on the body, its inertial frame, a site or a geom."""
    found: dict[int, SmoothedBodyMotion] = {}
    posed: dict[int, dict[int, tuple[Channel, np.ndarray, Rotation]]] = {}
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        kind = int(m.sensor_type[row]) if row >= 0 else -1
        if kind in (int(SENSOR.mjSENS_FRAMEPOS), int(SENSOR.mjSENS_FRAMEQUAT)) and m.sensor_refid[row] < 0:
            place = _frame_in_body(m, row)
            if place is not None:
                posed.setdefault(place[0], {}).setdefault(kind, (channel, place[1], place[2]))
    for body, channels in posed.items():
        joint = m.body_jntadr[body]
        if joint < 0 or m.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE or int(SENSOR.mjSENS_FRAMEPOS) not in channels:
            continue
        orientation = None
        if int(SENSOR.mjSENS_FRAMEQUAT) in channels:
            channel, _, turn = channels[int(SENSOR.mjSENS_FRAMEQUAT)]
            orientation = _orientation_signal(channel, turn)
        channel, offset, _ = channels[int(SENSOR.mjSENS_FRAMEPOS)]
        value = np.array(channel.value, dtype=float)
        if np.any(offset):
            if orientation is None:
                continue
            quaternion = orientation.smooth.at(channel.time)
            value = value - Rotation.from_quat(quaternion, scalar_first=True).apply(offset)
        position = _signal(channel.time, value, std := _noise_of(channel, "position"), std)
        if position is not None:
            name = m.body(body).name or f"body{body}"
            addresses = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
            found[body] = SmoothedBodyMotion(name, body, *addresses, position, orientation)
    return tuple(found[body] for body in sorted(found))


def _frame_in_body(m: mujoco.MjModel, row: int) -> tuple[int, np.ndarray, Rotation] | None:
    """Return the body that a frame sensor sits on, where on it [m], and how the frame is turned against the body's."""
    target, kind = int(m.sensor_objid[row]), int(m.sensor_objtype[row])
    if kind == mujoco.mjtObj.mjOBJ_XBODY:
        return target, np.zeros(3), Rotation.identity()
    if kind == mujoco.mjtObj.mjOBJ_BODY:
        body, offset, turn = target, m.body_ipos[target], m.body_iquat[target]
    elif kind == mujoco.mjtObj.mjOBJ_SITE:
        body, offset, turn = int(m.site_bodyid[target]), m.site_pos[target], m.site_quat[target]
    elif kind == mujoco.mjtObj.mjOBJ_GEOM:
        body, offset, turn = int(m.geom_bodyid[target]), m.geom_pos[target], m.geom_quat[target]
    else:
        return None
    return body, np.array(offset), Rotation.from_quat(turn, scalar_first=True)


def _orientation_signal(channel: Channel, turn: Rotation) -> SmoothedSignal | None:
    """Return readings of a frame that is turned by `turn` against its body, as orientations of the body."""
    std = _noise_of(channel, "orientation")
    valid = np.isfinite(channel.value).all(axis=1)
    if not valid.any():
        return None
    body = Rotation.from_quat(channel.value[valid], scalar_first=True) * turn.inv()
    quaternion = same_sign(body.as_quat(scalar_first=True))
    return _signal(channel.time[valid], quaternion, std, std / 2)


def _signal(
    time: np.ndarray,
    value: np.ndarray,
    std: float,
    component_std: float,
    velocity: SmoothedSignal | None = None,
) -> SmoothedSignal | None:
    """Return readings with their smoothed form; None where there are too few."""
    valid = np.isfinite(value).all(axis=1)
    rate = None if velocity is None else (velocity.time, velocity.value, velocity.std)
    smoothed = smooth(time, value, component_std, rate)
    return None if smoothed is None else SmoothedSignal(np.asarray(time[valid], float), value[valid], std, smoothed)


def _noise_of(channel: Channel, kind: Kind) -> float:
    """Return the noise of a channel, never 0."""
    valid = channel.value[np.isfinite(channel.value).all(axis=1)]
    least = LEAST_NOISE * max(float(np.ptp(valid, axis=0).max(initial=0)) if len(valid) else 0.0, 1e-3)
    return float(np.fmax(channel_noise(channel, kind).std, least))


def _sensed(m: mujoco.MjModel, demonstration: Demonstration) -> dict[tuple[int, int], Channel]:
    """Return the measured channels by type and target of their sensors; the first of several alike."""
    found: dict[tuple[int, int], Channel] = {}
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row >= 0:
            found.setdefault((int(m.sensor_type[row]), int(m.sensor_objid[row])), channel)
    return found
