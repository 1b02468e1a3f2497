"""``concent export``: a trained policy as ONNX or TorchScript, or a recording as a LeRobot data set."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from concent_warp.cli.given_policy import Pretrained, check_policy, given_policy, given_policy_or_student
from concent_warp.cli.options import OptionalOutPath
from concent_warp.cli.terminal import progress_bar, say, say_written
from concent_warp.errors import RenderError, TrainError
from concent_warp.recording.load import load_recording
from concent_warp.render.dataset.from_recording import WriteLeRobotCfg, write_lerobot
from concent_warp.run_folder import check_folder, claim_file, make_folder
from concent_warp.train.distil.cfg import holds_student
from concent_warp.train.flow.cfg import holds_flow_policy


@dataclass(frozen=True)
class Arguments:
    """Write a policy, without exploration, as ONNX or TorchScript, or a recording as a LeRobot v3 data set.

    Names, order and units of observation and action, scales, limits and the control period are in its metadata.
    With --as-pretrained, write a run folder reduced to what running the policy takes. A data set has tracked poses as
    features, and calibration.json, scene.xml and map.toml beside it, by which concent import reads it back.
    """

    checkpoint: Path | None = None
    """Run folder of a training, of a student that sees or of a flow policy, or its checkpoint file."""
    pretrained: Pretrained = None
    """Export a policy that comes with the package, shape_sorter where no name is given."""
    recording: Path | None = None
    """Write this recording as a LeRobot data set instead."""
    out: OptionalOutPath = None
    """File to write: .onnx for ONNX, .pt for TorchScript; policy.onnx by default. With --as-pretrained and --recording
    a folder; lerobot by default for a recording."""
    as_pretrained: bool = False
    """Write a folder as they are for --pretrained."""
    overwrite: bool = False
    """Replace existing files."""
    lerobot: WriteLeRobotCfg = field(default_factory=WriteLeRobotCfg)


def run(arguments: Arguments) -> dict[str, Any]:
    """Export and return the metadata."""
    if arguments.recording is not None:
        return _data_set(arguments, arguments.recording)
    if arguments.checkpoint is not None and not arguments.as_pretrained and holds_flow_policy(arguments.checkpoint):
        return _flow_policy(arguments, arguments.checkpoint)
    student = arguments.checkpoint is not None and holds_student(arguments.checkpoint)
    if arguments.as_pretrained or not student:
        check_policy(arguments.checkpoint, arguments.pretrained)
    if arguments.as_pretrained:
        folder = Path("pretrained") if arguments.out is None else arguments.out
        check_folder(folder)
        policy = given_policy(arguments.checkpoint, arguments.pretrained)
        from concent_warp.train.policy.write_pretrained import write_pretrained

        make_folder(folder.parent)
        origin = write_pretrained(policy, folder, overwrite=arguments.overwrite)
        size = sum(file.stat().st_size for file in folder.iterdir())
        say(f"policy of {origin['steps']:,} steps with all it takes to run it, {size / 1e3:,.0f} kB")
        say_written(folder)
        return origin
    out = Path("policy.onnx") if arguments.out is None else arguments.out
    claim_file(out, overwrite=arguments.overwrite)
    policy = given_policy_or_student(arguments.checkpoint, arguments.pretrained)
    make_folder(out.parent)
    described = policy.export(out)
    observations, actions = described["observation"]["size"], described["action"]["size"]
    seen = f"images of {len(described['images']['cameras'])} cameras and " if "images" in described else ""
    say(f"{seen}{observations} observations to {actions} actions every {1e3 * described['control period']:g} ms")
    say_written(out)
    return described


def _flow_policy(arguments: Arguments, checkpoint: Path) -> dict[str, Any]:
    """Write a flow policy as ONNX and return its metadata.

    Raises:
        TrainError: Another policy is given as well, or the file has another suffix.
    """
    if arguments.pretrained is not None:
        raise TrainError("one policy is to be exported", expected="--checkpoint or --pretrained", found="both")
    out = Path("policy.onnx") if arguments.out is None else arguments.out
    claim_file(out, overwrite=arguments.overwrite)
    from concent_warp.train.flow.policy import load_flow_policy

    policy = load_flow_policy(checkpoint)
    make_folder(out.parent)
    described = policy.export(out)
    cameras, state, actions = (len(described[name]) for name in ("images", "proprioception", "action"))
    seen = f"images of {cameras} camera{'s' * (cameras != 1)}"
    say(f"{seen} and {state} numbers of state to {described['chunk']} times {actions} actions")
    say_written(out)
    return described


def _data_set(arguments: Arguments, path: Path) -> dict[str, Any]:
    """Write a recording as a data set.

    Raises:
        RenderError: A policy is given as well, or the folder is not empty.
    """
    if arguments.checkpoint is not None or arguments.pretrained is not None or arguments.as_pretrained:
        raise RenderError("one thing is to be exported", expected="either --recording or a policy")
    out = Path("lerobot") if arguments.out is None else arguments.out
    with progress_bar("writing") as progress:
        count = write_lerobot(load_recording(path), out, arguments.lerobot, progress=progress)
    say(f"the data set holds {count} episode{'s' * (count != 1)}")
    say_written(out)
    return {"episodes": count}
