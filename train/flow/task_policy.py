"""A flow policy at work in the task of a policy that was trained in simulation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDict

from concent_warp.errors import TrainError
from concent_warp.train.distil.images import ImageSource
from concent_warp.train.environment.command_steps import CommandSteps
from concent_warp.train.environment.environment import Environment
from concent_warp.train.flow.policy import FlowPolicy
from concent_warp.train.flow.receding_horizon import RecedingHorizon
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import TrainingRun
from concent_warp.train.trials.episodes import PolicyFunction


@dataclass(frozen=True)
class TaskFlowPolicy:
    """A flow policy with a task; it is evaluated as the policy is whose task it is.

    It must have learned from a data set that `render` wrote of the task: its state are positions of joints, its actions
    are commands of actuators, both by name.

    Example:
        >>> import concent_warp as cw
        >>> def success_rate(flow: cw.FlowPolicy) -> float:
        ...     policy = cw.TaskFlowPolicy(flow, cw.load_policy("shape_sorter"))
        ...     return cw.evaluate(policy, world="reality").rate
    """

    policy: FlowPolicy
    """The flow policy."""
    teacher: Policy
    """The policy whose task it is, of whose episodes `render` made the data set."""
    text: str | None = None
    """The instruction; by default that of the teacher's demonstration, as `render` writes it."""

    @property
    def instruction(self) -> str:
        """The instruction that the policy gets."""
        return self.text or self.run.recording[0].task or "do the task"

    @property
    def run(self) -> TrainingRun:
        """Model, demonstration, contact events and settings of the teacher's training."""
        return self.teacher.run

    @property
    def folder(self) -> Path:
        """Run folder of the flow policy."""
        return self.policy.folder

    @property
    def pretrained(self) -> bool:
        """Whether the policy comes with the package."""
        return False

    def scaled(self, action_scale: float = 1.0, setpoint_lead_scale: float = 1.0) -> TaskFlowPolicy:
        """Return the policy with smaller command steps and leads, see `Policy.scaled`."""
        return replace(self, teacher=self.teacher.scaled(action_scale, setpoint_lead_scale))

    def act_in(self, environment: Environment, images: ImageSource) -> PolicyFunction:
        """Return the function from an environment's observations to its actions; it renders what the policy sees.

        The environment's actions are steps of the commands: each is the step from the present command to the predicted
        one, as large as the environment allows.

        Args:
            environment: The worlds.
            images: Their cameras.

        Raises:
            TrainError: The task lacks a camera, joint or actuator of the policy, or moves at another rate.
        """
        model, physics = environment.task.compiled, environment.physics
        features = self.policy.features
        joints = {model.joint(j).name: int(model.jnt_qposadr[j]) for j in range(model.njnt)}
        for what, needed, known in (
            ("camera", features.cameras, images.cameras), ("joint", features.state, joints),
        ):  # fmt: skip
            if missing := [name for name in needed if name not in known]:
                raise TrainError(f"the task has no {what} of the policy", expected=missing[0], found=list(known))
        steps = CommandSteps(environment, features.action)
        if abs(features.rate * environment.control_step - 1) > 1e-6:
            found = f"{1 / environment.control_step:g} Hz"
            raise TrainError(
                "the task moves at another rate than the policy", expected=f"{features.rate:g} Hz", found=found
            )
        state = torch.tensor([joints[name] for name in features.state])
        horizon = RecedingHorizon(self.policy, self.instruction)
        cameras = [list(images.cameras).index(name) for name in features.cameras]

        def act(observation: TensorDict) -> torch.Tensor:
            del observation  # it tells where objects are
            started = environment.episode_length_buf == 0
            images.begin(started)
            seen = images.render(physics.qpos, physics.mocap).permute(0, 1, 3, 4, 2)
            shown = {name: seen[:, k] for name, k in zip(features.cameras, cameras, strict=True)}
            felt = physics.qpos if environment.estimate is None else environment.estimate.qpos
            own = felt[:, state.to(felt.device)]
            return steps.actions(torch.from_numpy(horizon.act(shown, own, started.cpu().numpy())))

        return act
