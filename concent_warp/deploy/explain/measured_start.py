"""Where a trial began and how the robot moved, by its own measurements.

Readings of joints are interpolated; the pose of a grasped object is the mean of its tracked poses relative to the hand,
which averages the tracker's noise but not its bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.recording.recording import Demonstration
from concent_warp.simulate.replay import interpolate

JOINT, TENDON = int(mujoco.mjtSensor.mjSENS_JOINTPOS), int(mujoco.mjtSensor.mjSENS_TENDONPOS)
POSITION, ORIENTATION = int(mujoco.mjtSensor.mjSENS_FRAMEPOS), int(mujoco.mjtSensor.mjSENS_FRAMEQUAT)
SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True)
class TrackedPose:
    """Tracked poses of one object."""

    time: np.ndarray
    """Times of the frames [s], shape (T,)."""
    position: np.ndarray
    """World frame [m], shape (T, 3)."""
    rotation: Rotation
    """T orientations."""

    def mean(self) -> tuple[np.ndarray, Rotation]:
        """Return the mean pose."""
        return np.median(self.position, axis=0), self.rotation.mean()


def joint_positions(m: mujoco.MjModel, demonstration: Demonstration, time: np.ndarray) -> np.ndarray:
    """Return the measured positions of all hinges and slides at times (T,) [s], shape (T, nq).

    A joint without a sensor has the length of the fixed tendon that it belongs to, over the sum of its coefficients;
    what nothing measures has the model's reference position.

    Raises:
        RecordingError: No joint was measured.
    """
    qpos = np.tile(m.qpos0, (len(time), 1))
    measured = set()
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row < 0 or int(m.sensor_type[row]) not in (JOINT, TENDON):
            continue
        valid = np.isfinite(channel.value[:, 0])
        value = interpolate(channel.time[valid], channel.value[valid], time)[:, 0]
        target = int(m.sensor_objid[row])
        if int(m.sensor_type[row]) == JOINT:
            qpos[:, m.jnt_qposadr[target]] = value
            measured.add(target)
            continue
        first, count = int(m.tendon_adr[target]), int(m.tendon_num[target])
        total = float(m.wrap_prm[first : first + count].sum())
        for joint in m.wrap_objid[first : first + count].tolist():
            if joint not in measured and total:
                qpos[:, m.jnt_qposadr[joint]] = value / total
    if not measured:
        raise RecordingError("no joint was measured", where=demonstration.name, expected="sensors of joint positions")
    return qpos


def tracked_pose(m: mujoco.MjModel, demonstration: Demonstration, body: int) -> TrackedPose | None:
    """Return the tracked poses of a body; None where it was not tracked with position and orientation."""
    found = {}
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        framed = row >= 0 and int(m.sensor_objtype[row]) in (mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_BODY)
        if framed and int(m.sensor_objid[row]) == body:
            found[int(m.sensor_type[row])] = channel
    if POSITION not in found or ORIENTATION not in found:
        return None
    place, turn = found[POSITION], found[ORIENTATION]
    seen = np.isfinite(place.value).all(axis=1)
    known = np.isfinite(turn.value).all(axis=1)
    time = place.time[seen]
    nearest = np.abs(time[:, None] - turn.time[known][None]).argmin(axis=1) if len(time) else np.zeros(0, int)
    if not len(nearest):
        return None
    return TrackedPose(time, place.value[seen], Rotation.from_quat(turn.value[known][nearest], scalar_first=True))


class HandFrame:
    """The frame of the hand along a trial, by the readings of the joints."""

    def __init__(self, m: mujoco.MjModel, site: int, demonstration: Demonstration) -> None:
        """Prepare the kinematics of the scene; `site` is between the fingertips."""
        self._m, self._data, self._site, self._demonstration = m, mujoco.MjData(m), site, demonstration

    def at(self, time: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """Return positions [m], shape (T, 3), and T orientations of the tool at times (T,) [s]."""
        place, turn = np.zeros((len(time), 3)), np.zeros((len(time), 3, 3))
        for row, qpos in enumerate(joint_positions(self._m, self._demonstration, time)):
            self._data.qpos[:] = qpos
            mujoco.mj_kinematics(self._m, self._data)
            place[row] = self._data.site_xpos[self._site]
            turn[row] = self._data.site_xmat[self._site].reshape(3, 3)
        return place, Rotation.from_matrix(turn)

    def relative(self, pose: TrackedPose) -> TrackedPose:
        """Return tracked poses of an object in the frame of the tool."""
        place, turn = self.at(pose.time)
        back = turn.inv()
        return TrackedPose(pose.time, back.apply(pose.position - place), back * pose.rotation)


@dataclass(frozen=True)
class MeasuredStart:
    """State at the beginning of a trial."""

    qpos: np.ndarray
    """Positions, shape (nq,)."""
    ctrl: np.ndarray
    """First commands, shape (nu,)."""
    fixtures: dict[str, np.ndarray]
    """Mean tracked poses of objects fixed to the world, position [m] and quaternion, shape (7,) each."""
    grasped: tuple[np.ndarray, Rotation] | None
    """Mean pose of the grasped object in the frame of the tool; None where none is grasped."""
    still: float
    """Time over which it was averaged [s]."""


def measured_start(
    m: mujoco.MjModel, demonstration: Demonstration, objects: tuple[int, ...], site: int, *, grasped: bool, span: float
) -> MeasuredStart:
    """Return the state at the beginning of a trial.

    Args:
        m: Compiled scene; its objects may be free or fixed.
        demonstration: The trial.
        objects: Bodies of the task; the first one is manipulated.
        site: Site between the fingertips.
        grasped: Whether the trial begins with object 1 in the hand.
        span: First part of the trial over which poses are averaged [s].

    Raises:
        RecordingError: Joints or the manipulated object were not measured, or an actuator has no commands.
    """
    qpos = joint_positions(m, demonstration, np.zeros(1))[0]
    names = [m.actuator(i).name for i in range(m.nu)]
    if missing := [name for name in names if name not in demonstration.action]:
        raise RecordingError("actuators without commands", where=demonstration.name, found=missing)
    ctrl = np.array([float(demonstration.action[name].value[0]) for name in names])
    hand, fixtures, held = HandFrame(m, site, demonstration), {}, None
    for k, body in enumerate(objects):
        pose = tracked_pose(m, demonstration, body)
        joint = int(m.body_jntadr[body])
        free = joint >= 0 and int(m.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_FREE
        if pose is None:
            if k == 0:
                raise RecordingError(
                    "the manipulated object was not tracked",
                    where=demonstration.name,
                    expected=f"sensors of position and orientation of {m.body(body).name}",
                    found=sorted(demonstration.measured),
                )
            continue
        early = _first(pose, span)
        if k == 0 and grasped:
            held = hand.relative(early).mean()
            place, turn = hand.at(np.zeros(1))
            mean = place[0] + turn[0].apply(held[0]), turn[0] * held[1]
        else:
            mean = (pose if not free else early).mean()
        flat = np.concatenate([mean[0], mean[1].as_quat(scalar_first=True)])
        if free:
            address = int(m.jnt_qposadr[joint])
            qpos[address : address + 7] = flat
        else:
            fixtures[m.body(body).name] = flat
    return MeasuredStart(qpos, ctrl, fixtures, held, span)


def _first(pose: TrackedPose, span: float) -> TrackedPose:
    """Return the poses of the first part of a track; at least its first three."""
    count = max(3, int((pose.time <= pose.time[0] + span).sum()))
    return TrackedPose(pose.time[:count], pose.position[:count], pose.rotation[:count])
