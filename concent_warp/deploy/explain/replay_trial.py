"""Open-loop replays of a trial: its commands in the model from its measured start, against what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.deploy.explain.measured_start import JOINT, MeasuredStart, TrackedPose, tracked_pose
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import commands, interpolate
from concent_warp.train.task.task import Task

ENCODER_STD, POSITION_STD, ORIENTATION_STD = 2e-4, 1e-3, 0.0175


@dataclass(frozen=True)
class TrialReadings:
    """What was measured in a trial: joints and the manipulated object."""

    time: np.ndarray
    """Times of joint readings [s], shape (T,)."""
    joints: np.ndarray
    """Readings of the arm's joints [rad or m], shape (T, J)."""
    joint_std: np.ndarray
    """Standard deviations of their noise, shape (J,)."""
    pose: TrackedPose
    """Tracked poses of the manipulated object."""
    pose_std: tuple[float, float]
    """Standard deviations of its positions [m] and orientations [rad]."""

    @property
    def end(self) -> float:
        """Time of the last reading [s]."""
        return float(max(self.time[-1], self.pose.time[-1]))


@dataclass(frozen=True)
class ReplayedTrials:
    """N replays of one trial at the times of its readings."""

    joints: np.ndarray
    """Shape (N, T, J)."""
    position: np.ndarray
    """Of the manipulated object [m], shape (N, F, 3)."""
    quaternion: np.ndarray
    """Shape (N, F, 4)."""
    diverged: np.ndarray
    """Shape (N,) bool."""


def trial_readings(m: mujoco.MjModel, task: Task, demonstration: Demonstration) -> TrialReadings:
    """Return the readings of a trial that was checked by `measured_start`."""
    channels = {}
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row >= 0 and int(m.sensor_type[row]) == JOINT and int(m.sensor_objid[row]) in task.robot.joint:
            channels[int(m.sensor_objid[row])] = channel
    order = [int(j) for j in task.robot.joint if int(j) in channels]
    time = channels[order[0]].time
    joints = np.stack([interpolate(channels[j].time, channels[j].value, time)[:, 0] for j in order], axis=1)
    std = np.array([channels[j].noise_std or ENCODER_STD for j in order])
    pose = tracked_pose(m, demonstration, task.objects[0])
    assert pose is not None
    return TrialReadings(time, joints, std, pose, _pose_noise(m, demonstration, task.objects[0]))


def _pose_noise(m: mujoco.MjModel, demonstration: Demonstration, body: int) -> tuple[float, float]:
    """Return the stated noise of a body's tracked positions [m] and orientations [rad], else a usual tracker's."""
    found = [POSITION_STD, ORIENTATION_STD]
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row >= 0 and int(m.sensor_objtype[row]) == mujoco.mjtObj.mjOBJ_XBODY and m.sensor_objid[row] == body:
            found[int(channel.value.shape[1] == 4)] = channel.noise_std or found[int(channel.value.shape[1] == 4)]
    return found[0], found[1]


class Replayer:
    """Replays trials in the model of a task, or in one with other effects."""

    def __init__(self, task: Task, model: Model | None = None) -> None:
        """Compile the model; `model` replaces the effects of the task's."""
        chosen = task.model if model is None else model_with_effects(task.model, model)
        self._model, self._task = chosen, task
        self._engine = MujocoEngine(chosen, collidable=task.collidable)
        self._joints = [int(j) for j in task.robot.joint]

    def run(
        self, demonstration: Demonstration, readings: TrialReadings, start: MeasuredStart, poses: np.ndarray
    ) -> ReplayedTrials:
        """Return replays from several poses of the manipulated object.

        Args:
            demonstration: The trial.
            readings: Its readings.
            start: Its start.
            poses: Initial poses of the object, shape (N, 7).
        """
        m, engine, count = self._task.compiled, self._engine, len(poses)
        dt = engine.timestep
        steps = max(1, int(np.ceil(readings.end / dt - 1e-9)))
        ctrl = commands(m, demonstration, steps)
        for added in self._model.effects:
            ctrl = added.effect.command(m, ctrl, added.array)
        qpos = np.tile(start.qpos, (count, 1))
        address = int(m.jnt_qposadr[m.body_jntadr[self._task.objects[0]]])
        qpos[:, address : address + 7] = poses
        fields = fixture_fields(m, start, count)
        body = m.body(self._task.objects[0]).name
        found = engine.run(
            Variants(count, qpos=qpos, qvel=np.zeros((count, m.nv)), fields=fields), ctrl, bodies=(body,)
        ).numpy()
        qposadr = m.jnt_qposadr[self._joints]
        joints = np.stack([interpolate(found.time, q[:, qposadr], readings.time) for q in found.qpos])
        place = np.stack([interpolate(found.time, p[:, 0], readings.pose.time) for p in found.body_position])
        turn = found.body_quaternion[:, np.round(readings.pose.time / dt).astype(int).clip(0, len(found.time) - 1), 0]
        return ReplayedTrials(joints, place, turn, found.diverged)


def fixture_fields(m: mujoco.MjModel, start: MeasuredStart, count: int) -> dict[str, np.ndarray]:
    """Return the fields of N variants of a model whose fixed objects stand where a start has them."""
    if not start.fixtures:
        return {}
    place, turn = m.body_pos.copy(), m.body_quat.copy()
    for name, pose in start.fixtures.items():
        place[m.body(name).id], turn[m.body(name).id] = pose[:3], pose[3:]
    return {"body_pos": np.tile(place, (count, 1, 1)), "body_quat": np.tile(turn, (count, 1, 1))}


def model_with_effects(model: Model, other: Model) -> Model:
    """Return a model with the effects of another one in place of its own."""
    from dataclasses import replace

    return replace(model, effects=other.effects)


def joint_ratio(readings: TrialReadings, replayed: ReplayedTrials) -> np.ndarray:
    """Return joint errors over their noise, shape (N, T, J); NaN where a replay diverged."""
    return (readings.joints - replayed.joints) / readings.joint_std


def pose_ratio(readings: TrialReadings, replayed: ReplayedTrials) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of the object's poses over their noise: position (N, F, 3), orientation (N, F, 3)."""
    place = (readings.pose.position - replayed.position) / readings.pose_std[0]
    turn = np.empty_like(place)
    for k, quaternion in enumerate(replayed.quaternion):
        sane = np.isfinite(quaternion).all(axis=1) & (np.abs(quaternion).sum(axis=1) > 0)
        turn[k] = np.nan
        if sane.any():
            error = readings.pose.rotation[sane] * Rotation.from_quat(quaternion[sane], scalar_first=True).inv()
            turn[k, sane] = error.as_rotvec() / readings.pose_std[1]
    return place, turn
