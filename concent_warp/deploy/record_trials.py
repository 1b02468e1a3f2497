"""Trials of a policy as a recording: what it commanded, and what its instruments showed it, each at its own time.

Nothing that a robot would not have is recorded: joint readings come from the encoders, poses of objects are the single
frames of the tracker at the times at which they were taken. What the policy observed and did is kept beside them, so
that it can be asked again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
import torch
from tensordict import TensorDict

from concent_warp.recording.recording import Channel, Demonstration, PolicyLog, Recording
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.state_estimate import Pose
from concent_warp.train.observation_cfg import SensorErrorsCfg
from concent_warp.train.run import TrainingRun
from concent_warp.train.trials.episodes import PolicyFunction
from concent_warp.train.trials.evaluate import Evaluation

POSES = (int(mujoco.mjtSensor.mjSENS_FRAMEPOS), int(mujoco.mjtSensor.mjSENS_FRAMEQUAT))
JOINTS = (int(mujoco.mjtSensor.mjSENS_JOINTPOS), int(mujoco.mjtSensor.mjSENS_TENDONPOS))


@dataclass(frozen=True)
class RecordedTrial:
    """Readings of one episode; one entry for each control step, or for each frame of the tracker."""

    qpos: list[np.ndarray] = field(default_factory=list)
    """Positions as read by the encoders, shape (nq,); those of free bodies are the policy's estimates."""
    ctrl: list[np.ndarray] = field(default_factory=list)
    """Commands of each step but the last, shape (nu,)."""
    observation: list[np.ndarray] = field(default_factory=list)
    action: list[np.ndarray] = field(default_factory=list)
    frames: list[list[float]] = field(default_factory=list)
    """Times of the frames that show each object [s]."""
    poses: list[list[np.ndarray]] = field(default_factory=list)
    """Poses in them, position [m] and quaternion, shape (7,)."""


class TrialRecorder:
    """Records the episodes of `run_episodes`: a `watch` of it, whose policy is that of `acting`."""

    def __init__(self, run: TrainingRun, environment: Environment, sensors: SensorErrorsCfg) -> None:
        """Prepare to record.

        Args:
            run: Inputs of the policy's training.
            environment: The worlds, on the CPU.
            sensors: Errors of their instruments.
        """
        self._run, self._environment, self._sensors = run, environment, sensors
        self._objects = [environment.task.compiled.body(i).name for i in environment.task.objects]
        self._pending: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._asked: tuple[np.ndarray, np.ndarray] | None = None
        self.trials: dict[int, RecordedTrial] = {}
        """Trials by the number of the episode."""
        if environment.estimate is not None:
            environment.estimate.watch = self._see

    def acting(self, policy: PolicyFunction) -> PolicyFunction:
        """Return a policy that acts as the given one; what it observes and does is recorded."""

        def act(observation: TensorDict) -> torch.Tensor:
            action = policy(observation)
            self._asked = observation["policy"].cpu().numpy().copy(), action.clamp(-1, 1).cpu().numpy().copy()
            return action

        return act

    def __call__(self, episodes: np.ndarray, qpos: np.ndarray) -> None:
        """Record the present readings of the running episodes (R,), whose true positions are (R, nq)."""
        environment = self._environment
        worlds = episodes % environment.num_envs
        shown = qpos if environment.estimate is None else environment.estimate.qpos.cpu().numpy()[worlds]
        ctrl = environment.physics.ctrl.cpu().numpy()[worlds]
        for row, (episode, world) in enumerate(zip(episodes.tolist(), worlds.tolist(), strict=True)):
            begins = episode not in self.trials
            count = len(self._objects)
            trial = self.trials.setdefault(
                episode, RecordedTrial(frames=[[] for _ in range(count)], poses=[[] for _ in range(count)])
            )
            if not begins:
                self._keep(trial, world, ctrl[row])
            trial.qpos.append(shown[row].astype(float))
            if environment.estimate is None:
                self._see_exactly(trial, world)
        self._pending.clear()

    def _keep(self, trial: RecordedTrial, world: int, ctrl: np.ndarray) -> None:
        """Add to a trial what the last step has commanded and shown."""
        trial.ctrl.append(ctrl.astype(float))
        if self._asked is not None:
            trial.observation.append(self._asked[0][world])
            trial.action.append(self._asked[1][world])
        for time, found, poses in self._pending:
            for i in np.flatnonzero(found[world]):
                if time[world] >= 0:
                    trial.frames[i].append(float(time[world]))
                    trial.poses[i].append(poses[world, i])

    def _see(self, time: torch.Tensor, found: torch.Tensor, poses: Pose) -> None:
        """Keep a frame of the tracker until the episodes that it belongs to are known; see `FrameWatch`."""
        both = torch.cat(poses, dim=-1)
        self._pending.append((time.numpy().copy(), found.numpy().copy(), both.double().numpy().copy()))

    def _see_exactly(self, trial: RecordedTrial, world: int) -> None:
        """Record the true poses at a control step, where the policy observes the exact state."""
        physics = self._environment.physics
        for i, body in enumerate(self._environment.task.objects):
            pose = torch.cat([physics.position[world, body], physics.quaternion[world, body]])
            trial.frames[i].append((len(trial.qpos) - 1) * self._environment.control_step)
            trial.poses[i].append(pose.double().cpu().numpy())

    def recording(self, outcome: Evaluation, episodes: Sequence[int]) -> Recording:
        """Return the recording of some episodes, ``demo_<number>`` each."""
        scene = self._run.model.scene
        task = self._run.recording[0].task
        demonstrations = [
            self._demonstration(scene.model, self.trials[k], f"demo_{k}", task, bool(outcome.success[k]))
            for k in episodes
        ]
        return Recording(scene.xml, tuple(demonstrations), source="trials")

    def _demonstration(
        self, m: mujoco.MjModel, trial: RecordedTrial, name: str, task: str, success: bool
    ) -> Demonstration:
        """Return one trial; the first command stands also for the time before it."""
        dt = self._environment.control_step
        commanded = np.array(trial.ctrl or [self._environment.physics.ctrl[0].cpu().numpy()])
        steps = dt * np.arange(len(commanded))
        action = {m.actuator(i).name: Channel(steps, commanded[:, i]) for i in range(m.nu)}
        log = None
        if trial.observation:
            log = PolicyLog(steps[: len(trial.observation)], np.array(trial.observation), np.array(trial.action))
        return Demonstration(name, task, success, action=action, measured=self._measured(m, trial), policy=log)

    def _measured(self, m: mujoco.MjModel, trial: RecordedTrial) -> dict[str, Channel]:
        """Return the channels of the scene's sensors that the instruments read."""
        errors, found = self._sensors, {}
        exact = self._environment.estimate is None
        encoder = None if exact else math.hypot(errors.encoder_std, errors.encoder_step / math.sqrt(12))
        steps = self._environment.control_step * np.arange(len(trial.qpos))
        readings = _readings(m, trial.qpos)
        for row in range(m.nsensor):
            name, kind = m.sensor(row).name, int(m.sensor_type[row])
            if kind in JOINTS:
                address = int(m.sensor_adr[row])
                weight = 1.0 if kind == JOINTS[0] else _tendon_noise(m, int(m.sensor_objid[row]))
                std = None if encoder is None else encoder * weight
                found[name] = Channel(steps, readings[:, address : address + 1], noise_std=std or None)
            elif kind in POSES and int(m.sensor_objtype[row]) == mujoco.mjtObj.mjOBJ_XBODY:
                body = m.body(int(m.sensor_objid[row])).name
                if body not in self._objects or not trial.frames[self._objects.index(body)]:
                    continue
                i = self._objects.index(body)
                pose, turn = np.array(trial.poses[i]), kind == POSES[1]
                std = None if exact else errors.orientation_std if turn else errors.position_std
                found[name] = Channel(
                    np.array(trial.frames[i]), pose[:, 3:] if turn else pose[:, :3], noise_std=std or None
                )
        return found


def _readings(m: mujoco.MjModel, qpos: Sequence[np.ndarray]) -> np.ndarray:
    """Return what the scene's sensors read at positions (nq,) each, shape (T, nsensordata)."""
    data = mujoco.MjData(m)
    found = np.zeros((len(qpos), m.nsensordata))
    for row, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_fwdPosition(m, data)
        mujoco.mj_sensorPos(m, data)
        found[row] = data.sensordata
    return found


def _tendon_noise(m: mujoco.MjModel, tendon: int) -> float:
    """Return the noise of a fixed tendon's length over that of its joints."""
    first = int(m.tendon_adr[tendon])
    return float(np.linalg.norm(m.wrap_prm[first : first + int(m.tendon_num[tendon])]))
