"""``concent export``: a trained policy as ONNX or TorchScript, or as one that comes with the package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from concent_warp.cli.given_policy import Pretrained, check_policy, given_policy
from concent_warp.cli.options import OptionalOutPath
from concent_warp.cli.terminal import say, say_written
from concent_warp.run_folder import check_folder, claim_file, make_folder


@dataclass(frozen=True)
class Arguments:
    """Write a policy, without exploration, as ONNX or TorchScript.

    Names, order and units of observation and action, scales, limits and the control period are in its metadata.
    With --as-pretrained, write a run folder reduced to what running the policy takes.
    """

    checkpoint: Path | None = None
    """Run folder of a training, or its checkpoint file."""
    pretrained: Pretrained = None
    """Export a policy that comes with the package, shape_sorter where no name is given."""
    out: OptionalOutPath = None
    """File to write: .onnx for ONNX, .pt for TorchScript; policy.onnx by default. With --as-pretrained a folder."""
    as_pretrained: bool = False
    """Write a folder as they are for --pretrained."""
    overwrite: bool = False
    """Replace existing files."""


def run(arguments: Arguments) -> dict[str, Any]:
    """Export and return the metadata."""
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
    policy = given_policy(arguments.checkpoint, arguments.pretrained)
    make_folder(out.parent)
    described = policy.export(out)
    observations, actions = described["observation"]["size"], described["action"]["size"]
    say(f"{observations} observations to {actions} actions every {1e3 * described['control period']:g} ms")
    say_written(out)
    return described
