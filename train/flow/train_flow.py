"""Training of a flow policy, from a LeRobot v3 data set to the policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tomli_w
import torch

from concent_warp.checks import check_device
from concent_warp.files import write_text
from concent_warp.run_folder import SETTINGS, TRAIN_CHECKPOINT, check_unchanged, plain, run_folder, write_settings
from concent_warp.train.flow.cfg import FLOW_SETTINGS, TrainFlowCfg, check_train_cfg
from concent_warp.train.flow.dataset import check_features, read_dataset
from concent_warp.train.flow.frames import decode_episodes, remove_frames
from concent_warp.train.flow.learning import FlowStep, FlowTraining
from concent_warp.train.flow.policy import POLICY, FlowPolicy, policy_of, write_policy
from concent_warp.train.flow.sources import open_dataset

FREE = ("dataset", "checkpoint", "device_share")
"""Settings that may differ when a training is continued: where the data set is, and those without influence."""


@dataclass(frozen=True)
class FlowProgress:
    """How far a training is.

    Example:
        >>> import concent_warp as cw
        >>> def report(now: cw.FlowProgress) -> str:
        ...     return now.work if now.step is None else f"{now.step.loss:.3f}, {now.step.left:.0f} s left"
        >>> report(cw.FlowProgress("reading images", 0.5))
        'reading images'
    """

    work: str
    """What is being done: "reading images" or "training"."""
    share: float
    """Share of it that is done, 0..1."""
    step: FlowStep | None = None
    """Where the training is; None while images are read."""


def train_flow(
    dataset: str | Path | Sequence[str | Path],
    cfg: TrainFlowCfg | None = None,
    *,
    device: str | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[FlowProgress], None] | None = None,
) -> FlowPolicy:
    """Train a policy from images, proprioception and text to chunks of actions on LeRobot v3 data sets.

    The policy is a rectified flow after FLOWER (Reuss et al., CoRL 2025): tokens of images and text condition a
    transformer by cross-attention, which turns noise into a chunk of actions.

    Args:
        dataset: Folder of the data set, as `render` and `write_lerobot` write it, or a user's own; or the folders of
            several, with the same cameras, states and actions.
        cfg: Settings.
        device: Torch's name of the device; the first CUDA device by default, the CPU without one.
        out: Run folder for the policy, checkpoints and metrics; None writes none.
        resume: Continue the training of the run folder, as if it had not stopped.
        overwrite: Replace an earlier run in the folder.
        progress: Called while images are read, and after some of the steps.

    Returns:
        The policy, whose weights are the running mean of the training's.

    Raises:
        TrainError: A setting is out of bounds or does not fit the data set, the folder's training was begun with other
            ones, or the loss became non-finite.
        RecordingError: The data set is of another format, or something of it is missing.
        ConcentError: The folder holds a run and neither `resume` nor `overwrite` is given.

    Example:
        >>> import concent_warp as cw
        >>> rendering = cw.RenderCfg(size=32, cameras=("base",))
        >>> dataset = cw.render(cw.load_policy("shape_sorter").run.recording, "dataset", rendering)
        >>> sizes = cw.FlowPolicyCfg(size=16, width=16, layers=1, heads=2, chunk=4, execute=2)
        >>> policy = cw.train_flow("dataset", cw.TrainFlowCfg(steps=2, batch=2, policy=sizes), device="cpu")
        >>> policy.features.cameras
        ('base',)
    """
    cfg, given = cfg or TrainFlowCfg(), [dataset] if isinstance(dataset, str | Path) else dataset
    sources = [Path(one) for one in given]
    check_train_cfg(cfg)
    check_device(device)
    check_features(sources, cfg.data)
    report = progress or _ignore
    where = device or ("cuda:0" if torch.cuda.is_available() else "cpu")
    with ExitStack() as stack:
        if out is None:
            place = Path(stack.enter_context(TemporaryDirectory()))
            return _trained(sources, cfg, place, where, report, folder=None)
        claimed = stack.enter_context(run_folder(Path(out), overwrite=overwrite, resume=resume, keep_folders=False))
        named = [str(one) for one in sources]
        settings = {"dataset": named[0] if len(named) == 1 else named, **plain(cfg)}
        if resume and (claimed.path / TRAIN_CHECKPOINT).exists():
            check_unchanged(claimed.path / SETTINGS, settings, FREE)
            if (claimed.path / POLICY).is_file():
                return FlowPolicy.load(claimed.path, device=where)
        write_settings(claimed.path, settings)
        write_text(claimed.path / FLOW_SETTINGS, tomli_w.dumps(plain(cfg)))
        _trained(sources, cfg, claimed.path, where, report, folder=claimed.path)
        path = claimed.commit()
        return FlowPolicy.load(path, device=where)


def _trained(
    sources: Sequence[Path],
    cfg: TrainFlowCfg,
    place: Path,
    device: str,
    report: Callable[[FlowProgress], None],
    *,
    folder: Path | None,
) -> FlowPolicy:
    """Train, and return the policy.

    Args:
        sources: Folders of the data sets.
        cfg: Settings.
        place: Folder for decoded images.
        device: Torch's name of the device.
        report: Told about the progress.
        folder: Run folder, where a checkpoint is gone on with if there is one; None for none.
    """
    log = open_dataset(*sources)
    data = read_dataset(log, cfg.data)
    training = FlowTraining(data, cfg, folder, device=device)
    if folder is not None and (folder / TRAIN_CHECKPOINT).exists():
        training.resume()

    def reading(share: float) -> None:
        report(FlowProgress("reading images", share))

    frames = decode_episodes(log, data.images, cfg.policy.edge, data.lengths, place, progress=reading)
    training.open_images(frames)
    training.learn(lambda step: report(FlowProgress("training", step.done / step.steps, step)))
    network = training.mean.module
    if folder is not None:
        write_policy(folder / POLICY, cfg.policy, data.features, network)  # pyright: ignore[reportArgumentType]
        remove_frames(folder)
    weights = {name: value.detach().cpu() for name, value in network.state_dict().items()}
    return policy_of({**training.described(), "weights": weights}, place / POLICY, device)


def _ignore(_: FlowProgress) -> None:
    """Do nothing."""
