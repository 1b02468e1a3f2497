"""``concent export``: a trained policy as ONNX or TorchScript, or as one that comes with the package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from concent_warp.cli.run_folder import claim_file, make_folder
from concent_warp.cli.terminal import quiet_warp, say, say_written


@dataclass(frozen=True)
class Arguments:
    """Write the policy of a training, without exploration, as ONNX or TorchScript.

    Names, order and units of observation and action, scales, limits and the control period are in its metadata.
    With --as-pretrained, write a run folder reduced to what running the policy takes.
    """

    run: tyro.conf.Positional[Path]
    """Run folder of a training, or its checkpoint file."""
    out: Path | None = None
    """File to write: .onnx for ONNX, which is the default, .pt for TorchScript; with --as-pretrained a folder."""
    as_pretrained: bool = False
    """Write a folder as they are for --pretrained."""
    overwrite: bool = False
    """Replace what is there."""


def run(arguments: Arguments) -> dict[str, Any]:
    """Export and return the metadata."""
    quiet_warp()
    from concent_warp.train.learning.ppo import CHECKPOINT
    from concent_warp.train.policy.export import export
    from concent_warp.train.policy.pretrained import ship

    path = arguments.run / CHECKPOINT if arguments.run.is_dir() else arguments.run
    if arguments.as_pretrained:
        folder = Path("pretrained") if arguments.out is None else arguments.out
        make_folder(folder.parent)
        origin = ship(path, folder, overwrite=arguments.overwrite)
        size = sum(file.stat().st_size for file in folder.iterdir())
        say(f"policy of {origin['steps']:,} steps with all it takes to run it, {size / 1e3:,.0f} kB")
        say_written(folder)
        return origin
    out = Path("policy.onnx") if arguments.out is None else arguments.out
    claim_file(out, overwrite=arguments.overwrite)
    make_folder(out.parent)
    described = export(path, out)
    observations, actions = described["observation"]["size"], described["action"]["size"]
    say(f"{observations} observations to {actions} actions every {1e3 * described['control period']:g} ms")
    say_written(out)
    return described
