"""``concent render``: episodes of a policy, or a recording, as images that look like the real camera's."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from concent_warp.cli.given_policy import Pretrained, check_driver, check_policy, given_driver, given_policy
from concent_warp.cli.options import DeviceOption, OutPath
from concent_warp.cli.terminal import progress_bar, quiet_warp, say, say_written
from concent_warp.deploy.cfg import Format, RenderCfg
from concent_warp.errors import RenderError
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import check_run_folder, claim_file

if TYPE_CHECKING:
    from concent_warp.deploy.render_dataset import Dataset


@dataclass(frozen=True)
class Arguments:
    """Render episodes of a trained policy, or a recording, to a data set for vision-language-action policies.

    Without networks and splats the images are the simulation's. With networks (concent render-train), robot and
    background look as the real camera sees them; with splats (concent splat-fit, or any 3DGS model), so do the objects.
    Images, state and commands go to a LeRobotDataset v3.0 or to robomimic's HDF5.
    """

    checkpoint: Path | None = None
    """Run folder of a training, or its checkpoint file."""
    pretrained: Pretrained = None
    """Render a policy that comes with the package, shape_sorter where no name is given."""
    recording: Path | None = None
    """Render the measured motion of a recording instead of a policy."""
    handover: Path | None = None
    """Run folder of a policy that drives first: data of how to recover."""
    out: OutPath = Path("runs/dataset")
    """Folder of the data set."""
    format: Format = "lerobot"
    """LeRobotDataset v3.0, or one HDF5 file in robomimic's layout."""
    device: DeviceOption = None
    resume: bool = False
    """Continue an interrupted data set, or one with fewer episodes."""
    overwrite: bool = False
    """Replace a data set in the folder."""
    cfg: Annotated[RenderCfg, tyro.conf.arg(name="")] = field(default_factory=RenderCfg)


def run(arguments: Arguments) -> Dataset:
    """Render and write the data set."""
    if (arguments.recording is not None) == (arguments.checkpoint is not None or arguments.pretrained is not None):
        raise RenderError("one thing is to be rendered", expected="either --recording, or --checkpoint or --pretrained")
    if arguments.recording is None:
        check_policy(arguments.checkpoint, arguments.pretrained)
    if arguments.handover is not None:
        if arguments.recording is not None:
            raise RenderError("a recording is not driven", expected="--checkpoint or --pretrained with --handover")
        check_driver(arguments.handover)
    check_run_folder(arguments.out, overwrite=arguments.overwrite, resume=arguments.resume)
    if arguments.cfg.networks is not None and not arguments.cfg.networks.is_dir():
        raise RenderError(
            "there are no trained networks", where=arguments.cfg.networks, fix="train them with concent render-train"
        )
    if arguments.cfg.figure is not None:
        claim_file(arguments.cfg.figure, overwrite=arguments.overwrite or arguments.resume)
    if arguments.recording is not None:
        source = load_recording(arguments.recording)
        quiet_warp()
    else:
        source = given_policy(arguments.checkpoint, arguments.pretrained)
    driver = None if arguments.handover is None else given_driver(arguments.handover, arguments.device)
    from concent_warp.deploy.render_dataset import render

    with progress_bar("rendering") as progress:
        found = render(
            source,
            arguments.out,
            arguments.cfg,
            driver=driver,
            format=arguments.format,
            device=arguments.device,
            resume=arguments.resume,
            overwrite=arguments.overwrite,
            progress=progress,
        )
    if found.dropped:
        say(f"{found.dropped} episodes were no success and are left out")
    say(f"the data set holds {found.episodes} episode{'s' * (found.episodes != 1)}")
    say_written(found.folder)
    if arguments.cfg.figure is not None:
        if found.figure is None:
            say("no frame was rendered in this call, so there is no figure")
        else:
            say_written(found.figure)
    return found
