"""The policy that a command is to run: that of a run folder, or one that comes with the package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.constructors import PrimitiveConstructorSpec

from concent_warp.cli.terminal import quiet_warp
from concent_warp.errors import TrainError
from concent_warp.run_folder import check_training
from concent_warp.train.distil.cfg import holds_student
from concent_warp.train.flow.cfg import holds_flow_policy

if TYPE_CHECKING:
    from concent_warp.train.distil.student import Student
    from concent_warp.train.flow.policy import FlowPolicy
    from concent_warp.train.flow.task_policy import TaskFlowPolicy
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


def check_flow_policy(checkpoint: Path | None, task_of: str | None) -> bool:
    """Return whether a run folder is that of a flow policy, which needs a task, before torch is imported.

    Args:
        checkpoint: Run folder, or a file in one.
        task_of: Policy whose task it is.

    Raises:
        TrainError: A flow policy has no task, or something else has one.
    """
    flow = checkpoint is not None and holds_flow_policy(checkpoint)
    if flow and task_of is None:
        fix = "name the policy whose episodes it learned from with --task-of"
        raise TrainError("a flow policy needs a task", where=checkpoint, fix=fix)
    if task_of is not None and not flow:
        found = "none" if checkpoint is None else checkpoint
        raise TrainError("--task-of is for flow policies", expected="--checkpoint of concent train-flow", found=found)
    return flow


def given_flow_policy(checkpoint: Path, task_of: str, text: str | None, device: str | None) -> TaskFlowPolicy:
    """Return a flow policy in a task.

    Args:
        checkpoint: Its run folder, or a file in one.
        task_of: Run folder of the policy whose task it is, or the name of one that comes with the package.
        text: The instruction; that of the demonstration by default.
        device: Torch's name of the device; the first CUDA device by default where there is one.

    Raises:
        TrainError: There is no such policy.
    """
    quiet_warp()
    from concent_warp.train.flow.task_policy import TaskFlowPolicy
    from concent_warp.train.policy.load import load_policy

    teacher = load_policy(task_of)
    return TaskFlowPolicy(_flow_policy(checkpoint, device), teacher, text)


def check_driver(folder: Path) -> None:
    """Check that a folder holds a policy that can drive, before torch is imported.

    Raises:
        TrainError: It holds none.
    """
    if not folder.exists():
        expected = "a run folder of concent train, distil or train-flow"
        raise TrainError("no such policy", where=folder, expected=expected)
    if not holds_student(folder) and not holds_flow_policy(folder):
        check_training(folder)


def given_driver(folder: Path, device: str | None) -> Policy | Student | FlowPolicy:
    """Return the policy of a folder: one that observes the state, a student, or a flow policy.

    Args:
        folder: Run folder, or a file in one.
        device: Torch's name of the device of a flow policy; the first CUDA device by default where there is one.

    Raises:
        TrainError: There is no policy.
    """
    check_driver(folder)
    quiet_warp()
    return _flow_policy(folder, device) if holds_flow_policy(folder) else given_policy_or_student(folder, None)


def _flow_policy(folder: Path, device: str | None) -> FlowPolicy:
    """Return the flow policy of a run folder, on a device."""
    import torch

    from concent_warp.train.flow.policy import load_flow_policy

    return load_flow_policy(folder, device=device or ("cuda:0" if torch.cuda.is_available() else "cpu"))
