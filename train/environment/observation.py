"""Observation of the policy (paper, table of appendix C): robot and objects, then contact slots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from concent_warp.kernels.contact_pairs import SLOT_SIZE
from concent_warp.train.environment.quaternions import rotation_columns
from concent_warp.train.observation_cfg import ObservationCfg
from concent_warp.train.task.task import Task


@dataclass(frozen=True)
class ObservationLayout:
    """Names and widths of the parts of the observation, in order."""

    parts: tuple[tuple[str, int], ...]

    @staticmethod
    def of(task: Task, cfg: ObservationCfg) -> ObservationLayout:
        """Return the layout of a task.

        For the shape sorter with the embedded arm: 148 numbers as in the paper, and the 7 leads of the commands.
        """
        robot = task.robot
        hinges = int(robot.turning.sum())
        parts = [("joint angles", 2 * hinges)] if hinges else []
        if hinges < len(robot.joint):
            parts.append(("joint positions", len(robot.joint) - hinges))
        parts.append(("joint velocities", len(robot.joint)))
        if cfg.leads:
            parts.append(("command leads", len(robot.joint)))
        if len(robot.gripper):
            parts += [("gripper opening", 1), ("gripper command", 1)]
        parts.append(("end effector", 3))
        parts += [(f"object {i + 1}", 9) for i in range(len(task.objects))]
        parts += [(f"slot {i}", SLOT_SIZE) for i in range(task.table.used.shape[1])]
        return ObservationLayout(tuple(parts))

    @property
    def size(self) -> int:
        """Length of the observation."""
        return sum(width for _, width in self.parts)

    @property
    def base(self) -> int:
        """Length of the parts before the slots."""
        return sum(width for name, width in self.parts if not name.startswith("slot "))

    def columns(self, part: str) -> slice:
        """Return the columns of a part.

        Raises:
            KeyError: The observation has no such part.
        """
        start = 0
        for name, width in self.parts:
            if name == part:
                return slice(start, start + width)
            start += width
        raise KeyError(part)


class ObservedState(Protocol):
    """What is observed: the true worlds, or an estimate of them; shapes as in `Physics`."""

    qpos: torch.Tensor
    qvel: torch.Tensor
    position: torch.Tensor
    quaternion: torch.Tensor
    site: torch.Tensor

    @property
    def ctrl(self) -> torch.Tensor: ...  # noqa: D102


class BaseObservation:
    """Computes the parts of the observation that describe robot and objects."""

    def __init__(self, task: Task, device: str, cfg: ObservationCfg) -> None:
        """Store indices into the state."""
        robot = task.robot

        def index(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.long, device=device)

        self._hinges, self._slides = index(robot.qpos[robot.turning]), index(robot.qpos[~robot.turning])
        self._dofs, self._arm, self._actuators = index(robot.dof), index(robot.qpos), index(robot.actuator)
        self._gripper = index(robot.gripper)
        self._opening = torch.as_tensor(robot.opening, dtype=torch.float32, device=device)
        self._lead = torch.as_tensor(robot.lead, dtype=torch.float32, device=device) if cfg.leads else None
        self._hold = torch.as_tensor(robot.hold, dtype=torch.float32, device=device)
        self._tool = robot.tool
        self._objects = index(list(task.objects))

    def read(self, state: ObservedState) -> torch.Tensor:
        """Return the parts before the slots, shape (N, base)."""
        qpos, ctrl = state.qpos.float(), state.ctrl
        turned = qpos[:, self._hinges]
        parts = [turned.sin(), turned.cos(), qpos[:, self._slides], state.qvel[:, self._dofs].float()]
        if self._lead is not None:
            parts.append((ctrl[:, self._actuators] - qpos[:, self._arm] - self._hold) / self._lead)
        if len(self._gripper):
            parts += [
                (qpos * self._opening).sum(dim=1, keepdim=True),
                ctrl[:, self._gripper].mean(dim=1, keepdim=True),
            ]
        objects = torch.cat(
            [state.position[:, self._objects], rotation_columns(state.quaternion[:, self._objects])], dim=-1
        )
        return torch.cat([*parts, state.site[:, self._tool], objects.flatten(1)], dim=1)
