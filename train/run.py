"""Inputs of a training and the run folder that holds them beside its checkpoint."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from concent_warp.errors import EventsError, TrainError
from concent_warp.events.extract import extract
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import plain
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.train.cfg import SETTINGS, EnvironmentCfg, TrainCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import check_worlds, make_environment
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.ppo import CHECKPOINT, Examination, Iteration, Report, Trainer
from concent_warp.train.resets.sample import ResetStates, sample_reset_states
from concent_warp.train.task.nominal_shapes import with_nominal_shapes
from concent_warp.train.task.task import Task
from concent_warp.train.trials.episodes import PolicyFunction
from concent_warp.train.trials.stress import StressTest

MODEL, EVENTS, DEMONSTRATION = "model.toml", "events.json", "demonstration.h5"
CHANGEABLE = ("iterations", "checkpoint", "target", "capture", "fuse")
"""Settings that may differ when a training is resumed."""


@dataclass(frozen=True)
class TrainingRun:
    """Inputs of a training."""

    model: Model
    recording: Recording
    """Holds one demonstration."""
    events: ContactEventSequence
    cfg: TrainCfg

    def __post_init__(self) -> None:
        self._check_events()

    def _check_events(self) -> None:
        """Check that the events are of this demonstration and this model.

        Raises:
            EventsError: They name another demonstration, body or sphere.
        """
        events, name = self.events, self.recording[0].name
        if events.demonstration != name:
            raise EventsError(
                "the contact events are of another demonstration",
                expected=name,
                found=events.demonstration,
                fix="extract them with concent events",
            )
        m, geometry = self.model.scene.model, self.model.geometry
        bodies = {m.body(i).name for i in range(m.nbody)}
        for entity in events.entities:
            sphere_of = None
            if entity.sphere is not None and geometry is not None and 0 <= entity.sphere < len(geometry):
                sphere_of = geometry.bodies[geometry.body[entity.sphere]]
            if entity.body not in bodies or (entity.sphere is not None and entity.body != sphere_of):
                number = "" if entity.sphere is None else f", sphere {entity.sphere}"
                raise EventsError(
                    f"the contact events name {entity.name!r}, which the model does not have",
                    found=f"body {entity.body}{number}",
                    fix="extract them from this model with concent events",
                )

    @staticmethod
    def new(
        model: Model, recording: Recording, cfg: TrainCfg, *, demonstration: str | None = None,
        events: ContactEventSequence | None = None,
    ) -> TrainingRun:  # fmt: skip
        """Return the inputs for one demonstration of a recording, the first by default; extract its events if None."""
        name = recording[0].name if demonstration is None else demonstration
        one = recording.only([name])
        one.check_unloaded("a training")
        if events is None:
            events = extract(model, one[0], MujocoEngine(model, threads=1))
        return TrainingRun(model, one, events, cfg)

    def save(self, folder: Path) -> None:
        """Write model, events, demonstration and settings to a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        self.model.save(folder / MODEL)
        self.events.save(folder / EVENTS)
        write_hdf5(self.recording, folder / DEMONSTRATION)
        self.cfg.save(folder / SETTINGS)

    @staticmethod
    def load(folder: Path) -> TrainingRun:
        """Read what `save` wrote.

        Raises:
            TrainError: The folder holds no training.
        """
        if not (folder / SETTINGS).is_file():
            raise TrainError("the folder holds no training", where=folder, expected=f"a {SETTINGS}")
        return TrainingRun(
            Model.load(folder / MODEL),
            load_recording(folder / DEMONSTRATION),
            ContactEventSequence.load(folder / EVENTS),
            TrainCfg.load(folder / SETTINGS),
        )

    def task(self, environment: EnvironmentCfg | None = None) -> Task:
        """Return the task, by default with the settings of the training's environment."""
        return Task.build(self.model, self.recording[0], environment or self.cfg.environment, self.events)

    def stress_test(
        self, *, device: str | None = None, episodes: int | None = None, seed: int | None = None
    ) -> StressTest:
        """Return the stress test of this training's policies; see `StressTest`."""
        return StressTest(self.cfg, self.task, device=device, episodes=episodes, seed=seed)

    def evaluation_states(self, task: Task, count: int, seed: int) -> ResetStates:
        """Return initial states for an evaluation, sampled with another seed than those of training.

        All are displaced from the demonstration, with the object grasped as demonstrated; in a chain of stages, all are
        initial states of the whole task.
        """
        cfg = replace(self.cfg.environment.reset, demonstrated=0.0, grasp_turn=0.0, free=1.0)
        return sample_reset_states(task, cfg, seed + 1_000_000, count=count)


def train_run(
    run: TrainingRun,
    folder: Path | None,
    *,
    device: str | None = None,
    resume: bool = False,
    report: Report | None = None,
    seconds: float | None = None,
    process: DistributedProcess | None = None,
    begin_with: Mapping[str, Any] | None = None,
    begun: Callable[[], Path] | None = None,
) -> tuple[Trainer, Iteration | None]:
    """Train, and return the trainer and its last iteration.

    Args:
        run: What to train.
        folder: Run folder; None writes none.
        device: Warp's name of the device; the first CUDA device by default where there is one.
        resume: Continue from the folder's checkpoint.
        report: Called after every iteration.
        seconds: Time after which to stop [s].
        process: This process of a data-parallel training, within its group; a single process by default. Each rank
            simulates `run.cfg.environment.worlds` worlds.
        begin_with: Checkpoint of the initial policy as `load_checkpoint` returns it, unless a training is resumed.
        begun: Called when all is set up and a checkpoint is written; returns the run folder from then on.

    Raises:
        TrainError: The folder's training was started with other settings, or the initial policy has another
            architecture.
    """
    process = process or DistributedProcess()
    with process.raise_together():
        if folder is not None and process.is_rank_zero and resume:
            check_unchanged(TrainCfg.load(folder / SETTINGS), run.cfg, folder)
        task, device, seed = run.task(), process.device(device), process.seed(run.cfg.seed)
        check_worlds(task, run.cfg.environment, device)  # before much is computed
        states = sample_reset_states(task, run.cfg.environment.reset, seed, device=device)

        def make(buffers: tuple[int, int] | None = None, finishing: bool = False) -> Environment:
            cfg, given = run.cfg.environment, task
            options: dict[str, Any] = {}
            if finishing:
                cfg = replace(cfg, collision="full")
                given = run.task(cfg)
                shaped = with_nominal_shapes(given) if run.cfg.finish.physics == "shapes" else None
                if shaped is not None:
                    given, constant = shaped, run.cfg.stress.time_constant
                    cfg = replace(cfg, stride=1)
                    options = {"refine": steps_for(given, constant), "time_constant": constant}
            if buffers is not None:
                cfg = replace(cfg, nconmax=buffers[0], njmax=buffers[1])
            return make_environment(given, cfg, states, device=device, seed=seed, **options)

        def examination() -> Examination:
            test = run.stress_test(device=device)

            def examine(policy: PolicyFunction) -> tuple[int, int]:
                found = test(policy).success
                return int(found.sum()), len(found)

            return examine

        environment = make()
        trainer = Trainer(environment, run.cfg, folder, process, make, examination)
        environment.reset()
        del environment  # the trainer's alone, which frees it where it needs another one
        if resume and folder is not None:
            trainer.resume(folder / CHECKPOINT)
        elif begin_with is not None:
            trainer.begin_with(begin_with)
        if folder is not None and process.is_rank_zero:
            run.save(folder)
    if not resume:
        trainer.save()
    with process.raise_together():
        if begun is not None:
            trainer.folder = begun()
    return trainer, trainer.learn(report, seconds=seconds)


def steps_for(task: Task, time_constant: float) -> int:
    """Return the simulation steps per time step of a task's model that contacts of a time constant [s] need."""
    return math.ceil(2 * task.compiled.opt.timestep / time_constant - 1e-9)


def check_unchanged(before: TrainCfg, now: TrainCfg, folder: Path) -> None:
    """Check that settings are those that a training was started with.

    Raises:
        TrainError: Some differ.
    """

    def flat(value: object, prefix: str = "") -> dict[str, object]:
        if not isinstance(value, dict):
            return {prefix: value}
        return {k: v for name, part in value.items() for k, v in flat(part, f"{prefix}.{name}".lstrip(".")).items()}

    a, b = flat(plain(before)), flat(plain(now))
    differing = [n for n in sorted(a | b) if n.split(".")[-1] not in CHANGEABLE and a.get(n) != b.get(n)]
    if differing:
        raise TrainError(
            "this training was started with other settings",
            where=folder,
            expected=", ".join(f"{name} {a.get(name)}" for name in differing),
            found=", ".join(f"{name} {b.get(name)}" for name in differing),
            fix="pass the same settings, or train again with --overwrite",
        )
