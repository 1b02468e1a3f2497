"""The pose of an object on passive joints that were measured: a drawer, a door, a part that slides and turns."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.effects.select import driven_joints
from concent_warp.estimation.marked_joints import joints_below
from concent_warp.recording.recording import Demonstration

SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def jointed_pose(
    m: mujoco.MjModel, demonstration: Demonstration, body: str
) -> tuple[np.ndarray, np.ndarray, Rotation] | None:
    """Return times [s], positions [m] (T, 3) and rotations of a body's frame, from the sensors of its joints.

    Times are those of the joint with most samples, as far as all were measured; the others are interpolated.

    Args:
        m: The compiled scene.
        demonstration: What was measured.
        body: Name of the body.

    Returns:
        None where a joint between the world and the body was not measured, is driven by an actuator, or is no hinge or
        slide, where they were measured at different times, and for a body without joints.
    """
    joints = joints_below(m, m.body(body).id)
    driven = {joint for i in range(m.nu) for joint in driven_joints(m, i)}
    if not joints or driven & set(joints) or any(int(m.jnt_type[j]) not in SCALAR for j in joints):
        return None
    readings: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for name, channel in demonstration.measured.items():
        sensor = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        known = np.isfinite(channel.value[:, 0])
        if sensor >= 0 and m.sensor_type[sensor] == mujoco.mjtSensor.mjSENS_JOINTPOS and known.any():
            readings[int(m.sensor_objid[sensor])] = channel.time[known], channel.value[known, 0]
    if not set(joints) <= readings.keys():
        return None
    times = [readings[j][0] for j in joints]
    time = max(times, key=len)
    time = time[(time >= max(one[0] for one in times)) & (time <= min(one[-1] for one in times))]
    if not len(time):
        return None
    data = mujoco.MjData(m)
    position, quaternion = np.zeros((len(time), 3)), np.zeros((len(time), 4))
    values = {int(m.jnt_qposadr[j]): np.interp(time, *readings[j]) for j in joints}
    for k in range(len(time)):
        for address, value in values.items():
            data.qpos[address] = value[k]
        mujoco.mj_kinematics(m, data)
        position[k], quaternion[k] = data.body(body).xpos, data.body(body).xquat
    return time, position, Rotation.from_quat(quaternion, scalar_first=True)
