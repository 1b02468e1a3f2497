"""Inputs of a distillation and the run folder that holds them beside its checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from concent_warp.checkpoint_file import write_checkpoint
from concent_warp.errors import TrainError
from concent_warp.run_folder import plain
from concent_warp.train.distil.cfg import DISTIL_SETTINGS, DistilCfg
from concent_warp.train.distil.dagger import Dagger
from concent_warp.train.distil.images import MakeImages
from concent_warp.train.distil.rsl_rl import RslRlDagger
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import check_worlds, make_environment
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.ppo import CHECKPOINT, Iteration, Report, load_checkpoint
from concent_warp.train.policy.load import Policy
from concent_warp.train.resets.sample import sample_reset_states
from concent_warp.train.trials.stress import stressed, with_shapes

TEACHER = "teacher"
"""Folder of the teacher in the run folder of a student."""
CHANGEABLE = ("iterations", "checkpoint")
"""Settings that may differ when a distillation is resumed."""


@dataclass(frozen=True)
class Distillation:
    """Inputs of a distillation."""

    teacher: Policy
    cfg: DistilCfg
    make_images: MakeImages = field(repr=False)
    """Makes the cameras of an environment's worlds."""

    def environment(self, device: str, seed: int) -> Environment:
        """Return the worlds of a training, as the teacher was trained in them but for what the settings say."""
        run, cfg = self.teacher.run, self.cfg
        stress = run.cfg.stress if cfg.physics == "stress" else None
        settings = run.cfg.environment if stress is None else stressed(run.cfg.environment, stress)
        settings = replace(
            settings,
            worlds=cfg.dagger.worlds,
            reset=replace(settings.reset, free=cfg.free),
            chain=replace(settings.chain, tolerance=max(cfg.tolerance, settings.chain.tolerance)),
        )
        if stress is None and (buffers := self.teacher.weights.get("buffers")) is not None:
            settings = replace(settings, nconmax=int(buffers[0]), njmax=int(buffers[1]))
        task = run.task(settings)
        check_worlds(task, settings, device)
        states = sample_reset_states(task, settings.reset, seed, count=cfg.states, device=device)
        if stress is None:
            return make_environment(task, settings, states, device=device, seed=seed)
        physical, options = with_shapes(task, stress), {"refine": stress.refine, "time_constant": stress.time_constant}
        return make_environment(physical, settings, states, device=device, seed=seed, **options)

    def save(self, folder: Path) -> None:
        """Write the settings and the teacher to a run folder."""
        self.cfg.save(folder / DISTIL_SETTINGS)
        run = self.teacher.run
        one = replace(run.recording[0], points={}, image={})
        replace(run, recording=replace(run.recording, demonstrations=(one,))).save(folder / TEACHER)
        names = ("actor_state_dict", "iteration", "steps", "seconds")
        write_checkpoint(folder / TEACHER / CHECKPOINT, {name: self.teacher.weights[name] for name in names})

    def check_resumed(self, folder: Path) -> None:
        """Check that a folder's distillation is this one.

        Raises:
            TrainError: Settings or the teacher differ.
        """
        before, now = _flat(plain(DistilCfg.load(folder / DISTIL_SETTINGS))), _flat(plain(self.cfg))
        differing = [n for n in sorted(before | now) if n.split(".")[-1] not in CHANGEABLE]
        differing = [n for n in differing if before.get(n) != now.get(n)]
        if differing:
            raise TrainError(
                "this distillation was started with other settings",
                where=folder,
                expected=", ".join(f"{name} {before.get(name)}" for name in differing),
                found=", ".join(f"{name} {now.get(name)}" for name in differing),
                fix="pass the same settings, or start anew with --overwrite",
            )
        kept = load_checkpoint(folder / TEACHER / CHECKPOINT)["actor_state_dict"]
        given = self.teacher.weights["actor_state_dict"]
        if kept.keys() != given.keys() or not all(torch.equal(kept[name], given[name].cpu()) for name in kept):
            raise TrainError(
                "this distillation was started with another teacher", where=folder, expected=folder / TEACHER,
                fix="pass the same teacher, or start anew with --overwrite",
            )  # fmt: skip


def run_distillation(
    inputs: Distillation,
    folder: Path | None,
    *,
    device: str | None = None,
    resume: bool = False,
    report: Report | None = None,
    seconds: float | None = None,
    process: DistributedProcess | None = None,
    begun: Callable[[], Path] | None = None,
    begin_with: Mapping[str, Any] | None = None,
) -> tuple[Dagger, Iteration | None]:
    """Train a student, and return the trainer and its last iteration.

    Args:
        inputs: Teacher, settings and cameras.
        folder: Run folder; None writes none.
        device: Warp's name of the device; the first CUDA device by default where there is one.
        resume: Continue from the folder's checkpoint.
        report: Called after every iteration.
        seconds: Time after which to stop [s].
        process: This process of a data-parallel training, within its group; a single process by default.
        begun: Called when all is set up and a checkpoint is written; returns the run folder from then on.
        begin_with: Weights of another student, unless a distillation is resumed.

    Raises:
        TrainError: The folder's distillation was started with other settings or another teacher, or the worlds or the
            samples do not fit the memory.
    """
    process = process or DistributedProcess()
    cfg = inputs.cfg
    with process.raise_together():
        if folder is not None and resume:
            inputs.check_resumed(folder)
        device, seed = process.device(device), process.seed(cfg.seed)
        environment = inputs.environment(device, seed)
        images = inputs.make_images(environment)
        teacher = inputs.teacher.act_in(environment)
        kind = RslRlDagger if cfg.method == "rsl_rl" else Dagger
        trainer = kind(environment, teacher, images, cfg, folder, process)
        environment.reset()
        if resume and folder is not None:
            trainer.resume(folder / CHECKPOINT)
        elif begin_with is not None:
            trainer.begin_with(begin_with)
        if folder is not None and process.is_rank_zero:
            inputs.save(folder)
    if not resume:
        trainer.save()
    with process.raise_together():
        if begun is not None:
            trainer.folder = begun()
    trainer.folder = process.gather(trainer.folder)[0]
    return trainer, trainer.learn(report, seconds=seconds)


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their dotted names."""
    if not isinstance(value, dict):
        return {prefix: value}
    return {k: v for name, part in value.items() for k, v in _flat(part, f"{prefix}.{name}".lstrip(".")).items()}
