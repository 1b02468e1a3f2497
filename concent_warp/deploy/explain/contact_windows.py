"""Short simulations from measured states of a trial: how well they foresee the next readings under a pose error.

A replay of a whole trial says little once contacts have gone another way. A window of a few tenths of a second that
starts from the readings themselves is still near them at its end, unless the object is not where the tracker shows it:
then it touches what the robot did not feel, or does not touch what held the robot up. In contact a servo's error is a
force, so the joints show within a window's length whether the model has the same contacts.

The scene's own shapes are simulated where they collide: a contact geometry fitted to one demonstration has nothing
where that demonstration touched nothing, and failed trials touch other places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.deploy.explain.cfg import ContactStartCfg, WindowsCfg
from concent_warp.deploy.explain.grasp_fit import GraspFit
from concent_warp.deploy.explain.measured_start import SINGLE, HandFrame, MeasuredStart, joint_positions
from concent_warp.deploy.explain.replay_trial import TrialReadings, fixture_fields
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import commands
from concent_warp.train.task.task import Task


@dataclass(frozen=True)
class TrialWindows:
    """K windows of one trial."""

    qpos: np.ndarray
    """Measured positions at their beginnings, of the object as tracked, shape (K, nq)."""
    qvel: np.ndarray
    """Velocities, shape (K, nv)."""
    ctrl: np.ndarray
    """Commands, shape (K, steps, nu)."""
    joints: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Times in each window [s] and readings (T, J) of the arm's joints then."""
    poses: tuple[tuple[np.ndarray, np.ndarray, Rotation], ...]
    """Times in each window [s], tracked positions (F, 3) and orientations of the object then."""
    joint_std: np.ndarray
    """Noise of the joint readings, shape (J,)."""
    pose_std: tuple[float, float]
    """Noise of tracked positions [m] and orientations [rad]."""
    start: MeasuredStart
    """Start of the trial, whose fixtures stand where they do in all windows."""

    def __len__(self) -> int:
        return len(self.qpos)

    def some(self, rows: Sequence[int]) -> TrialWindows:
        """Return some of the windows."""
        rows = list(rows)
        return replace(
            self, qpos=self.qpos[rows], qvel=self.qvel[rows], ctrl=self.ctrl[rows],
            joints=tuple(self.joints[k] for k in rows), poses=tuple(self.poses[k] for k in rows),
        )  # fmt: skip


class WindowSimulation:
    """Simulates windows of trials of a task under errors of the tracked poses."""

    def __init__(self, model: Model, task: Task, cfg: WindowsCfg, start: ContactStartCfg) -> None:
        """Compile the model.

        Args:
            model: The task's model, with fixed objects fixed.
            task: The task.
            cfg: Settings.
            start: How an object fits between the fingers.
        """
        if _collides(model, task):
            model = model.with_geometry(None)
        self._task, self._cfg, self._model = task, cfg, model
        self._engine = MujocoEngine(model, collidable=None if model.geometry is None else task.collidable)
        m = self._engine.compiled
        self._body = task.objects[0]
        self._grasp = GraspFit(m, self._body, start)
        joint = int(m.body_jntadr[self._body])
        self._address, self._dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
        self._arm = m.jnt_qposadr[[int(j) for j in task.robot.joint]]

    def windows(self, demonstration: Demonstration, readings: TrialReadings, start: MeasuredStart) -> TrialWindows:
        """Return the windows of a trial, as many as are allowed, evenly distributed over it."""
        cfg, m, dt = self._cfg, self._engine.compiled, self._engine.timestep
        steps = max(1, round(cfg.length / dt))
        last = min(readings.time[-1], readings.pose.time[-1]) - steps * dt
        count = int(np.clip(last / cfg.spacing + 1, 1, cfg.most))
        times = np.round(np.linspace(0.0, max(last, 0.0), count) / dt) * dt
        qpos, qvel = self._states(demonstration, readings, start, times)
        ctrl = commands(m, demonstration, int(np.ceil(readings.end / dt)) + steps)
        for added in self._model.effects:
            ctrl = added.effect.command(m, ctrl, added.array)
        first = np.round(times / dt).astype(int)
        joints, poses = [], []
        for begin in times:
            mine = (readings.time > begin + cfg.settling) & (readings.time <= begin + steps * dt + 1e-9)
            joints.append((readings.time[mine] - begin, readings.joints[mine]))
            mine = (readings.pose.time > begin) & (readings.pose.time <= begin + steps * dt + 1e-9)
            poses.append((readings.pose.time[mine] - begin, readings.pose.position[mine], readings.pose.rotation[mine]))
        parts = np.stack([ctrl[k : k + steps] for k in first])
        return TrialWindows(
            qpos, qvel, parts, tuple(joints), tuple(poses), readings.joint_std, readings.pose_std, start
        )

    def losses(self, windows: TrialWindows, bias: np.ndarray) -> np.ndarray:
        """Return the loss of each window under errors of the tracked poses.

        A loss is the mean over joints, position and orientation of log(1 + r^2), r the error over its tolerance.

        Args:
            windows: K windows of one trial.
            bias: Position [m] and rotation vector, tracked less true, shape (N, 6).

        Returns:
            Losses, shape (N, K).
        """
        cfg, dt = self._cfg, self._engine.timestep
        count, number = len(bias), len(windows)
        place = slice(self._address, self._address + 7)
        qpos = np.tile(windows.qpos, (count, 1))
        each = np.repeat(bias, number, axis=0)
        turn = Rotation.from_rotvec(-each[:, 3:]) * Rotation.from_quat(qpos[:, place][:, 3:], scalar_first=True)
        qpos[:, place] = np.hstack([qpos[:, place][:, :3] - each[:, :3], turn.as_quat(scalar_first=True)])
        qpos = np.stack([self._grasp(row) for row in qpos])
        found = self._engine.run(
            Variants(
                count * number, qpos=qpos, qvel=np.tile(windows.qvel, (count, 1)),
                fields=fixture_fields(self._engine.compiled, windows.start, count * number),
            ),
            windows.ctrl,
            bodies=(),
        ).numpy()  # fmt: skip
        states = found.qpos.reshape(count, number, len(found.time), -1)
        failed = found.diverged.reshape(count, number)
        losses = np.zeros((count, number))
        for k in range(number):
            time, joints = windows.joints[k]
            predicted = _at(states[:, k][..., self._arm], time, dt)
            ratio = (predicted - joints) / windows.joint_std / cfg.joints
            squares = [np.nanmean(ratio**2, axis=(1, 2)) if len(time) else np.zeros(count)]
            time, position, rotation = windows.poses[k]
            if len(time):
                pose = _at(states[:, k][..., place], time, dt)
                error = (position - pose[..., :3]).mean(axis=1) - bias[:, :3]
                turn = _mean_turn(rotation, pose[..., 3:], bias[:, 3:])
                squares += [(error**2).sum(axis=1) / cfg.position**2, (turn**2).sum(axis=1) / cfg.orientation**2]
            losses[:, k] = np.mean([np.log1p(s) for s in squares], axis=0)
        return np.where(failed | ~np.isfinite(losses), cfg.diverged, losses)

    def _states(
        self, demonstration: Demonstration, readings: TrialReadings, start: MeasuredStart, times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the measured positions (K, nq) and velocities (K, nv) at some times."""
        m, cfg = self._engine.compiled, self._cfg
        data = mujoco.MjData(m)
        single = [j for j in range(m.njnt) if int(m.jnt_type[j]) in SINGLE]
        address, dof = m.jnt_qposadr[single], m.jnt_dofadr[single]
        frames = readings.pose
        qpos, qvel = np.tile(start.qpos, (len(times), 1)), np.zeros((len(times), m.nv))
        read = joint_positions(m, demonstration, readings.time)[:, address]
        hands = HandFrame(m, self._task.robot.tool, demonstration).at(frames.time)
        place = slice(self._address, self._address + 7)
        for k, time in enumerate(times):
            qpos[k, address], qvel[k, dof] = _local_line(readings.time, read, time, cfg.smoothing)
            away = np.abs(frames.time - time)
            near = away <= max(cfg.smoothing, float(np.sort(away)[:3][-1]))
            data.qpos[:], data.qvel[:] = qpos[k], qvel[k]
            mujoco.mj_kinematics(m, data)
            mujoco.mj_comPos(m, data)
            mujoco.mj_comVel(m, data)
            hand = data.site_xpos[self._task.robot.tool].copy()
            turn = Rotation.from_matrix(data.site_xmat[self._task.robot.tool].reshape(3, 3))
            back = hands[1][near].inv()
            held = back.apply(frames.position[near] - hands[0][near])
            if held.var(axis=0).sum() <= frames.position[near].var(axis=0).sum() or start.grasped is not None:
                position = hand + turn.apply(held.mean(axis=0))
                rotation = turn * (back * frames.rotation[near]).mean()
                velocity = np.zeros(6)
                mujoco.mj_objectVelocity(m, data, mujoco.mjtObj.mjOBJ_SITE, self._task.robot.tool, velocity, 0)
                qvel[k, self._dof : self._dof + 3] = velocity[3:] + np.cross(velocity[:3], position - hand)
                qvel[k, self._dof + 3 : self._dof + 6] = rotation.inv().apply(velocity[:3])
            else:
                position, rotation = frames.position[near].mean(axis=0), frames.rotation[near].mean()
            qpos[k, place] = np.concatenate([position, rotation.as_quat(scalar_first=True)])
        return qpos, qvel


def _collides(model: Model, task: Task) -> bool:
    """Return whether the scene's own shapes of all objects of the task collide."""
    m = model.scene.model
    collides = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
    names = [task.compiled.body(body).name for body in task.objects]
    return all(bool((collides & (m.geom_bodyid == m.body(name).id)).any()) for name in names)


def _local_line(time: np.ndarray, value: np.ndarray, at: float, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return value and slope at a time of a parabola through the readings (T, J) within a width on either side."""
    near = np.abs(time - at) <= width + 1e-9
    if near.sum() < 4:
        near = np.sort(np.argsort(np.abs(time - at))[:4])
    found = np.polynomial.polynomial.polyfit(time[near] - at, value[near], 2)
    return found[0], found[1]


def _at(values: np.ndarray, time: np.ndarray, dt: float) -> np.ndarray:
    """Return records (N, R, D) of each step at times (T,) [s], linearly interpolated, shape (N, T, D)."""
    step = np.clip(time / dt, 0, values.shape[1] - 1)
    low = np.minimum(step.astype(int), values.shape[1] - 2) if values.shape[1] > 1 else step.astype(int)
    share = (step - low)[None, :, None]
    return values[:, low] * (1 - share) + values[:, np.minimum(low + 1, values.shape[1] - 1)] * share


def _mean_turn(rotation: Rotation, quaternion: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Return the mean rotation vectors from predicted orientations, as the tracker shows them, to F tracked ones.

    Args:
        rotation: The tracked ones.
        quaternion: The predicted ones, shape (N, F, 4).
        bias: Errors of the tracker, rotation vectors (N, 3).
    """
    count, frames = quaternion.shape[:2]
    flat = quaternion.reshape(-1, 4)
    sane = np.isfinite(flat).all(axis=1) & (np.abs(flat).sum(axis=1) > 0)
    flat = np.where(sane[:, None], flat, (1.0, 0.0, 0.0, 0.0))
    shown = Rotation.from_rotvec(np.repeat(bias, frames, axis=0)) * Rotation.from_quat(flat, scalar_first=True)
    tracked = Rotation.from_quat(np.tile(rotation.as_quat(), (count, 1)))
    error = np.where(sane[:, None], (tracked * shown.inv()).as_rotvec(), np.nan)
    return error.reshape(count, frames, 3).mean(axis=1)
