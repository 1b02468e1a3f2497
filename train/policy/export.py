"""Export of a policy as ONNX or TorchScript, with everything needed to run it in the metadata."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import warnings
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from concent_warp.checkpoint_file import check_state
from concent_warp.errors import TrainError
from concent_warp.files import write_bytes
from concent_warp.kernels.contact_pairs import DIRECTION, DISPLACEMENT, MASK, NORMAL, POINT
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.environment.observation import ObservationLayout
from concent_warp.train.learning.normalisation import bound_observations
from concent_warp.train.learning.ppo import network_settings
from concent_warp.train.run import TrainingRun
from concent_warp.train.task.task import Task

FORMAT, VERSION = "concent-policy", 1
METADATA = "concent"
"""Key of the metadata in ONNX; in TorchScript it is the extra file of this name with ``.json``."""
INPUT, OUTPUT = "observation", "action"
OPSET = 18
COMMAND_UNIT = "that of its ctrlrange"
"""Unit of the command of a gripper that is no length, such as suction."""
MEANING = {
    True: "above 0 raises their commands and opens, below 0 closes",
    False: "above 0 raises their commands, below 0 lowers them",
}
"""Meaning of the gripper's action, by whether its command is a length."""
PACKAGES = ("concent-warp", "torch", "onnx", "rsl-rl-lib", "mujoco", "mujoco-warp")
SUFFIXES = (".onnx", ".pt")


def export(run: TrainingRun, weights: Mapping[str, Any], out: Path) -> dict[str, Any]:
    """Write a deterministic policy, and return its metadata.

    Args:
        run: Inputs of the policy's training.
        weights: Checkpoint of the policy.
        out: File to write: ``.onnx`` for ONNX, ``.pt`` for TorchScript.

    Raises:
        TrainError: The file has another suffix.
    """
    check_suffix(out)
    task = run.task()
    described = describe(run.cfg, task) | {"iterations": weights["iteration"], "steps": weights["steps"]}
    module = _policy_module(run.cfg, described["observation"]["size"], task.robot.actions, weights["actor_state_dict"])
    write_module(module, {INPUT: torch.zeros(2, described["observation"]["size"])}, described, out)
    return described


def check_suffix(out: Path) -> None:
    """Check that a file's suffix names a format.

    Raises:
        TrainError: It names none.
    """
    if out.suffix not in SUFFIXES:
        raise TrainError("the export format is unknown", where=out, expected=f"a name in {' or '.join(SUFFIXES)}")


def write_module(module: nn.Module, example: Mapping[str, torch.Tensor], described: dict[str, Any], out: Path) -> None:
    """Write a module from inputs to actions, for batches of any size, in the format of the file's suffix.

    Args:
        module: The module.
        example: An input of two worlds for each argument, by its name.
        described: Metadata.
        out: The file.

    Raises:
        TrainError: The module cannot be exported.
    """
    to_bytes = _onnx if out.suffix == ".onnx" else _torchscript
    write_bytes(out, to_bytes(module, example, described))


def _policy_module(cfg: TrainCfg, observations: int, actions: int, weights: Mapping[str, Any]) -> nn.Module:
    """Return the policy as a module from observations (N, O), as the environment gives them, to actions (N, A)."""
    example = TensorDict({"policy": torch.zeros(1, observations)}, batch_size=[1])
    settings = network_settings(cfg.ppo, actor=True)
    del settings["class_name"]
    actor = MLPModel(example, {"actor": ["policy"]}, "actor", actions, **settings)
    bound_observations(actor, cfg.ppo.max_observation)
    check_state(weights, actor.state_dict(), "the checkpoint's network", where=None, error=TrainError)
    actor.load_state_dict(weights)
    return actor.as_jit().eval()


def _onnx(module: nn.Module, example: Mapping[str, torch.Tensor], described: dict[str, Any]) -> bytes:
    """Return a policy as ONNX, with the weights inside, for batches of any size."""
    import onnx

    quiet = contextlib.redirect_stdout(io.StringIO())  # the exporter prints and logs
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with quiet, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                module, tuple(example.values()), input_names=list(example), output_names=[OUTPUT],
                opset_version=OPSET, dynamo=True, verbose=False,
                dynamic_shapes=tuple({0: torch.export.Dim("worlds")} for _ in example),
            )  # fmt: skip
    except torch.onnx.OnnxExporterError as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        found = " ".join(str(cause).split())[:200]
        raise TrainError("the policy cannot be exported as ONNX", found=found) from None
    finally:
        logging.disable(level)
    assert program is not None
    model = program.model_proto
    onnx.helper.set_model_props(model, {METADATA: json.dumps(described)})
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _torchscript(module: nn.Module, example: Mapping[str, torch.Tensor], described: dict[str, Any]) -> bytes:
    """Return a policy as TorchScript."""
    content = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        traced = torch.jit.trace(module, tuple(example.values()))
        torch.jit.save(traced, content, _extra_files={f"{METADATA}.json": json.dumps(described)})
    return content.getvalue()


def describe(cfg: TrainCfg, task: Task) -> dict[str, Any]:
    """Return the metadata of a task's policy as plain data, in m, rad and s."""
    dt = task.replay.timestep
    return {
        "format": FORMAT,
        "version": VERSION,
        "stages": [task.events.stages[s].name for s in task.chained],
        "moving on": _described_chain(cfg, task),
        "control period": cfg.environment.decimation * dt,
        "decimation": cfg.environment.decimation,
        "simulation step": dt,
        "episode": cfg.environment.seconds,
        "observation": _described_observation(cfg, task),
        "action": _described_action(task),
        "gripper": _described_gripper(task),
        "versions": {name: version(name) for name in PACKAGES},
    }


def _described_observation(cfg: TrainCfg, task: Task) -> dict[str, Any]:
    """Return names, order and meaning of the parts of the observation."""
    m, robot = task.compiled, task.robot
    unit = "m" if robot.in_metres else COMMAND_UNIT
    joints = [m.joint(j).name for j in robot.joint]
    hinges = [name for name, turning in zip(joints, robot.turning, strict=True) if turning]
    slides = [name for name, turning in zip(joints, robot.turning, strict=True) if not turning]
    meaning: dict[str, tuple[str, list[str]]] = {
        "joint angles": ("sines of all angles, then their cosines", hinges),
        "joint positions": ("positions [m]", slides),
        "joint velocities": ("velocities [rad/s or m/s]", joints),
        "command leads": ("command minus joint position minus hold, relative to lead", joints),
        "gripper opening": ("opening as measured, see gripper", []),
        "gripper command": (f"mean command of the gripper's actuators [{unit}]", []),
        "end effector": ("position [m], world frame", [m.site(robot.tool).name]),
    }
    for i, body in enumerate(task.objects):
        what = "position [m], world frame, then the first two columns of the rotation matrix"
        meaning[f"object {i + 1}"] = (what, [m.body(body).name])
    layout, history = ObservationLayout.of(task, cfg.environment.observation), cfg.environment.observation.history
    parts = []
    for name, width in layout.parts:
        what, of = meaning.get(name, ("a contact slot, see slots", []))
        parts.append({"name": name, "start": layout.columns(name).start, "size": width, "meaning": what, "of": of})
    return {
        "input": INPUT,
        "size": layout.size * history,
        "history": f"{history} observations of {layout.size} numbers each, the present one first; at the start of an "
        "episode the first in place of earlier ones",
        "parts": parts,
        "normalisation": "within the policy: pass values unnormalised" if cfg.ppo.normalise else "none",
        "slots": _described_slots(task),
    }


def _described_chain(cfg: TrainCfg, task: Task) -> dict[str, Any] | None:
    """Return the rule by which the slots advance to the next stage, None for a single stage."""
    if len(task.chained) == 1:
        return None
    chain = cfg.environment.chain
    return {
        "tolerance": chain.tolerance,
        "hold": chain.hold,
        "meaning": "the slots show the first stage at the start, and the next one as soon as all displacements of the "
        "stage have been shorter than tolerance [m] for hold consecutive control periods",
    }


def _described_slots(task: Task) -> dict[str, Any]:
    """Return the contact pair of each slot in each stage."""
    table, m = task.table, task.compiled
    pairs = []
    for s, k in ((stage, slot) for stage in task.chained for slot in np.flatnonzero(table.used[stage])):
        pairs.append(
            {
                "stage": task.events.stages[s].name,
                "slot": int(k),
                "body": m.body(table.body_a[s, k]).name,
                "point": table.point_a[s, k].tolist(),
                "target body": m.body(table.body_b[s, k]).name,
                "target point": table.point_b[s, k].tolist(),
                "target normal": table.normal[s, k].tolist(),
            }
        )
    return {
        "columns": {
            "mask": MASK, "point": POINT, "displacement": DISPLACEMENT, "direction": DIRECTION, "normal": NORMAL,
        },
        "meaning": "mask 1; point of the body, displacement from it to the target point, its direction, target normal: "
        "world frame [m]; slots that are not listed for the stage are all zero",
        "frames": "points and normals as listed are in the frames of their bodies",
        "pairs": pairs,
    }  # fmt: skip


def _described_action(task: Task) -> dict[str, Any]:
    """Return the meaning of the parts of the action."""
    m, robot = task.compiled, task.robot
    rows = []
    for i, (actuator, joint) in enumerate(zip(robot.actuator, robot.joint, strict=True)):
        row = {"name": m.actuator(actuator).name, "joint": m.joint(joint).name}
        row |= {"unit": "rad" if robot.turning[i] else "m", "scale": float(robot.step[i])}
        row |= {"limits": _limits(task, int(actuator)), "hold": float(robot.hold[i]), "lead": float(robot.lead[i])}
        rows.append(row)
    if len(robot.gripper):
        names = [m.actuator(a).name for a in robot.gripper]
        unit = "m" if robot.in_metres else COMMAND_UNIT
        row = {"name": "gripper", "actuators": names, "unit": unit, "scale": float(robot.step[-1])}
        rows.append(row | {"limits": _limits(task, int(robot.gripper[0])), "lead": None})
    return {
        "output": OUTPUT,
        "size": robot.actions,
        "range": [-1.0, 1.0],
        "meaning": "once a control period: command += scale * action; then, where there is a lead, the command minus "
        "hold is kept within lead of the joint's measured position; then it is kept within limits; it is constant "
        "until the next. Start from a command that holds the robot",
        "parts": rows,
    }


def _limits(task: Task, actuator: int) -> list[float] | None:
    """Return the smallest and largest command of an actuator, None without limits."""
    m = task.compiled
    return [float(v) for v in m.actuator_ctrlrange[actuator]] if m.actuator_ctrllimited[actuator] else None


def _described_gripper(task: Task) -> dict[str, Any] | None:
    """Return the meaning of the gripper's action and opening, None without a gripper."""
    m, robot = task.compiled, task.robot
    if not len(robot.gripper):
        return None
    weights = {}
    for j in range(m.njnt):
        weight = float(robot.opening[m.jnt_qposadr[j]])
        if weight:
            weights[m.joint(j).name] = weight
    return {
        "actuators": [m.actuator(a).name for a in robot.gripper],
        "opening": f"sum of weight times joint position [{'m' if robot.in_metres else 'm or rad'}]",
        "weights": weights,
        "convention": f"one number for all actuators: {MEANING[robot.in_metres]}",
    }
