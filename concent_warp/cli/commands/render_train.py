"""``concent render-train``: networks that paint robot and background as a real camera sees them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from concent_warp.checks import Count
from concent_warp.cli.options import DeviceOption, OutPath
from concent_warp.cli.terminal import quiet_warp, say, say_written, status_bar
from concent_warp.recording.load import load_recording
from concent_warp.render.networks.cfg import RenderTrainCfg
from concent_warp.run_folder import check_run_folder, run_folder, write_settings

if TYPE_CHECKING:
    from concent_warp.render.networks.train import RenderTraining


@dataclass(frozen=True)
class Arguments:
    """Train networks that turn the simulation's image into what the real camera would see of robot and background.

    Needs a recording with images of the robot at work without objects, which are rendered by other means. Writes the
    networks and their state to a run folder, for concent render. Ctrl-C loses nothing.
    """

    recording: tyro.conf.Positional[Path]
    """Recording with images and measured joints, no objects on the table."""
    out: OutPath = Path("runs/render")
    """Run folder."""
    cameras: tuple[str, ...] = ()
    """Cameras to learn; all of the recording by default."""
    steps: Count | None = None
    """Steps of each network; short for --flow.steps and --enlarge.steps."""
    device: DeviceOption = None
    resume: bool = False
    """Continue an interrupted training; the result is the same as without the interruption."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    train: Annotated[RenderTrainCfg, tyro.conf.arg(name="")] = field(default_factory=RenderTrainCfg)

    def cfg(self) -> RenderTrainCfg:
        """Return the settings with the short form put in its places."""
        if self.steps is None:
            return self.train
        flow, enlarge = (replace(one, steps=self.steps) for one in (self.train.flow, self.train.enlarge))
        return replace(self.train, flow=flow, enlarge=enlarge)


def run(arguments: Arguments) -> RenderTraining:
    """Train and write the run folder."""
    check_run_folder(arguments.out, overwrite=arguments.overwrite, resume=arguments.resume)
    recording = load_recording(arguments.recording)
    quiet_warp()
    from concent_warp.render.networks.train import CHECKPOINT
    from concent_warp.render.networks.train_networks import train_networks

    folder = arguments.out
    with (
        run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume) as claimed,
        ExitStack() as bars,
    ):
        shown: dict[str, Callable[[float, str, float | None], None]] = {}

        def progress(work: str, share: float, text: str) -> None:
            if work not in shown:
                bars.close()
                shown[work] = bars.enter_context(status_bar(work))
            shown[work](share, text, None)

        training = train_networks(
            recording,
            claimed.path,
            arguments.cfg(),
            cameras=arguments.cameras,
            device=arguments.device,
            resume=arguments.resume,
            started=partial(write_settings, claimed.path, arguments),
            progress=progress,
        )
    frames = ", ".join(f"{one.camera.name} {len(one)}" for one in training.pairs)
    say(f"trained on frames: {frames}; {training.steps} steps of {len(training.trainings)} networks")
    say_written(folder / CHECKPOINT)
    return training
