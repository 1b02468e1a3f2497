"""What the robot knows of itself: the parts of a policy's observation that say nothing of the objects."""

from __future__ import annotations

import torch

from concent_warp.errors import TrainError
from concent_warp.train.environment.observation import ObservationLayout

OWN = (
    "joint angles", "joint positions", "joint velocities", "command leads", "gripper opening", "gripper command",
    "end effector",
)  # fmt: skip
"""Parts of an observation that the student has."""
OBJECT = "object "
"""Begins the names of the parts that describe objects."""


class Proprioception:
    """Columns of an observation that the student has, and those of the objects' poses, which it learns to predict."""

    def __init__(self, layout: ObservationLayout) -> None:
        """Find the columns.

        Raises:
            TrainError: The observation has a part of the robot after those of the objects.
        """
        self.parts = tuple((name, width) for name, width in layout.parts if name in OWN)
        """Names and widths of the student's parts, in order."""
        self.size = sum(width for _, width in self.parts)
        """Number of columns P."""
        if layout.parts[: len(self.parts)] != self.parts:
            raise TrainError("the teacher's observation has the robot's state behind the objects'", found=layout.parts)
        objects = [layout.columns(name) for name, _ in layout.parts if name.startswith(OBJECT)]
        self.objects = len(objects)
        """Number of objects."""
        self._objects = objects
        self._tool = layout.columns("end effector")

    def read(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the student's columns, shape (N, P), of observations (N, O)."""
        return observation[:, : self.size]

    def poses(self, truth: torch.Tensor) -> torch.Tensor:
        """Return positions relative to the end effector [m] and two columns of rotations, shape (N, 9 objects).

        Args:
            truth: Observations without sensor errors, shape (N, O).
        """
        tool = truth[:, self._tool]
        parts = []
        for columns in self._objects:
            pose = truth[:, columns]
            parts += [pose[:, :3] - tool, pose[:, 3:]]
        return torch.cat(parts, dim=1)
