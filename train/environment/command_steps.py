"""Absolute commands of actuators, as data sets have them, as actions of an environment, which are steps of commands."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from concent_warp.errors import TrainError
from concent_warp.train.environment.environment import Environment


class CommandSteps:
    """Turns commands of actuators to actions: each is the step from the present command to the wanted one."""

    def __init__(self, environment: Environment, names: Sequence[str]) -> None:
        """Find the actuators.

        Args:
            environment: The worlds.
            names: Names of the K actuators, in the order of the commands.

        Raises:
            TrainError: The task has no such actuator, or the robot has one that is not among them.
        """
        model, robot = environment.task.compiled, environment.task.robot
        known = [model.actuator(i).name for i in range(model.nu)]
        if missing := [name for name in names if name not in known]:
            raise TrainError("the task has no actuator of the policy", expected=missing[0], found=known)
        columns = {name: k for k, name in enumerate(names)}
        arm = [columns.get(known[i]) for i in robot.actuator]
        self._hand = [columns[known[i]] for i in robot.gripper if known[i] in columns]
        if None in arm or (len(robot.gripper) and not self._hand):
            needed = [known[i] for i in [*robot.actuator, *robot.gripper]]
            raise TrainError("the policy does not move the whole robot", expected=needed, found=list(names))
        self._arm = [k for k in arm if k is not None]
        self._actuators, self._gripper = robot.actuator.tolist(), robot.gripper.tolist()
        self._step = torch.as_tensor(robot.step, dtype=torch.float32)
        self._environment = environment

    def actions(self, commands: torch.Tensor) -> torch.Tensor:
        """Return actions in -1..1, shape (N, A), of commands (N, K); a step is as large as the environment allows."""
        present = self._environment.physics.ctrl
        wanted = commands.to(present.device)
        moves = wanted[:, self._arm] - present[:, self._actuators]
        if self._hand:
            grip = wanted[:, self._hand].mean(dim=1) - present[:, self._gripper].mean(dim=1)
            moves = torch.cat([moves, grip[:, None]], dim=1)
        return (moves / self._step.to(moves.device)).clamp(-1, 1).to(self._environment.device)
