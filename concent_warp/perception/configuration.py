"""The robot's configuration at given times, from its joint sensors, for calibration and tracking."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.recording.recording import Channel, Demonstration

SENSOR, TRANSMISSION = mujoco.mjtSensor, mujoco.mjtTrn


@dataclass(frozen=True)
class Readings:
    """Readings of a joint or a tendon that are there."""

    time: np.ndarray
    """Times [s], shape (T,)."""
    value: np.ndarray
    """Angles [rad], or travels or lengths [m], shape (T,)."""

    @staticmethod
    def of(channel: Channel) -> Readings:
        """Return the first component of a channel, without missing samples."""
        value = np.asarray(channel.value, float).reshape(len(channel.time), -1)[:, 0]
        valid = np.isfinite(value)
        return Readings(np.asarray(channel.time, float)[valid], value[valid])

    def at(self, time: np.ndarray) -> np.ndarray:
        """Return the readings interpolated at times [s], shape (T,)."""
        return np.interp(time, self.time, self.value)


def joint_readings(model: mujoco.MjModel, demonstration: Demonstration) -> dict[int, Readings]:
    """Return the readings of each joint that a sensor measures, by the joint's row."""
    return _readings(model, demonstration, SENSOR.mjSENS_JOINTPOS)


def configurations(
    model: mujoco.MjModel,
    demonstration: Demonstration,
    time: np.ndarray,
    joints: Mapping[int, np.ndarray] | None = None,
    *,
    commanded: bool = True,
) -> tuple[np.ndarray, list[str]]:
    """Return the generalised positions at times (T,) [s], shape (T, nq), and the joints that nothing tells about.

    Of a tendon's joints the shortest vector of the measured length is taken, where they are not measured themselves;
    joints coupled by an equality follow. All others, free joints among them, stay at the initial state.

    Args:
        model: The compiled scene.
        demonstration: What was measured and commanded.
        time: The times.
        joints: Positions of measured joints, shape (T,) each, by the joint's row; by default readings are interpolated.
        commanded: Whether a joint that nothing measures is where the command of its position actuator puts it.
    """
    start = model.qpos0 if demonstration.qpos is None else demonstration.qpos
    result = np.repeat(np.asarray(start, float)[None], len(time), axis=0)
    if joints is None:
        joints = {joint: readings.at(time) for joint, readings in joint_readings(model, demonstration).items()}
    for joint, value in joints.items():
        result[:, model.jnt_qposadr[joint]] = value
    known = set(joints)
    for tendon, readings in _readings(model, demonstration, SENSOR.mjSENS_TENDONPOS).items():
        known |= _follow_tendon(model, tendon, readings.at(time), result, known)
    known |= _follow_couplings(model, result, known)
    if commanded:
        known |= _follow_commands(model, demonstration, time, result, known)
    hinges = [j for j in range(model.njnt) if int(model.jnt_type[j]) >= int(mujoco.mjtJoint.mjJNT_SLIDE)]
    return result, [model.joint(j).name for j in hinges if j not in known]


def _readings(model: mujoco.MjModel, demonstration: Demonstration, kind: mujoco.mjtSensor) -> dict[int, Readings]:
    """Return the readings of sensors of a kind, by the row of what they measure."""
    found = {}
    for name, channel in demonstration.measured.items():
        sensor = model.sensor(name).id
        if model.sensor_type[sensor] == kind:
            found[int(model.sensor_objid[sensor])] = Readings.of(channel)
    return found


def _follow_tendon(
    model: mujoco.MjModel, tendon: int, length: np.ndarray, result: np.ndarray, known: set[int]
) -> set[int]:
    """Set the unknown joints of a fixed tendon of measured length (T,); return which they are."""
    rows = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    joints = {int(model.wrap_objid[k]): float(model.wrap_prm[k]) for k in rows if model.wrap_type[k] == 1}
    free = {joint: share for joint, share in joints.items() if joint not in known}
    total = sum(share**2 for share in free.values())
    if len(joints) < len(rows) or total == 0:
        return set()
    rest = length - sum(share * result[:, model.jnt_qposadr[j]] for j, share in joints.items() if j in known)
    for joint, share in free.items():
        result[:, model.jnt_qposadr[joint]] = rest * share / total
    return set(free)


def _follow_couplings(model: mujoco.MjModel, result: np.ndarray, known: set[int]) -> set[int]:
    """Set the unknown joints that an equality couples to a known one; return which they are."""
    found: set[int] = set()
    for row in range(model.neq):
        if model.eq_type[row] != mujoco.mjtEq.mjEQ_JOINT or model.eq_obj2id[row] < 0:
            continue
        follower, leader = int(model.eq_obj1id[row]), int(model.eq_obj2id[row])
        if leader in known | found and follower not in known | found:
            moved = result[:, model.jnt_qposadr[leader]] - model.qpos0[model.jnt_qposadr[leader]]
            offset = np.polynomial.polynomial.polyval(moved, model.eq_data[row, :5])
            result[:, model.jnt_qposadr[follower]] = model.qpos0[model.jnt_qposadr[follower]] + offset
            found.add(follower)
    return found


def _follow_commands(
    model: mujoco.MjModel, demonstration: Demonstration, time: np.ndarray, result: np.ndarray, known: set[int]
) -> set[int]:
    """Set the unknown joints of position actuators to the last command; return which they are."""
    found: set[int] = set()
    for row in range(model.nu):
        name, joint = model.actuator(row).name, int(model.actuator_trnid[row, 0])
        servo = model.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_AFFINE and model.actuator_biasprm[row, 1] != 0
        on_joint = model.actuator_trntype[row] == TRANSMISSION.mjTRN_JOINT
        if on_joint and servo and joint not in known | found and name in demonstration.action:
            channel = demonstration.action[name]
            held = np.clip(np.searchsorted(channel.time, time, side="right") - 1, 0, None)
            result[:, model.jnt_qposadr[joint]] = channel.value[held]
            found.add(joint)
    return found
