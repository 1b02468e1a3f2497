"""``concent render-train``: networks that paint robot and background as a real camera sees them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from concent_warp.checks import Count
from concent_warp.cli.options import DeviceOption, OutPath
from concent_warp.cli.terminal import progress_bar, quiet_warp, say, say_written, status_bar
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
    import warp as wp

    from concent_warp.render.networks.pairs import pairs_of
    from concent_warp.render.networks.train import CHECKPOINT, RenderTraining
    from concent_warp.simulate.warp_engine import preferred_device

    device = arguments.device or preferred_device()
    cfg, folder = arguments.cfg(), arguments.out
    with run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume) as claimed:
        with progress_bar("simulation's images") as progress:
            pairs = pairs_of(recording, arguments.cameras, device=device, progress=progress)
        training = RenderTraining(pairs, cfg, claimed.path, device=str(wp.device_to_torch(wp.get_device(device))))
        if arguments.resume and (claimed.path / CHECKPOINT).exists():
            training.resume()
        write_settings(claimed.path, arguments)
        names = list(training.trainings)
        total = sum(one.cfg.steps for one in training.trainings.values())
        with status_bar("training") as update:

            def show(name: str, loss: float) -> None:
                done = sum(one.done for one in training.trainings.values())
                update(done / total, f"{name} ({names.index(name) + 1} of {len(names)}), loss {loss:.4f}", None)

            training.learn(show)
    frames = ", ".join(f"{one.camera.name} {len(one)}" for one in pairs)
    say(f"trained on frames: {frames}; {total} steps of {len(names)} networks")
    say_written(folder / CHECKPOINT)
    return training
