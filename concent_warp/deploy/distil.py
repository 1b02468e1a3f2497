"""Distillation of a trained policy to a student that sees: training, environment and renderer joined."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from concent_warp.deploy.cfg import splat_files
from concent_warp.deploy.simulated_images import simulated_images
from concent_warp.errors import RenderError
from concent_warp.run_folder import RunFolder, plain, run_folder, write_settings
from concent_warp.train.distil.cfg import DistilCfg
from concent_warp.train.distil.run import Distillation, run_distillation
from concent_warp.train.distil.student import Student
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.ppo import CHECKPOINT, Iteration
from concent_warp.train.policy.load import Policy


def distil(
    policy: Policy,
    cfg: DistilCfg | None = None,
    *,
    begin_with: Student | None = None,
    device: str | None = None,
    seconds: float | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[Iteration], None] | None = None,
) -> Student:
    """Train a student that sees to act as a policy does, by DAgger with images in the loop.

    The policy, the teacher, labels the states that the student gets into. Under ``torchrun`` the training is
    distributed data-parallel: each rank simulates and renders its own worlds.

    Args:
        policy: The teacher.
        cfg: Settings.
        begin_with: Student to begin with, of the same network; random weights by default. Images may have another
            size.
        device: Warp's name of the device; the first CUDA device by default, the CPU without one.
        seconds: Time after which to stop [s].
        out: Run folder for checkpoints, metrics and the teacher; None writes none.
        resume: Continue the distillation of the run folder, as if it had not stopped.
        overwrite: Replace an earlier run in the folder.
        progress: Called after every iteration.

    Raises:
        TrainError: The folder's distillation was started with other settings or another teacher, worlds or samples do
            not fit the memory, or the student to begin with has another network.
        RenderError: A camera is not there, or networks or splats cannot be used.
        ConcentError: The folder holds a run and neither `resume` nor `overwrite` is given.

    Example:
        >>> import concent_warp as cw
        >>> dagger = cw.DaggerCfg(iterations=1, worlds=2, steps=2, updates=1, batch=2)
        >>> cfg = cw.DistilCfg(states=4, images=cw.ImagesCfg(size=16), dagger=dagger)
        >>> student = cw.distil(cw.load_policy("shape_sorter"), cfg, device="cpu")
        >>> student.weights["iteration"]
        1
    """
    cfg, process = cfg or DistilCfg(), DistributedProcess.from_environment()
    splat_files(cfg.images.splats)  # before worlds are made
    if (networks := cfg.images.networks) is not None and not Path(networks).exists():
        raise RenderError("there are no trained networks", where=networks, fix="train them with concent render-train")
    folder = None if out is None else Path(out)
    inputs = Distillation(policy, cfg, lambda environment: simulated_images(environment, cfg.images, cfg.looks))
    with process.group(process.device(device)), ExitStack() as stack:
        claimed: RunFolder | None = None
        with process.raise_together():
            if folder is not None and process.is_rank_zero:
                claimed = stack.enter_context(run_folder(folder, overwrite=overwrite, resume=resume))
        path = process.gather(None if claimed is None else claimed.path)[0]

        def begin() -> Path:
            assert claimed is not None
            write_settings(claimed.path, plain(cfg))
            return claimed.commit()

        trainer, _ = run_distillation(
            inputs,
            path,
            device=device,
            resume=resume and path is not None and (path / CHECKPOINT).exists(),
            report=progress,
            seconds=seconds,
            process=process,
            begun=None if claimed is None else begin,
            begin_with=None if begin_with is None else begin_with.weights,
        )
    return Student(policy, cfg, trainer.weights(), folder or Path())
