"""What the policy's own simulation does from the measured starts of trials, with or without a difference from training.

Its episodes are recorded as trials are, through the same instruments, so that both can be compared by the same measure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from concent_warp.deploy.explain.measured_start import MeasuredStart
from concent_warp.deploy.record_trials import TrialRecorder
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.observation_cfg import SensorErrorsCfg
from concent_warp.train.policy.load import Policy
from concent_warp.train.resets.sample import ResetStates
from concent_warp.train.task.movable_fixtures import mocap_id
from concent_warp.train.task.task import Task
from concent_warp.train.trials.episodes import PolicyFunction
from concent_warp.train.trials.evaluate import run_episodes


@dataclass(frozen=True)
class SimulatedTrials:
    """Episodes in the policy's own simulation, K from each of T measured starts."""

    success: np.ndarray
    """Whether an episode succeeded, shape (T, K) bool."""
    recording: Recording
    """The episodes as instruments show them; of start t and repetition k is ``demo_<t K + k>``."""
    position: dict[int, np.ndarray] = field(default_factory=dict)
    """True positions of object 1 in each episode [m], shape (S, 3), by the number of the episode."""

    @property
    def rate(self) -> float:
        """Share of the episodes that succeed."""
        return float(self.success.mean())

    def of_first(self, count: int) -> SimulatedTrials:
        """Return the episodes from the first starts."""
        episodes = count * self.success.shape[1]
        chosen = replace(self.recording, demonstrations=self.recording.demonstrations[:episodes])
        return replace(self, success=self.success[:count], recording=chosen)


class OwnSimulation:
    """The simulation that a policy was trained in, with the randomisation and the instruments of its training."""

    def __init__(self, policy: Policy, repetitions: int, seed: int) -> None:
        """Prepare the task; `repetitions` episodes start from each state."""
        self._policy, self._repetitions, self._seed = policy, repetitions, seed
        self.task: Task = policy.run.task()
        self.act: PolicyFunction | None = None
        """The policy, once it has run."""

    def run(
        self,
        starts: Sequence[MeasuredStart],
        *,
        model: Model | None = None,
        sensors: SensorErrorsCfg | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> SimulatedTrials:
        """Return episodes from measured starts.

        Args:
            starts: States to start from.
            model: Model in place of that of the training, with other effects.
            sensors: Errors of the instruments in place of those of the training.
            progress: Called with the share done, 0..1.
        """
        run = self._policy.run if model is None else replace(self._policy.run, model=model)
        task = self.task if model is None else run.task()
        cfg = run.cfg.environment
        if sensors is not None:
            cfg = replace(cfg, observation=replace(cfg.observation, sensors=sensors))
        count = len(starts) * self._repetitions
        states = _states(task, starts, self._repetitions)
        torch.manual_seed(self._seed)
        environment = make_environment(
            task, replace(cfg, worlds=count, engine="mujoco"), states, device="cpu", seed=self._seed
        )
        recorder = TrialRecorder(run, environment, cfg.observation.sensors)
        positions: dict[int, list[np.ndarray]] = {}
        body = task.objects[0]

        def watch(episodes: np.ndarray, qpos: np.ndarray) -> None:
            recorder(episodes, qpos)
            place = environment.physics.position.cpu().numpy()[:, body]
            for episode in episodes.tolist():
                positions.setdefault(episode, []).append(place[episode].copy())

        self.act = self._policy.act_in(environment)
        found = run_episodes(environment, recorder.acting(self.act), states, progress=progress, watch=watch)
        return SimulatedTrials(
            found.success.reshape(len(starts), self._repetitions),
            recorder.recording(found, range(count)),
            {episode: np.array(place) for episode, place in positions.items()},
        )


def _states(task: Task, starts: Sequence[MeasuredStart], repetitions: int) -> ResetStates:
    """Return the initial states of episodes."""
    m = task.compiled
    count = len(starts) * repetitions
    mocap = np.tile(np.zeros((m.nmocap, 7)), (len(starts), 1, 1))
    for body in range(m.nbody):
        if (row := mocap_id(m, body)) is not None:
            mocap[:, row] = np.concatenate([m.body_pos[body], m.body_quat[body]])
            for k, start in enumerate(starts):
                if (pose := start.fixtures.get(m.body(body).name)) is not None:
                    mocap[k, row] = pose

    def each(values: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        return np.repeat(np.array(values), repetitions, axis=0)

    return ResetStates(
        qpos=each([s.qpos for s in starts]),
        qvel=np.zeros((count, m.nv)),
        ctrl=each([s.ctrl for s in starts]),
        mocap=each(mocap),
        stage=np.full(count, task.first),
        begins=np.full(count, task.demonstrated is not None),
        time=np.zeros(count),
        case=np.full(count, 2),
        discarded={},
    )
