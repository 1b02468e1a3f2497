"""A run folder: everything that a training was made from, and what it came to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from concent_warp.errors import TrainError
from concent_warp.events.extract import extract
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Recording
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.train.cfg import SETTINGS, TrainCfg, plain
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.learning.distributed import Ranks
from concent_warp.train.learning.ppo import CHECKPOINT, Iteration, Report, Trainer
from concent_warp.train.resets.sample import ResetStates, draw_states
from concent_warp.train.task.task import Task

MODEL, EVENTS, DEMONSTRATION = "model.toml", "events.json", "demonstration.h5"
FREE = ("iterations", "checkpoint", "target", "capture", "fuse")
"""Settings that may change when a training is gone on with."""


@dataclass(frozen=True)
class TrainingRun:
    """What a training is made from."""

    model: Model
    recording: Recording
    """Of the one demonstration."""
    events: ContactEventSequence
    cfg: TrainCfg

    @staticmethod
    def new(
        model: Model, recording: Recording, cfg: TrainCfg, *, demonstration: str | None = None,
        events: ContactEventSequence | None = None,
    ) -> TrainingRun:  # fmt: skip
        """Make a run of one demonstration of a recording, the first by default; its events are extracted if need be."""
        name = recording[0].name if demonstration is None else demonstration
        one = recording.only([name])
        if events is None:
            events = extract(model, one[0], MujocoEngine(model, threads=1))
        return TrainingRun(model, one, events, cfg)

    def save(self, folder: Path) -> None:
        """Write all of it to a folder."""
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

    def task(self) -> Task:
        """Return the task."""
        return Task.build(self.model, self.recording[0], self.cfg.environment, self.events)

    def evaluation_states(self, task: Task, count: int, seed: int) -> ResetStates:
        """Return initial states to judge a policy by, none of which training has seen.

        They are displaced ones alone, held as demonstrated; where stages are chained, starts of the whole alone.
        """
        cfg = replace(self.cfg.environment.reset, demonstrated=0.0, held=0.0, free=1.0)
        return draw_states(task, cfg, seed + 1_000_000, count=count)


def train_run(
    run: TrainingRun,
    folder: Path | None,
    *,
    device: str | None = None,
    resume: bool = False,
    report: Report | None = None,
    seconds: float | None = None,
    ranks: Ranks | None = None,
    begin_with: Path | None = None,
) -> tuple[Trainer, Iteration | None]:
    """Train, and return the trainer and its last round.

    Args:
        run: What to train.
        folder: Where to write; None for nowhere.
        device: Warp's name of the device; the first CUDA device by default where there is one.
        resume: Go on from the folder's checkpoint.
        report: Called after every round.
        seconds: Time after which to stop [s].
        ranks: The processes that train together, joined already; this one alone by default. Each has
            `run.cfg.environment.worlds` worlds of its own.
        begin_with: Checkpoint whose policy to begin with, where nothing is gone on with.

    Raises:
        TrainError: The folder's training was begun with other settings, or the policy to begin with does not fit.
    """
    ranks = Ranks() if ranks is None else ranks
    with ranks.agreeing():
        if folder is not None and ranks.first:
            if resume:
                _check_unchanged(TrainCfg.load(folder / SETTINGS), run.cfg, folder)
            run.save(folder)
        task, where, seed = run.task(), ranks.device(device), ranks.seed(run.cfg.seed)
        states = draw_states(task, run.cfg.environment.reset, seed, device=where)
        environment = make_environment(task, run.cfg.environment, states, device=where, seed=seed)
        trainer = Trainer(environment, run.cfg, folder, ranks)
        environment.reset()
        if resume and folder is not None:
            trainer.resume(folder / CHECKPOINT)
        elif begin_with is not None:
            trainer.begin_with(begin_with)
    return trainer, trainer.learn(report, seconds=seconds)


def _check_unchanged(before: TrainCfg, now: TrainCfg, folder: Path) -> None:
    """Refuse settings that differ from those that a training was begun with."""

    def flat(value: object, prefix: str = "") -> dict[str, object]:
        if not isinstance(value, dict):
            return {prefix: value}
        return {k: v for name, part in value.items() for k, v in flat(part, f"{prefix}.{name}".lstrip(".")).items()}

    a, b = flat(plain(before)), flat(plain(now))
    differing = [n for n in sorted(a | b) if n.split(".")[-1] not in FREE and a.get(n) != b.get(n)]
    if differing:
        raise TrainError(
            "this training was begun with other settings",
            where=folder,
            expected=", ".join(f"{name} {a.get(name)}" for name in differing),
            found=", ".join(f"{name} {b.get(name)}" for name in differing),
            fix="repeat them, or start anew with --overwrite",
        )
