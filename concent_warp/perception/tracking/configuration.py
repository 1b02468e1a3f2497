"""The robot's configuration at the times of a video, from its joint sensors."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.recording.recording import Channel, Demonstration

SENSOR, TRANSMISSION = mujoco.mjtSensor, mujoco.mjtTrn


def configurations(
    model: mujoco.MjModel, demonstration: Demonstration, time: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Return the generalised positions at times (T,) [s], shape (T, nq), and the joints that nothing tells about.

    Measured joints are interpolated. Of a tendon's joints the shortest vector of the measured length is taken, where
    they are not measured themselves; joints coupled by an equality follow; others are where the command of a position
    actuator puts them. Free joints stay at the initial state, which the tracker overwrites.
    """
    start = model.qpos0 if demonstration.qpos is None else demonstration.qpos
    result = np.repeat(np.asarray(start, float)[None], len(time), axis=0)
    known: set[int] = set()
    for name, channel in demonstration.measured.items():
        sensor = model.sensor(name).id
        if model.sensor_type[sensor] == SENSOR.mjSENS_JOINTPOS:
            joint = int(model.sensor_objid[sensor])
            result[:, model.jnt_qposadr[joint]] = _at(channel, time)
            known.add(joint)
    for name, channel in demonstration.measured.items():
        sensor = model.sensor(name).id
        if model.sensor_type[sensor] == SENSOR.mjSENS_TENDONPOS:
            known |= _follow_tendon(model, int(model.sensor_objid[sensor]), _at(channel, time), result, known)
    for row in range(model.neq):
        if model.eq_type[row] != mujoco.mjtEq.mjEQ_JOINT or model.eq_obj2id[row] < 0:
            continue
        follower, leader = int(model.eq_obj1id[row]), int(model.eq_obj2id[row])
        if leader in known and follower not in known:
            moved = result[:, model.jnt_qposadr[leader]] - model.qpos0[model.jnt_qposadr[leader]]
            offset = np.polynomial.polynomial.polyval(moved, model.eq_data[row, :5])
            result[:, model.jnt_qposadr[follower]] = model.qpos0[model.jnt_qposadr[follower]] + offset
            known.add(follower)
    for row in range(model.nu):
        name, joint = model.actuator(row).name, int(model.actuator_trnid[row, 0])
        servo = model.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_AFFINE and model.actuator_biasprm[row, 1] != 0
        on_joint = model.actuator_trntype[row] == TRANSMISSION.mjTRN_JOINT
        if on_joint and servo and joint not in known and name in demonstration.action:
            channel = demonstration.action[name]
            held = np.clip(np.searchsorted(channel.time, time, side="right") - 1, 0, None)
            result[:, model.jnt_qposadr[joint]] = channel.value[held]
            known.add(joint)
    hinges = [j for j in range(model.njnt) if int(model.jnt_type[j]) >= int(mujoco.mjtJoint.mjJNT_SLIDE)]
    return result, [model.joint(j).name for j in hinges if j not in known]


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


def _at(channel: Channel, time: np.ndarray) -> np.ndarray:
    """Return a channel's first component at times (T,) [s], interpolated between valid samples."""
    value = np.asarray(channel.value, float).reshape(len(channel.time), -1)[:, 0]
    valid = np.isfinite(value)
    return np.interp(time, np.asarray(channel.time)[valid], value[valid])
