"""Joint positions and velocities in the middle of a demonstration, as its joint and tendon sensors say them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.estimation.local_polynomial import Samples, finite, more_precise
from concent_warp.recording.recording import Demonstration

HINGE_OR_SLIDE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
SINGULAR = 1e-6
"""Couplings whose smallest singular value is below this do not determine the joints without sensors."""


@dataclass(frozen=True)
class JointMotion:
    """How the hinges and slides of a scene were measured to move."""

    joints: np.ndarray
    """Their joint ids, shape (J,)."""
    readings: tuple[tuple[np.ndarray, Samples, Samples | None], ...]
    """Coefficients (J,) of the joints in a measured sum, the sum, and its rate where a sensor is more precise."""
    couplings: tuple[tuple[np.ndarray, float], ...]
    """Coefficients of the joints in a sum that the scene's equalities keep constant, shape (J,), and that constant."""

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities [m, m/s or rad, rad/s], each of shape (J,)."""
        estimates = [signal.at(time) for _, signal, _ in self.readings]
        rates = [
            e.rate if rate is None else rate.at(time).value
            for e, (_, _, rate) in zip(estimates, self.readings, strict=True)
        ]
        value = np.array([e.value[0] for e in estimates] + [constant for _, constant in self.couplings])
        rate = np.array([r[0] for r in rates] + [0.0] * len(self.couplings))
        inverse = np.linalg.pinv(self.rows())
        return inverse @ value, inverse @ rate

    def rows(self) -> np.ndarray:
        """Return all coefficients, shape (readings + couplings, J)."""
        rows = [c for c, *_ in (*self.readings, *self.couplings)]
        return np.array(rows) if rows else np.zeros((0, len(self.joints)))


def joint_motion(model: mujoco.MjModel, demonstration: Demonstration) -> JointMotion:
    """Return how the hinges and slides of a scene moved.

    What no sensor reads must follow from what tendons and equalities couple it to.

    Raises:
        RecordingError: The measurements leave a joint open, or there is a ball joint.
    """
    joints = np.flatnonzero(np.isin(model.jnt_type, HINGE_OR_SLIDE))
    if (model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)).any():
        raise RecordingError("windows cannot start in a scene with ball joints", where=demonstration.name)
    place = {int(joint): i for i, joint in enumerate(joints)}
    readings = tuple(
        (coefficients, signal, rate)
        for kind, speed in (
            (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL),
            (mujoco.mjtSensor.mjSENS_TENDONPOS, mujoco.mjtSensor.mjSENS_TENDONVEL),
        )
        for target, signal in _sensors(model, demonstration, kind).items()
        if (coefficients := _combination(model, kind, target, place)) is not None
        for rate in [more_precise(_sensors(model, demonstration, speed).get(target), signal)]
    )
    motion = JointMotion(joints, readings, tuple(_couplings(model, place)))
    rows = motion.rows()
    if len(joints) and (len(rows) < len(joints) or np.linalg.svd(rows, compute_uv=False)[-1] < SINGULAR):
        loose = np.abs(np.eye(len(joints)) - np.linalg.pinv(rows) @ rows).max(axis=1) > SINGULAR
        raise RecordingError(
            "a window cannot start where joints were not measured",
            where=demonstration.name,
            expected=f"readings of {[model.joint(int(j)).name for j in joints[loose]]}",
            fix="record joint position sensors, or fit whole demonstrations",
        )
    return motion


def _sensors(model: mujoco.MjModel, demonstration: Demonstration, kind: mujoco.mjtSensor) -> dict[int, Samples]:
    """Return what the sensors of a kind measured, by the id of the joint or tendon."""
    result = {}
    for name, channel in demonstration.measured.items():
        sensor = model.sensor(name).id
        if int(model.sensor_type[sensor]) == int(kind) and (samples := finite(channel)) is not None:
            degree = 2 if kind in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_TENDONPOS) else 1
            result[int(model.sensor_objid[sensor])] = Samples(samples.time, samples.value, degree)
    return result


def _combination(
    model: mujoco.MjModel, kind: mujoco.mjtSensor, target: int, place: dict[int, int]
) -> np.ndarray | None:
    """Return the coefficients (J,) of the joints in what a sensor reads; None for a tendon that goes by sites."""
    result = np.zeros(len(place))
    if kind == mujoco.mjtSensor.mjSENS_JOINTPOS:
        if target not in place:
            return None
        result[place[target]] = 1.0
        return result
    start = int(model.tendon_adr[target])
    for wrap in range(start, start + int(model.tendon_num[target])):
        if int(model.wrap_type[wrap]) != int(mujoco.mjtWrap.mjWRAP_JOINT):
            return None
        result[place[int(model.wrap_objid[wrap])]] += model.wrap_prm[wrap]
    return result


def _couplings(model: mujoco.MjModel, place: dict[int, int]) -> list[tuple[np.ndarray, float]]:
    """Return the sums of joint positions that active linear joint equalities keep constant."""
    result = []
    for row in range(model.neq):
        first, second = int(model.eq_obj1id[row]), int(model.eq_obj2id[row])
        constant, slope, *curved = model.eq_data[row, :5]
        linear = int(model.eq_type[row]) == int(mujoco.mjtEq.mjEQ_JOINT) and not np.any(curved)
        if not (linear and model.eq_active0[row] and first in place):
            continue
        coefficients = np.zeros(len(place))
        coefficients[place[first]] = 1.0
        total = model.qpos0[model.jnt_qposadr[first]] + constant
        if second >= 0:
            coefficients[place[second]] = -slope
            total -= slope * model.qpos0[model.jnt_qposadr[second]]
        result.append((coefficients, float(total)))
    return result
