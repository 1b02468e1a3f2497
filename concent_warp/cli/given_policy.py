"""The policy that a command is to run: that of a run folder, or one that comes with the package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.constructors import PrimitiveConstructorSpec

from concent_warp.cli.terminal import quiet_warp
from concent_warp.errors import TrainError
from concent_warp.run_folder import TRAIN_SETTINGS, check_training
from concent_warp.train.distil.cfg import holds_student

if TYPE_CHECKING:
    from concent_warp.train.distil.student import Student
    from concent_warp.train.flow.policy import FlowPolicy
    from concent_warp.train.policy.load import Policy

DEFAULT = "shape_sorter"
"""The policy that ``--pretrained`` without a name means."""


def _named(arguments: list[str]) -> str:
    """Return the name among at most one argument."""
    if len(arguments) > 1:
        raise ValueError("at most one name")
    return arguments[0] if arguments else DEFAULT


Pretrained = Annotated[
    str | None,
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME]",
        instance_from_str=_named,
        is_instance=lambda value: value is None or isinstance(value, str),
        str_from_instance=lambda value: [] if value is None else [value],
    ),
]
"""The name of a policy that comes with the package; the option alone means the default one."""


def check_policy(checkpoint: Path | None, pretrained: str | None) -> None:
    """Check that there is the policy that was asked for, before torch is imported.

    Raises:
        TrainError: Neither or both are given, or there is no such policy, folder or file.
    """
    if (checkpoint is None) == (pretrained is None):
        raise TrainError(
            "one policy is to be run",
            expected="either --checkpoint with a run folder or --pretrained",
            found="neither" if checkpoint is None else "both",
        )
    if checkpoint is not None:
        if holds_student(checkpoint):
            fix = "name the run folder of a policy; students are for concent evaluate and concent export"
            raise TrainError("this is a student, which acts by images", where=checkpoint, fix=fix)
        check_training(checkpoint)
    if pretrained is not None:
        from concent_warp.train.policy.pretrained import pretrained_checkpoint

        pretrained_checkpoint(pretrained)


def given_policy_or_student(checkpoint: Path | None, pretrained: str | None) -> Policy | Student:
    """Return the policy that was asked for, or the student where the run folder is one of `concent distil`.

    Raises:
        TrainError: Neither or both are given, or there is no such policy, student, folder or file.
    """
    if checkpoint is None or pretrained is not None or not holds_student(checkpoint):
        return given_policy(checkpoint, pretrained)
    quiet_warp()
    from concent_warp.train.distil.student import Student

    return Student.load(checkpoint)


def given_policy(checkpoint: Path | None, pretrained: str | None) -> Policy:
    """Return the policy that was asked for.

    Args:
        checkpoint: Run folder, or a checkpoint file in one.
        pretrained: Name of a policy that comes with the package.

    Raises:
        TrainError: Neither or both are given, or there is no such policy, folder or file.
    """
    check_policy(checkpoint, pretrained)
    quiet_warp()
    from concent_warp.train.policy.load import Policy
    from concent_warp.train.policy.pretrained import pretrained_checkpoint

    return Policy.load(pretrained_checkpoint(pretrained) if pretrained is not None else checkpoint or Path())


def check_driver(folder: Path) -> None:
    """Check that a folder holds a policy that can drive, before torch is imported.

    Raises:
        TrainError: It holds neither the run of concent train nor that of concent train-flow.
    """
    if not folder.exists():
        expected = "a run folder of concent train or concent train-flow"
        raise TrainError("no such policy", where=folder, expected=expected)
    if _is_of_train(folder):
        check_training(folder)


def given_driver(folder: Path, device: str | None) -> Policy | FlowPolicy:
    """Return the policy of a folder: one that observes the state, or a flow policy, which sees.

    Args:
        folder: Run folder, or a file in one.
        device: Torch's name of the device of a flow policy; the first CUDA device by default where there is one.

    Raises:
        TrainError: There is no policy.
    """
    check_driver(folder)
    quiet_warp()
    if _is_of_train(folder):
        return given_policy(folder, None)
    import torch

    from concent_warp.train.flow.policy import FlowPolicy

    return FlowPolicy.load(folder, device=device or ("cuda:0" if torch.cuda.is_available() else "cpu"))


def _is_of_train(folder: Path) -> bool:
    """Return whether a run folder, or that of a file, is one of concent train."""
    return ((folder if folder.is_dir() else folder.parent) / TRAIN_SETTINGS).is_file()
