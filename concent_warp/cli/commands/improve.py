"""``concent improve``: rounds of explaining failed trials, mending their cause, and training on."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape

from concent_warp.cli.options import DeviceOption, OptionalOutPath
from concent_warp.cli.terminal import progress_bar, quiet_warp, say, say_written
from concent_warp.deploy.improve.cfg import ImproveCfg, ImproveWorld
from concent_warp.errors import TrainError
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import check_folder, command_line

if TYPE_CHECKING:
    from concent_warp.deploy.improve.rounds import Improved
    from concent_warp.recording.recording import Recording
    from concent_warp.train.policy.load import Policy


@dataclass(frozen=True)
class Arguments:
    """Improve a policy by rounds: explain its failed trials, add the effect that the model lacks or mend what else
    failed, fit, train on from the policy, try it again. The same command continues where it stopped.
    """

    recording: tyro.conf.Positional[Path]
    """Recording of the demonstration that the policy was trained from."""
    policy: str | None = None
    """Run folder of a training, or the name of a pretrained policy; by default runs/train_<name of the recording>."""
    trials: Path | None = None
    """Folder of recordings of trials: those of round 1 in it, of later rounds in round_2 and so on. With --world
    reality trials that are not given are made."""
    world: ImproveWorld = "robot"
    """Where policies are tried: on a robot, where it stops after each training until there are trials of the new
    policy, or in Reality."""
    out: OptionalOutPath = None
    """Folder of the rounds; by default runs/improve_<name of the recording>. It gets a page, improve.html."""
    json: bool = False
    """Print one JSON object, docs/improve.md, and nothing else."""
    overwrite: bool = False
    """Start anew: rounds that are there are removed."""
    device: DeviceOption = None
    cfg: Annotated[ImproveCfg, tyro.conf.arg(name="")] = field(default_factory=ImproveCfg)


def run(arguments: Arguments) -> Improved:
    """Improve, and print what was found and done."""
    folder = arguments.out or Path("runs") / f"improve_{arguments.recording.stem}"
    check_folder(folder)
    recording = load_recording(arguments.recording)
    quiet_warp()
    from concent_warp.train.policy.load import load_policy

    default = Path("runs") / f"train_{arguments.recording.stem}"
    if arguments.policy is None and not default.exists():
        raise TrainError("no policy is given, and the default is not there", where=default, fix="name it with --policy")
    policy = load_policy(default if arguments.policy is None else arguments.policy)
    found = _improved(arguments, policy, recording, folder)
    if arguments.json:
        print(json.dumps(found.to_json(), indent=1, allow_nan=False))
        return found
    for sentence in found.sentences():
        say(escape(sentence))
    if found.advice:
        say("\n[bold]What to do next[/bold]")
    for line in found.advice:
        say(escape(line))
    from concent_warp.deploy.improve.rounds import PAGE_FILE

    say_written(folder / PAGE_FILE)
    return found


def _improved(arguments: Arguments, policy: Policy, recording: Recording, folder: Path) -> Improved:
    """Return the rounds; an interruption says how to continue."""
    from concent_warp.deploy.improve.improve import improve

    try:
        with progress_bar("improving") as progress:
            return improve(
                policy,
                recording,
                arguments.cfg,
                trials=arguments.trials,
                world=arguments.world,
                device=arguments.device,
                out=folder,
                overwrite=arguments.overwrite,
                progress=progress,
            )
    except KeyboardInterrupt:
        command = command_line().replace(" --overwrite", "")
        raise KeyboardInterrupt(f"Finished steps are kept; continue with: {command}") from None
