"""Training: from a model and the contact events of a demonstration to a policy (paper, section 3.2)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from concent_warp.checks import check_at_least
from concent_warp.errors import TrainError
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import RunFolder, plain, run_folder, write_settings
from concent_warp.train.cfg import ALL, LAST, TrainCfg
from concent_warp.train.learning.best_policy import chosen_weights
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.ppo import CHECKPOINT, Iteration
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import TrainingRun, train_run
from concent_warp.train.several_seeds import check_one_seed, check_several, train_several


def train(
    model: Model,
    recording: Recording,
    cfg: TrainCfg | None = None,
    *,
    seeds: int = 1,
    events: ContactEventSequence | Mapping[str, ContactEventSequence] | None = None,
    demonstration: str | None = None,
    begin_with: Policy | None = None,
    device: str | None = None,
    seconds: float | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[Iteration], None] | None = None,
) -> Policy:
    """Train a policy by PPO to bring about the contact events of a demonstration.

    Under ``torchrun`` the training is distributed data-parallel: each rank simulates its own worlds.

    With several seeds, a policy is trained for each, one after the other, and all are put to the same stress test, in
    episodes that chose none of their checkpoints. The policy that does best is returned. The run folder is that of its
    training; the trainings of all seeds are in folders within it, their results in ``seeds.json``.

    Args:
        model: The grounded model.
        recording: Recording with the demonstration.
        cfg: Settings.
        seeds: Number of policies to train, with the seeds `cfg.seed`, `cfg.seed` + 1 and so on.
        events: Contact event sequence of the demonstration, or of several demonstrations by name; extracted by default.
        demonstration: Name of the demonstration; the first by default.
        begin_with: Initial policy; random weights by default.
        device: Warp's name of the device; the first CUDA device by default, the CPU without one.
        seconds: Time after which to stop, of each seed [s].
        out: Run folder for checkpoints, metrics and inputs; None writes none.
        resume: Continue the training of the run folder, as if it had not stopped.
        overwrite: Replace an earlier run in the folder.
        progress: Called after every iteration; iterations, steps and seconds are those of all seeds so far.

    Raises:
        TrainError: The settings do not fit the demonstration, the folder's training was started with other settings,
            the losses became non-finite, or several seeds are to be trained under ``torchrun``.
        ConcentError: The folder holds a run and neither `resume` nor `overwrite` is given.

    Example:
        >>> import concent_warp as cw
        >>> made = cw.load_policy("shape_sorter").run
        >>> ppo = cw.PpoCfg(iterations=1, steps=2)
        >>> cfg = cw.TrainCfg(environment=cw.EnvironmentCfg(worlds=2, stage="insert"), ppo=ppo)
        >>> policy = cw.train(made.model, made.recording, cfg, events=made.events, device="cpu")
        >>> policy.weights["iteration"]
        1
    """
    cfg, process = cfg or TrainCfg(), DistributedProcess.from_environment()
    name = recording[0].name if demonstration is None else demonstration
    sequence = events.get(name) if isinstance(events, Mapping) else events
    folder = None if out is None else Path(out)
    check_at_least(1, TrainError, seeds=seeds)
    if seeds > 1:
        check_several(process)
        sequence = TrainingRun.new(model, recording, cfg, demonstration=name, events=sequence).events

        def train_one(cfg: TrainCfg, folder: Path | None, report: Callable[[Iteration], None]) -> Policy:
            return train(
                model, recording, cfg, events=sequence, demonstration=name, begin_with=begin_with, device=device,
                seconds=seconds, out=folder, resume=folder is not None, progress=report,
            )  # fmt: skip

        return train_several(
            train_one, cfg, seeds, folder, device=device, resume=resume, overwrite=overwrite, progress=progress
        )
    with process.group(process.device(device)), ExitStack() as stack:
        claimed: RunFolder | None = None
        with process.raise_together():
            if folder is not None and process.is_rank_zero:
                claimed = stack.enter_context(run_folder(folder, overwrite=overwrite, resume=resume))
                check_one_seed(claimed.path)
        path = process.gather(None if claimed is None else claimed.path)[0]

        def begin() -> Path:
            assert claimed is not None
            write_settings(claimed.path, {"demonstration": name, **plain(cfg)})
            return claimed.commit()

        run = TrainingRun.new(model, recording, cfg, demonstration=name, events=sequence)
        if process.is_rank_zero:
            _warn_of_push(run)
        trainer, _ = train_run(
            run,
            path,
            device=device,
            resume=resume and path is not None and (path / CHECKPOINT).exists(),
            report=progress,
            seconds=seconds,
            process=process,
            begin_with=None if begin_with is None else begin_with.weights,
            begun=None if claimed is None else begin,
        )
    return Policy(run, chosen_weights(trainer.weights()), folder or Path())


def _warn_of_push(run: TrainingRun) -> None:
    """Warn if the trained task ends with a push, whose target is the touch of the robot alone."""
    stages, name = run.events.stages, run.cfg.environment.stage
    ends = stages[-1:] if name in (ALL, LAST) else [stage for stage in stages if stage.name == name]
    for stage in ends:
        if stage.bodies[0] == "robot" and stage.name.startswith("contact "):
            pushed = stage.bodies[1]
            warnings.warn(
                f"stage {stage.name!r} counts as done when the robot touches {pushed!r} as demonstrated, wherever that "
                f"is then; if it is to get somewhere, list what it meets there under concent_objects",
                stacklevel=3,
            )
