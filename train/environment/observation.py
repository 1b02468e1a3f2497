"""Observation of the policy (paper, table of appendix C): robot and objects, then contact slots."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from concent_warp.kernels.contact_pairs import SLOT_SIZE
from concent_warp.train.environment.physics import Physics
from concent_warp.train.environment.quaternions import rotation_columns
from concent_warp.train.task.task import Task


@dataclass(frozen=True)
class ObservationLayout:
    """Names and widths of the parts of the observation, in order."""

    parts: tuple[tuple[str, int], ...]

    @staticmethod
    def of(task: Task) -> ObservationLayout:
        """Return the layout of a task; 148 numbers, as in the paper, for the shape sorter with the embedded arm."""
        robot = task.robot
        hinges = int(robot.turning.sum())
        parts = [("joint angles", 2 * hinges)] if hinges else []
        if hinges < len(robot.joint):
            parts.append(("joint positions", len(robot.joint) - hinges))
        parts.append(("joint velocities", len(robot.joint)))
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


class BaseObservation:
    """Computes the parts of the observation that describe robot and objects."""

    def __init__(self, task: Task, physics: Physics, noise: float) -> None:
        """Store indices into the state; `noise` is the standard deviation of noise on object positions [m]."""
        robot = task.robot

        def index(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.long, device=physics.device)

        self._physics, self._noise = physics, noise
        self._hinges, self._slides = index(robot.qpos[robot.turning]), index(robot.qpos[~robot.turning])
        self._dofs = index(robot.dof)
        self._gripper = index(robot.gripper)
        self._opening = torch.as_tensor(robot.opening, dtype=torch.float32, device=physics.device)
        self._tool = robot.tool
        self._objects = index(list(task.objects))

    def read(self) -> torch.Tensor:
        """Return the parts before the slots, shape (N, base)."""
        p = self._physics
        qpos = p.qpos.float()
        turned = qpos[:, self._hinges]
        parts = [turned.sin(), turned.cos(), qpos[:, self._slides], p.qvel[:, self._dofs].float()]
        if len(self._gripper):
            parts += [
                (qpos * self._opening).sum(dim=1, keepdim=True),
                p.ctrl[:, self._gripper].mean(dim=1, keepdim=True),
            ]
        place = p.position[:, self._objects]
        if self._noise:
            place = place + self._noise * torch.randn_like(place)
        objects = torch.cat([place, rotation_columns(p.quaternion[:, self._objects])], dim=-1)
        return torch.cat([*parts, p.site[:, self._tool], objects.flatten(1)], dim=1)
