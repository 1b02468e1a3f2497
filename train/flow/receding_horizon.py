"""Chunks in a closed loop: a policy predicts C actions, executes the first k of them, and looks again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
import torch
from tensordict import TensorDict

from concent_warp.errors import TrainError
from concent_warp.train.environment.environment import Environment
from concent_warp.train.flow.policy import Array, FlowPolicy


class RecedingHorizon:
    """Executes the chunks of a policy in N worlds, each with a horizon of its own.

    Example:
        >>> from concent_warp.train.flow.receding_horizon import RecedingHorizon
        >>> def loop(policy, camera, robot):
        ...     controller = RecedingHorizon(policy, "insert the peg")
        ...     while True:
        ...         robot.command(controller.act({"base": camera.read()[None]}, robot.state()[None])[0])
    """

    def __init__(self, policy: FlowPolicy, text: str | Sequence[str], *, execute: int | None = None) -> None:
        """Keep the policy.

        Args:
            policy: The policy.
            text: The instruction of all worlds, or one for each.
            execute: Actions of a chunk that are executed, 1 to the chunk's length; as in its settings by default.

        Raises:
            TrainError: The number of actions is out of bounds.
        """
        self.policy, self._text = policy, text
        self.execute = policy.cfg.execute if execute is None else execute
        if not 1 <= self.execute <= policy.cfg.chunk:
            raise TrainError(
                "the number of executed actions is out of bounds", expected=f"1 to {policy.cfg.chunk}", found=execute
            )
        self._chunks = np.zeros((0, policy.cfg.chunk, len(policy.features.action)), dtype=np.float32)
        self._next = np.zeros(0, dtype=int)

    def act(self, images: Mapping[str, Array], proprioception: Array, started: np.ndarray | None = None) -> np.ndarray:
        """Return the next action of each world, shape (N, A) float32; see `FlowPolicy.act`.

        Args:
            images: Present images by the names of the cameras, each (N, H, W, 3) uint8.
            proprioception: Present states of the robots, shape (N, P).
            started: Worlds in which an episode begins, whose chunk is dropped, shape (N,) bool; none by default.

        Raises:
            TrainError: An input is missing or has another shape or type.
        """
        count = len(proprioception)
        if len(self._chunks) != count:
            self._chunks = np.zeros((count, *self._chunks.shape[1:]), dtype=np.float32)
            self._next = np.full(count, self.execute)
        if started is not None:
            self._next[np.asarray(started, dtype=bool)] = self.execute
        rows = np.flatnonzero(self._next >= self.execute)
        if len(rows):
            text = self._text if isinstance(self._text, str) else [self._text[row] for row in rows]
            seen = {name: images[name][_rows(rows, images[name])] for name in self.policy.features.cameras}
            own = proprioception[_rows(rows, proprioception)]
            self._chunks[rows], self._next[rows] = self.policy.act(seen, own, text), 0
        found = self._chunks[np.arange(count), self._next]
        self._next += 1
        return found


class WorldCameras(Protocol):
    """Cameras in the N worlds of an environment, such as what a distillation renders with."""

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the K cameras."""
        ...

    def begin(self, which: torch.Tensor) -> None:
        """Begin episodes in the worlds of a mask (N,) bool."""
        ...

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return what the cameras see, uint8, shape (N, K, 3, S, S).

        Args:
            qpos: Positions, shape (N, nq).
            mocap: Positions [m] (N, nmocap, 3) and orientations wxyz (N, nmocap, 4) of fixed objects.
        """
        ...


def act_in(
    policy: FlowPolicy,
    environment: Environment,
    images: WorldCameras,
    text: str | Sequence[str],
    *,
    execute: int | None = None,
) -> Callable[[TensorDict], torch.Tensor]:
    """Return the function from an environment's observations to its actions; it renders what the policy sees.

    The policy must have learned from a data set that `render` wrote of the environment's task: its state are positions
    of joints, its actions are commands of actuators, both by name. The environment's actions are steps of the commands,
    so that each is the step from the present command to the predicted one, as large as the environment allows.

    Args:
        policy: The policy.
        environment: The worlds.
        images: Their cameras.
        text: The instruction of all worlds, or one for each.
        execute: Actions of a chunk that are executed; as in the policy's settings by default.

    Raises:
        TrainError: The task lacks a camera, joint or actuator of the policy, or moves at another rate.
    """
    model, robot, physics = environment.task.compiled, environment.task.robot, environment.physics
    features = policy.features
    joints = {model.joint(j).name: int(model.jnt_qposadr[j]) for j in range(model.njnt)}
    actuators = {model.actuator(i).name: i for i in range(model.nu)}
    for what, needed, known in (
        ("camera", features.cameras, images.cameras), ("joint", features.state, joints),
        ("actuator", features.action, actuators),
    ):  # fmt: skip
        if missing := [name for name in needed if name not in known]:
            raise TrainError(f"the task has no {what} of the policy", expected=missing[0], found=list(known))
    if abs(features.rate * environment.control_step - 1) > 1e-6:
        found = f"{1 / environment.control_step:g} Hz"
        raise TrainError(
            "the task moves at another rate than the policy", expected=f"{features.rate:g} Hz", found=found
        )
    state = torch.tensor([joints[name] for name in features.state])
    columns = {name: k for k, name in enumerate(features.action)}
    arm = [columns.get(model.actuator(i).name) for i in robot.actuator]
    hand = [columns[name] for i in robot.gripper if (name := model.actuator(i).name) in columns]
    if None in arm or (len(robot.gripper) and not hand):
        names = [model.actuator(i).name for i in [*robot.actuator, *robot.gripper]]
        raise TrainError("the policy does not move the whole robot", expected=names, found=list(features.action))
    step = torch.as_tensor(robot.step, dtype=torch.float32)
    horizon = RecedingHorizon(policy, text, execute=execute)
    cameras = [list(images.cameras).index(name) for name in features.cameras]

    def act(observation: TensorDict) -> torch.Tensor:
        del observation  # it tells where objects are
        started = environment.episode_length_buf == 0
        images.begin(started)
        seen = images.render(physics.qpos, physics.mocap).permute(0, 1, 3, 4, 2)
        shown = {name: seen[:, k] for name, k in zip(features.cameras, cameras, strict=True)}
        felt = physics.qpos if environment.estimate is None else environment.estimate.qpos
        own = felt[:, state.to(felt.device)]
        wanted = torch.from_numpy(horizon.act(shown, own, started.cpu().numpy())).to(physics.ctrl.device)
        present = physics.ctrl[:, robot.actuator.tolist()]
        moves = wanted[:, arm] - present
        if hand:
            grip = wanted[:, hand].mean(dim=1) - physics.ctrl[:, robot.gripper.tolist()].mean(dim=1)
            moves = torch.cat([moves, grip[:, None]], dim=1)
        return (moves / step.to(moves.device)).clamp(-1, 1).to(environment.device)

    return act


def _rows(rows: np.ndarray, of: Array) -> np.ndarray | torch.Tensor:
    """Return rows as they index an array, or a tensor on its device."""
    return torch.as_tensor(rows, device=of.device) if isinstance(of, torch.Tensor) else rows
