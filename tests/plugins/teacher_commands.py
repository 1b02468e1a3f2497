"""The commands that a policy of the state gives in a trial, which a policy that sees would have to predict."""

from __future__ import annotations

import numpy as np
import torch

import concent_warp as cw


class TeacherCommands:
    """Acts in a trial as a policy of the state."""

    def __init__(self, policy: cw.Policy, trials: cw.TrialEnvironment) -> None:
        """Act in the world of the trial that has begun."""
        self._environment = trials._environment
        self._act = policy.act_in(self._environment)
        self._robot = self._environment.task.robot

    def next(self) -> np.ndarray:
        """Return the commands that follow from the next action, shape (K,)."""
        robot, environment = self._robot, self._environment
        with torch.no_grad():
            action = self._act(environment.get_observations()).clamp(-1, 1)
        command = environment.physics.ctrl.clone()
        moves = action * torch.as_tensor(robot.step, dtype=command.dtype)
        command[:, robot.actuator.tolist()] += moves[:, : len(robot.actuator)]
        command[:, robot.gripper.tolist()] += moves[:, len(robot.actuator) :]
        return command[0].numpy()
