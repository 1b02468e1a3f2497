"""Trials made ready to be judged: readings, start, replay, misfit, free motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.deploy.explain.cfg import ExplainCfg
from concent_warp.deploy.explain.contact_start import ContactStarts
from concent_warp.deploy.explain.free_motion import free_readings
from concent_warp.deploy.explain.measured_start import MeasuredStart, measured_start
from concent_warp.deploy.explain.misfit import divergence, misfit
from concent_warp.deploy.explain.replay_trial import Replayer, TrialReadings, joint_ratio, trial_readings
from concent_warp.errors import RecordingError
from concent_warp.recording.recording import Demonstration
from concent_warp.train.task.task import Task


@dataclass(frozen=True)
class PreparedTrial:
    """One trial with what its replay in the model shows."""

    demonstration: Demonstration
    readings: TrialReadings
    measured: MeasuredStart
    """Start as measured."""
    start: MeasuredStart
    """Start that measurement and contact agree on."""
    move: np.ndarray
    """What was between them: position [m] and rotation vector, shape (6,)."""
    joint_error: float
    """RMS joint error of the replay over noise [-]."""
    free_error: float | None
    """The same in free motion; None where there is too little of it."""
    free_time: float
    """Time up to which the object came near nothing but the hand [s]."""

    def misfit(self, replayer: Replayer, contact: ContactStarts, joint_scale: float) -> float:
        """Return the misfit of the replay from its start; the move of the object counts as an error of the tracker."""
        pose = self.start.qpos[contact.address : contact.address + 7]
        replayed = replayer.run(self.demonstration, self.readings, self.start, pose[None])
        return float(misfit(self.readings, replayed, joint_scale).total[0])

    def windows(self, replayer: Replayer, contact: ContactStarts, joint_scale: float, width: float) -> np.ndarray:
        """Return the error of the replay in each window, shape (W,); see `divergence`."""
        pose = self.start.qpos[contact.address : contact.address + 7]
        replayed = replayer.run(self.demonstration, self.readings, self.start, pose[None])
        return divergence(self.readings, replayed, joint_scale, width)


class Preparation:
    """Makes trials of one task ready."""

    def __init__(self, task: Task, scene: mujoco.MjModel, cfg: ExplainCfg) -> None:
        """Compile what trials are replayed in; `scene` is the compiled nominal scene."""
        self.task, self.cfg, self._scene = task, cfg, scene
        self.contact = ContactStarts(task.compiled, task.objects[0], cfg.start)
        self.replayer = Replayer(task)

    def trial(self, demonstration: Demonstration) -> PreparedTrial:
        """Return a trial made ready.

        Raises:
            RecordingError: It lacks readings that are needed.
        """
        task, cfg = self.task, self.cfg
        m = task.compiled
        measured = measured_start(
            m,
            demonstration,
            task.objects,
            task.robot.tool,
            grasped=task.starts_grasped(task.first),
            span=cfg.start.grasp_span,
        )
        measured = replace(measured, fixtures=self._moved_fixtures(measured))
        readings = trial_readings(m, task, demonstration)
        start, move = self.contact.settled(measured)
        pose = start.qpos[self.contact.address : self.contact.address + 7]
        joints = joint_ratio(readings, self.replayer.run(demonstration, readings, start, pose[None]))[0]
        free = free_readings(
            self._scene, task.objects[0], task.robot.tool, demonstration, readings, start, cfg.judge.clearance
        )
        end = float(readings.time[max(free - 1, 0)])
        judged = free > 1 and end - readings.time[0] >= cfg.judge.least_free
        free_error = _rms(joints[:free]) if judged else None
        return PreparedTrial(demonstration, readings, measured, start, move, _rms(joints), free_error, end)

    def usable(self, demonstrations: Sequence[Demonstration]) -> list[PreparedTrial]:
        """Return trials made ready, without those that lack readings, as they do where they ended at once."""
        found = []
        for demonstration in demonstrations:
            try:
                found.append(self.trial(demonstration))
            except RecordingError:  # ended before the tracker showed anything
                continue
        return found

    def _moved_fixtures(self, measured: MeasuredStart) -> dict[str, np.ndarray]:
        """Return the poses of fixed objects that stand elsewhere than in the scene."""
        m = self.task.compiled
        return {
            name: pose
            for name, pose in measured.fixtures.items()
            if np.linalg.norm(pose[:3] - m.body_pos[m.body(name).id]) > self.cfg.start.fixture_distance
        }


def _rms(values: np.ndarray) -> float:
    """Return the root mean square; large where a replay diverged."""
    return float(np.sqrt(np.mean(np.where(np.isfinite(values), values, 1e3) ** 2)))
