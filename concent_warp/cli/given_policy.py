"""Which policy a command is to run: of a run folder, or one that comes with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.constructors import PrimitiveConstructorSpec

from concent_warp.train.cfg import TrainError

DEFAULT = "shape_sorter"
"""The policy that is meant where no name is given."""


def named(arguments: list[str]) -> str:
    """Return the name among at most one argument."""
    if len(arguments) > 1:
        raise ValueError("at most one name")
    return arguments[0] if arguments else DEFAULT


Pretrained = Annotated[
    str | None,
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME]",
        instance_from_str=named,
        is_instance=lambda value: value is None or isinstance(value, str),
        str_from_instance=lambda value: [] if value is None else [value],
    ),
]
"""The name of a policy that comes with the package; the option alone means the default one."""


def given_checkpoint(checkpoint: Path | None, pretrained: str | None) -> Path:
    """Return the checkpoint file of the policy that was asked for.

    Args:
        checkpoint: Run folder, or a checkpoint file in one.
        pretrained: Name of a policy that comes with the package.

    Raises:
        TrainError: Neither or both are given, or there is no such policy, folder or file.
    """
    from concent_warp.train.learning.ppo import CHECKPOINT
    from concent_warp.train.policy.pretrained import shipped

    if (checkpoint is None) == (pretrained is None):
        raise TrainError(
            "one policy is to be run",
            expected="either --checkpoint with a run folder or --pretrained",
            found="neither" if checkpoint is None else "both",
        )
    if checkpoint is None:
        assert pretrained is not None
        return shipped(pretrained)
    if not checkpoint.exists():
        raise TrainError("no such training", where=checkpoint, expected="its run folder, or a checkpoint file in one")
    return checkpoint / CHECKPOINT if checkpoint.is_dir() else checkpoint
