"""Measured motion of hinges and slides: by their own sensors, by tendons, equalities and loops, and by markers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.estimation.closed_loops import ClosedLoopCfg, close_loops
from concent_warp.estimation.local_polynomial import LocalPolynomialCfg
from concent_warp.estimation.marked_joints import KnownJoints, marked_joints
from concent_warp.estimation.signals import Estimate, MeasuredJoint, Signal, sample_values_and_rates
from concent_warp.estimation.smoothing_spline import SmoothingSplineCfg
from concent_warp.recording.recording import Channel

if TYPE_CHECKING:
    from concent_warp.recording.recording import Demonstration

SENSOR = mujoco.mjtSensor
HINGE_OR_SLIDE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
RATE_SENSORS = {SENSOR.mjSENS_JOINTPOS: SENSOR.mjSENS_JOINTVEL, SENSOR.mjSENS_TENDONPOS: SENSOR.mjSENS_TENDONVEL}
"""The sensor that measures the rate of what another one measures."""
MIN_SINGULAR = 1e-6
"""Smallest singular value of the equations that determine joints; below it some joint counts as not measured."""
SmootherCfg = LocalPolynomialCfg | SmoothingSplineCfg


@dataclass(frozen=True)
class CoupledJoints:
    """Joint positions as the least-squares solution of linear equations: readings, and equalities of the scene."""

    qpos: np.ndarray
    """Addresses of the joints in qpos, shape (J,)."""
    dof: np.ndarray
    """Addresses in qvel, shape (J,)."""
    coefficients: np.ndarray
    """Coefficients of the joints in each equation, readings first, shape (E, J)."""
    readings: tuple[Signal, ...]
    """What was measured of the first equations' sums."""
    constants: np.ndarray
    """What the sums of the other equations are constantly."""

    def estimate(self, time: np.ndarray) -> Estimate:
        """Return positions and their derivatives at `time` (T,), shape (T, J)."""
        found = [signal.estimate(time) for signal in self.readings]
        inverse = np.linalg.pinv(self.coefficients)
        still = np.zeros((len(time), len(self.constants)))
        constant = np.broadcast_to(self.constants, still.shape)
        value, rate, second = (
            np.concatenate([*parts, rest], axis=1)
            for parts, rest in (
                ([e.value for e in found], constant),
                ([e.rate for e in found], still),
                ([e.second for e in found], still),
            )
        )
        # One product for each time: a product of matrices rounds otherwise.
        return Estimate(*(np.array([inverse @ row for row in rows]) for rows in (value, rate, second)))

    def covariance(self, time: np.ndarray) -> np.ndarray:
        """Return the covariance of position, velocity and acceleration of each joint, shape (T, J, 3, 3)."""
        inverse = np.linalg.pinv(self.coefficients)[:, : len(self.readings)]
        if not self.readings:
            return np.zeros((len(time), len(self.qpos), 3, 3))
        return np.einsum("jr,rtik->tjik", inverse**2, np.array([s.covariance(time) for s in self.readings]))

    def sample(self, time: np.ndarray, count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity at `time` (T,), followed by `count` samples, shapes (1 + count, T, J)."""
        found = self.estimate(time)
        if rng is None or not count:
            return found.value[None], found.rate[None]
        covariance = self.covariance(time)[:, :, :2, :2]
        columns = [
            sample_values_and_rates(found.value[:, j : j + 1], found.rate[:, j : j + 1], covariance[:, j], count, rng)
            for j in range(len(self.qpos))
        ]
        return np.concatenate([c[0] for c in columns], axis=2), np.concatenate([c[1] for c in columns], axis=2)


def joint_signals(m: mujoco.MjModel, demonstration: Demonstration, smoother: SmootherCfg) -> tuple[MeasuredJoint, ...]:
    """Return the hinges and slides whose position a sensor measured."""
    found = []
    signals = _signals(m, demonstration, SENSOR.mjSENS_JOINTPOS, smoother)
    for joint in np.flatnonzero(np.isin(m.jnt_type, HINGE_OR_SLIDE)):
        if (pair := signals.get(int(joint))) is not None:
            unit = "rad" if m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE else "m"
            position, rate = pair
            velocity = None if rate is None else smoother.readings(rate, "joint")
            addresses = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
            found.append(MeasuredJoint(m.joint(joint).name or f"joint{joint}", unit, *addresses, position, velocity))
    return tuple(found)


def joint_rates(m: mujoco.MjModel, demonstration: Demonstration, smoother: LocalPolynomialCfg) -> dict[int, Signal]:
    """Return the velocities of the hinges and slides of which a sensor measured the velocity alone, by their joints."""
    positions = _channels(m, demonstration, SENSOR.mjSENS_JOINTPOS)
    rates = _channels(m, demonstration, SENSOR.mjSENS_JOINTVEL)
    smoothed = {joint: smoother.readings(rate, "joint") for joint, rate in rates.items() if joint not in positions}
    return {joint: readings for joint, readings in smoothed.items() if readings is not None}


def coupled_joints(
    m: mujoco.MjModel,
    demonstration: Demonstration,
    smoother: SmootherCfg,
    measured: Sequence[MeasuredJoint],
    min_singular: float,
) -> CoupledJoints:
    """Return the positions of all hinges and slides, see `determined_joints`.

    Raises:
        RecordingError: The measurements do not determine a joint.
    """
    found, loose = determined_joints(m, demonstration, smoother, measured, min_singular)
    if loose.any():
        joints = m.dof_jntid[found.dof[loose]]
        raise RecordingError(
            "a window cannot start where joints were not measured",
            where=demonstration.name,
            expected=f"readings of {[m.joint(int(j)).name for j in joints]}",
            fix="record joint position sensors, or fit whole demonstrations",
        )
    return found


def determined_joints(
    m: mujoco.MjModel,
    demonstration: Demonstration,
    smoother: SmootherCfg,
    measured: Sequence[MeasuredJoint],
    min_singular: float,
) -> tuple[CoupledJoints, np.ndarray]:
    """Return the positions of hinges and slides, from sensors, the scene's equalities and poses of the bodies on them.

    Args:
        m: The compiled scene.
        demonstration: What was measured.
        smoother: How readings are smoothed.
        measured: The joints whose position a sensor measured.
        min_singular: Smallest singular value of equations that determine all joints.

    Returns:
        The joints, and which of them the measurements do not determine, shape (J,) bool.
    """
    joints = np.flatnonzero(np.isin(m.jnt_type, HINGE_OR_SLIDE))
    column = {int(joint): i for i, joint in enumerate(joints)}
    by_dof = {joint.dof: joint.position for joint in measured}
    equations: list[np.ndarray] = []
    readings: list[Signal] = []
    for joint in _channels(m, demonstration, SENSOR.mjSENS_JOINTPOS):
        if joint in column and int(m.jnt_dofadr[joint]) in by_dof:
            equations.append(np.eye(len(joints))[column[joint]])
            readings.append(by_dof[int(m.jnt_dofadr[joint])])
    for tendon, (signal, _) in _signals(m, demonstration, SENSOR.mjSENS_TENDONPOS, smoother).items():
        if (coefficients := _tendon_coefficients(m, tendon, column)) is not None:
            equations.append(coefficients)
            readings.append(signal)
    couplings = _equalities(m, column)
    constants = np.array([constant for _, constant in couplings])

    def joined() -> CoupledJoints:
        rows = [*equations, *(coefficients for coefficients, _ in couplings)]
        matrix = np.array(rows) if rows else np.zeros((0, len(joints)))
        return CoupledJoints(m.jnt_qposadr[joints], m.jnt_dofadr[joints], matrix, tuple(readings), constants)

    found = joined()
    loose = _loose(found.coefficients, min_singular)
    if loose.any() and readings:
        for k, signal in _closed_by_loops(m, demonstration, smoother, found, loose).items():
            equations.append(np.eye(len(joints))[k])
            readings.append(signal)
        found = joined()
        loose = _loose(found.coefficients, min_singular)
    if loose.any():
        for k, signal in _told_by_poses(m, demonstration, smoother, found, loose).items():
            equations.append(np.eye(len(joints))[k])
            readings.append(signal)
        found = joined()
        loose = _loose(found.coefficients, min_singular)
    return found, loose


def _loose(rows: np.ndarray, min_singular: float) -> np.ndarray:
    """Return which of J joints linear equations, shape (E, J), do not determine, shape (J,) bool."""
    count = rows.shape[1]
    if not count or (len(rows) >= count and np.linalg.svd(rows, compute_uv=False)[-1] >= min_singular):
        return np.zeros(count, dtype=bool)
    return np.abs(np.eye(count) - np.linalg.pinv(rows) @ rows).max(axis=1) > min_singular


def _closed_by_loops(
    m: mujoco.MjModel, demonstration: Demonstration, smoother: SmootherCfg, known: CoupledJoints, loose: np.ndarray
) -> dict[int, Signal]:
    """Return the positions of joints that closed loops determine, by their index among those of the equations.

    Args:
        m: The compiled scene.
        demonstration: What was measured.
        smoother: How positions are smoothed.
        known: All joints, of which some are determined.
        loose: Those that are not, shape (J,) bool.
    """
    if not (m.eq_type < int(mujoco.mjtEq.mjEQ_JOINT)).any():  # neither connect nor weld
        return {}
    time = max((signal.time for signal in known.readings), key=len)
    if len(time) > 1:
        rate = 1 / float(np.median(np.diff(time)))
        time = time[:: max(math.ceil(rate / ClosedLoopCfg.max_rate - 1e-6), 1)]
    qpos = np.tile(m.qpos0 if demonstration.qpos is None else demonstration.qpos, (len(time), 1))
    qpos[:, known.qpos[~loose]] = known.estimate(time).value[:, ~loose]
    closed = close_loops(m, qpos, known.dof[loose])
    if closed is None:
        return {}
    return _smoothed(smoother, time, closed[:, known.qpos[loose]], loose)


def _told_by_poses(
    m: mujoco.MjModel, demonstration: Demonstration, smoother: SmootherCfg, known: CoupledJoints, loose: np.ndarray
) -> dict[int, Signal]:
    """Return the positions of joints that poses of bodies on them tell, by their index among those of the equations.

    Args:
        m: The compiled scene.
        demonstration: What was measured.
        smoother: How positions are smoothed.
        known: All joints, of which some are determined.
        loose: Those that are not, shape (J,) bool.
    """
    others = KnownJoints(known.dof[~loose], lambda time: known.estimate(time).value[:, ~loose])
    told = marked_joints(m, demonstration, known.dof[loose], others)
    if told is None:
        return {}
    return _smoothed(smoother, *told, loose)


def _smoothed(smoother: SmootherCfg, time: np.ndarray, value: np.ndarray, loose: np.ndarray) -> dict[int, Signal]:
    """Return the signals of joints by their index, from positions (T, U) of those that are loose, (J,) bool."""
    found: dict[int, Signal] = {}
    for column, k in enumerate(np.flatnonzero(loose)):
        signal = smoother.signal(Channel(time, value[:, [column]]), None, "joint")
        if signal is not None:
            found[int(k)] = signal
    return found


def _signals(
    m: mujoco.MjModel, demonstration: Demonstration, kind: mujoco.mjtSensor, smoother: SmootherCfg
) -> dict[int, tuple[Signal, Channel | None]]:
    """Return what the sensors of a kind measured, and the channel of the rate, by the id of the joint or tendon."""
    result = {}
    rates = _channels(m, demonstration, RATE_SENSORS[kind])
    for target, channel in _channels(m, demonstration, kind).items():
        rate = rates.get(target)
        if (signal := smoother.signal(channel, rate, "joint")) is not None:
            result[target] = (signal, rate)
    return result


def _channels(m: mujoco.MjModel, demonstration: Demonstration, kind: mujoco.mjtSensor) -> dict[int, Channel]:
    """Return the channels of the sensors of a kind by the id of their joint or tendon; the first of several alike."""
    found: dict[int, Channel] = {}
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row >= 0 and int(m.sensor_type[row]) == int(kind):
            found.setdefault(int(m.sensor_objid[row]), channel)
    return found


def _tendon_coefficients(m: mujoco.MjModel, tendon: int, column: dict[int, int]) -> np.ndarray | None:
    """Return the coefficients (J,) of the joints in the length of a tendon; None if sites guide it."""
    result = np.zeros(len(column))
    start = int(m.tendon_adr[tendon])
    for wrap in range(start, start + int(m.tendon_num[tendon])):
        if int(m.wrap_type[wrap]) != int(mujoco.mjtWrap.mjWRAP_JOINT):
            return None
        result[column[int(m.wrap_objid[wrap])]] += m.wrap_prm[wrap]
    return result


def _equalities(m: mujoco.MjModel, column: dict[int, int]) -> list[tuple[np.ndarray, float]]:
    """Return the sums of joint positions that active linear joint equalities keep constant: coefficients, constant."""
    result = []
    for row in range(m.neq):
        first, second = int(m.eq_obj1id[row]), int(m.eq_obj2id[row])
        constant, slope, *curved = m.eq_data[row, :5]
        linear = int(m.eq_type[row]) == int(mujoco.mjtEq.mjEQ_JOINT) and not np.any(curved)
        if not (linear and m.eq_active0[row] and first in column):
            continue
        coefficients = np.zeros(len(column))
        coefficients[column[first]] = 1.0
        total = m.qpos0[m.jnt_qposadr[first]] + constant
        if second >= 0:
            coefficients[column[second]] = -slope
            total -= slope * m.qpos0[m.jnt_qposadr[second]]
        result.append((coefficients, float(total)))
    return result
