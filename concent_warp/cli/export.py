"""``concent export``: a trained policy as ONNX or TorchScript."""

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
    """

    run: tyro.conf.Positional[Path]
    """Run folder of a training, or its checkpoint file."""
    out: Path = Path("policy.onnx")
    """File to write: .onnx for ONNX, .pt for TorchScript."""
    overwrite: bool = False
    """Replace the file if it is there."""


def run(arguments: Arguments) -> dict[str, Any]:
    """Export and return the metadata."""
    quiet_warp()
    from concent_warp.train.export import export
    from concent_warp.train.ppo import CHECKPOINT

    claim_file(arguments.out, overwrite=arguments.overwrite)
    path = arguments.run / CHECKPOINT if arguments.run.is_dir() else arguments.run
    make_folder(arguments.out.parent)
    described = export(path, arguments.out)
    observations, actions = described["observation"]["size"], described["action"]["size"]
    say(f"{observations} observations to {actions} actions every {1e3 * described['control period']:g} ms")
    say_written(arguments.out)
    return described
