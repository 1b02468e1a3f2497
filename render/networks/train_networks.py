"""A training of the networks that paint robot and background, from a recording to the checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import warp as wp

from concent_warp.recording.recording import Recording
from concent_warp.render.networks.cfg import RenderTrainCfg
from concent_warp.render.networks.pairs import pairs_of
from concent_warp.render.networks.train import CHECKPOINT, RenderTraining
from concent_warp.simulate.warp_engine import preferred_device

Progress = Callable[[str, float, str], None]
"""Called with what is being done, the share of it that is done, 0..1, and a text."""


def train_networks(
    recording: Recording,
    folder: Path,
    cfg: RenderTrainCfg | None = None,
    *,
    cameras: Sequence[str] = (),
    device: str | None = None,
    resume: bool = False,
    started: Callable[[], object] | None = None,
    progress: Progress | None = None,
) -> RenderTraining:
    """Train the networks of a recording's cameras, with checkpoints in a folder.

    Args:
        recording: Demonstrations with images and measured joints, no objects on the table.
        folder: Folder to write to, which exists.
        cfg: Settings.
        cameras: Cameras to learn; all of the recording by default.
        device: Warp's name of the device; the first CUDA device by default where there is one.
        resume: Whether to continue from the checkpoint in the folder, if there is one.
        started: Called once before the first step.
        progress: Called while images of the simulation are rendered and after steps.

    Raises:
        RenderError: The images cannot be used, or the checkpoint is of another training.
    """
    progress = progress or _ignore
    device = device or preferred_device()
    rendered = pairs_of(
        recording, cameras, device=device, progress=lambda share: progress("simulation's images", share, "")
    )
    training = RenderTraining(
        rendered, cfg or RenderTrainCfg(), folder, device=str(wp.device_to_torch(wp.get_device(device)))
    )
    if resume and (folder / CHECKPOINT).exists():
        training.resume()
    if started is not None:
        started()
    names = list(training.trainings)

    def report(name: str, loss: float) -> None:
        done = sum(one.done for one in training.trainings.values())
        text = f"{name} ({names.index(name) + 1} of {len(names)}), loss {loss:.4f}"
        progress("training", done / training.steps, text)

    training.learn(report)
    return training


def _ignore(_: str, __: float, ___: str) -> None:
    """Do nothing."""
