"""One trial after another in one world of a task, stepped from outside: what other packages evaluate policies in.

Images, joint positions and commands are those of the data sets of `render`: a policy that was trained on such a data
set, by whatever package, acts here without further ado.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from concent_warp.checks import check_device, check_seed, check_settings
from concent_warp.deploy.cfg import EvaluateCfg, WorldName
from concent_warp.deploy.reality_images import RealityImages
from concent_warp.deploy.reality_world import reality_environment, reality_world
from concent_warp.deploy.simulated_images import HybridImages
from concent_warp.errors import TrainError
from concent_warp.reality.hidden.in_task import parse_effects
from concent_warp.scene.cameras import BASE_FOVY
from concent_warp.train.distil.cfg import ImagesCfg, holds_student
from concent_warp.train.distil.images import ImageSource
from concent_warp.train.distil.proprioception import Proprioception
from concent_warp.train.distil.student import Student
from concent_warp.train.environment.command_steps import CommandSteps
from concent_warp.train.environment.observation import ObservationLayout
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.learning.random_state import random_state, restore_random_state
from concent_warp.train.policy.load import Policy
from concent_warp.train.trials.episodes import MISSED, SUCCESS, Episodes

SINGLE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True)
class TrialObservation:
    """What the robot sees and knows before a step.

    Example:
        >>> import concent_warp as cw
        >>> def act(now: cw.TrialObservation) -> object:
        ...     return now.command if now.images["base"].mean() > 10 else None
    """

    images: dict[str, np.ndarray]
    """Images by camera, each (H, W, 3) uint8."""
    state: np.ndarray
    """Positions of the joints [rad or m], by encoders in Reality, shape (P,) float32, as in a data set of `render`."""
    command: np.ndarray
    """Present commands of the actuators, shape (K,) float32."""
    proprioception: np.ndarray
    """What a student knows of the robot, shape (Q,) float32."""


@dataclass(frozen=True)
class TrialStep:
    """What a step did.

    Example:
        >>> import concent_warp as cw
        >>> trials = cw.TrialEnvironment("shape_sorter", cw.ImagesCfg(size=16), world="simulation", device="cpu")
        >>> step = trials.step(trials.reset().command)
        >>> step.outcome is None, step.success
        (True, False)
    """

    observation: TrialObservation
    """What is observed after it; where it ended the trial, that of before it."""
    outcome: str | None
    """None while the trial lasts; then "success", "missed" after the time limit, or the failure "dropped", "severe" or
    "diverged"."""

    @property
    def success(self) -> bool:
        """Whether the trial ended with object 1 in place."""
        return self.outcome == SUCCESS

    @property
    def out_of_time(self) -> bool:
        """Whether the trial ended by its time limit without success."""
        return self.outcome == MISSED


class TrialEnvironment:
    """A task in Reality or in simulation: images and proprioception out, commands of the actuators in.

    Each trial has a world of its own: initial state, friction, masses, gains, errors of sensors and cameras are sampled
    by its seed, so that a seed gives the same trial again, whatever ran before.

    Example:
        >>> import concent_warp as cw
        >>> trials = cw.TrialEnvironment("shape_sorter", cw.ImagesCfg(size=32))
        >>> now = trials.reset(seed=7)
        >>> step = trials.step(now.command)  # holds still
        >>> step.observation.images["wrist"].shape, step.outcome
        ((32, 32, 3), None)
    """

    def __init__(
        self,
        task_of: str | Path | Policy | Student,
        images: ImagesCfg | None = None,
        cfg: EvaluateCfg | None = None,
        *,
        world: WorldName = "reality",
        device: str | None = None,
    ) -> None:
        """Prepare the task.

        Args:
            task_of: Policy or student whose task it is: a run folder or the name of a pretrained policy.
            images: Cameras, size and field of view of the images; by default those of a student, else base and wrist
                camera as `render` has them, at 96 pixels.
            cfg: Reality with its hidden effects, instruments and cameras.
            world: "reality", or "simulation", whose images are like those of `render` without networks.
            device: Warp's name of the device that simulates and renders; by default the first CUDA device, else the
                CPU. Reality is always simulated on the CPU.

        Raises:
            TrainError: There is no such policy, or a setting is out of bounds.
        """
        from concent_warp.simulate.warp_engine import preferred_device

        self._cfg = cfg or EvaluateCfg()
        check_settings(self._cfg, TrainError)
        check_device(device)
        if world not in ("reality", "simulation"):
            raise TrainError("there is no such world", expected="reality or simulation", found=world)
        if parse_effects(self._cfg.hide) and world != "reality":
            raise TrainError("hidden effects exist only in Reality", expected="world reality", found=world)
        given = load_task(task_of) if isinstance(task_of, str | Path) else task_of
        seen = given.cfg.images if isinstance(given, Student) else ImagesCfg(base_fovy=BASE_FOVY, size=96)
        self._images, self.world = images or seen, world
        check_settings(self._images, TrainError)
        self._run = given.scaled(self._cfg.action_scale, self._cfg.setpoint_lead_scale).run
        self._task = self._run.task()
        self._device = preferred_device() if device is None else device
        model, settings = self._task.compiled, self._run.cfg.environment
        joints = [j for j in range(model.njnt) if int(model.jnt_type[j]) in SINGLE]
        self._joints = model.jnt_qposadr[joints]
        self.cameras: tuple[str, ...] = self._images.cameras
        """Names of the cameras."""
        self.size: tuple[int, int] = (self._images.size, self._images.size)
        """Height and width of the images [px]."""
        self.state: tuple[str, ...] = tuple(model.joint(j).name for j in joints)
        """Names of the joints of `TrialObservation.state`."""
        self.action: tuple[str, ...] = tuple(model.actuator(i).name for i in range(model.nu))
        """Names of the actuators, in the order of the commands."""
        self.control_step: float = settings.decimation * self._task.replay.timestep
        """Time between steps [s]."""
        self.steps: int = max(1, round(settings.seconds / self.control_step))
        """Steps of the longest trial."""
        self.instruction: str = self._run.recording[0].task or "do the task"
        """The task in words, as data sets of `render` have it."""
        self._episodes: Episodes | None = None
        self._latest: TrialObservation | None = None
        self._random: dict[str, Any] = {}

    @cached_property
    def _proprioception(self) -> Proprioception:
        """What a student knows of itself."""
        return Proprioception(ObservationLayout.of(self._task, self._run.cfg.environment.observation))

    @property
    def proprioception(self) -> int:
        """Length Q of `TrialObservation.proprioception`."""
        return self._proprioception.size

    @property
    def latest(self) -> TrialObservation | None:
        """What was observed last; None before the first trial."""
        return self._latest

    def reset(self, *, seed: int = 0) -> TrialObservation:
        """Begin a trial in a new world that is sampled by a seed.

        Raises:
            TrainError: The seed is out of bounds, or Reality has other bodies or no such camera.
        """
        check_seed(seed, TrainError)
        self._random = {}
        with self._random_numbers(seed):
            states = self._run.evaluation_states(self._task, 1, seed)
            settings = replace(self._run.cfg.environment, worlds=1)
            if self.world == "reality":
                environment = reality_environment(self._task, settings, states, self._cfg, seed=seed)
                real = reality_world(self._task, settings, self._cfg)
                source: ImageSource = RealityImages(
                    environment, real.spec(), self._images, self._cfg.cameras, seed=seed, device=self._device
                )
            else:
                environment = make_environment(self._task, settings, states, device=self._device)
                source = HybridImages(environment, self._images)
            self._environment, self._source = environment, source
            self._steps = CommandSteps(environment, self.action)
            self._wanted = torch.zeros(1, environment.num_actions, device=environment.device)
            self._episodes = Episodes(environment, lambda _: self._wanted, [0])
            self._latest = self._observe(begun=True)
        return self._latest

    def step(self, command: np.ndarray) -> TrialStep:
        """Command the actuators for one control step.

        A command is reached as far as the task allows in a step: by steps and leads as large as those of its policy.

        Args:
            command: Commands of the actuators in the order of `action`, shape (K,).

        Raises:
            TrainError: No trial runs, or the command has another shape or is not finite.
        """
        if self._episodes is None or self._latest is None or not self._episodes.running.any():
            raise TrainError("no trial runs", fix="call reset first")
        given = np.asarray(command, dtype=np.float32)
        if given.shape != (len(self.action),) or not np.isfinite(given).all():
            raise TrainError("the command is not right", expected=f"{len(self.action)} finite numbers", found=command)
        with self._random_numbers():
            self._wanted = self._steps.actions(torch.from_numpy(given)[None])
            outcome = self._episodes.step().outcome.get(0)
            if outcome is None:  # else the world has begun another episode, of which nothing is told
                self._latest = self._observe()
        return TrialStep(self._latest, outcome)

    def _observe(self, *, begun: bool = False) -> TrialObservation:
        """Return what is observed of the present state."""
        environment, physics = self._environment, self._environment.physics
        self._source.begin(torch.full((1,), begun, device=environment.device))
        seen = self._source.render(physics.qpos, physics.mocap)[0].permute(0, 2, 3, 1).cpu().numpy()
        felt = physics.qpos if environment.estimate is None else environment.estimate.qpos
        own = self._proprioception.read(environment.observation)
        return TrialObservation(
            {name: seen[k].copy() for k, name in enumerate(self.cameras)},
            felt[0].cpu().numpy()[self._joints].astype(np.float32),
            physics.ctrl[0].cpu().numpy().astype(np.float32),
            own[0].cpu().numpy().astype(np.float32),
        )

    @contextmanager
    def _random_numbers(self, seed: int | None = None) -> Iterator[None]:
        """Use random numbers of the trial's own, seeded anew if a seed is given, and leave torch's as they are."""
        import warp as wp

        device = str(wp.device_to_torch(wp.get_device(self._device)))
        with torch.random.fork_rng([device] if device.startswith("cuda") else []):
            if seed is None:
                restore_random_state(self._random, device)
            else:
                torch.manual_seed(seed)
            yield
            self._random = random_state(device)


def load_task(source: str | Path) -> Policy | Student:
    """Return the policy or the student of a run folder, or a pretrained policy.

    Raises:
        TrainError: There is none.
    """
    return Student.load(source) if holds_student(Path(source)) else Policy.load(source)
