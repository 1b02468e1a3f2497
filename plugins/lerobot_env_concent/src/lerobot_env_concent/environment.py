"""Trials as a gymnasium environment: pixels and numbers as lerobot names them, commands of the actuators as action."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import warp

from concent_warp import EvaluateCfg, ImagesCfg, Student, TrialEnvironment, TrialObservation, load_policy, load_student
from concent_warp.scene.cameras import BASE_FOVY
from concent_warp.train.distil.cfg import holds_student

GYM_ID = "lerobot_env_concent/Trial-v0"


def register_environment() -> None:
    """Register the environment with gymnasium, once."""
    if GYM_ID not in gym.registry:
        gym.register(GYM_ID, entry_point="lerobot_env_concent.environment:ConcentTrialEnv")


class ConcentTrialEnv(gym.Env):
    """One trial per episode; the reward is 1 when object 1 is in place at the end of it, else 0.

    An episode is terminated by success or failure, and truncated by the time limit. `info` has "is_success" and, at the
    end, "outcome". The observation that ends an episode is the one before its last step.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task_of: str = "shape_sorter",
        *,
        world: str = "reality",
        cameras: Sequence[str] | None = None,
        size: int | None = None,
        base_fovy: float | None = None,
        hide: Sequence[str] = (),
        instruction: str | None = None,
        device: str | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        """Prepare the task; see `ConcentEnv` for the arguments.

        Raises:
            concent_warp.ConcentError: There is no such policy, or a setting is out of bounds.
        """
        warp.config.log_level = warp.LOG_WARNING  # modules that are loaded are no news
        given = load_student(task_of) if holds_student(Path(task_of)) else load_policy(task_of)
        images = given.cfg.images if isinstance(given, Student) else ImagesCfg(base_fovy=BASE_FOVY, size=96)
        images = ImagesCfg(
            tuple(cameras or images.cameras), base_fovy=base_fovy or images.base_fovy, size=size or images.size
        )
        self.trials = TrialEnvironment(given, images, EvaluateCfg(hide=tuple(hide)), world=world, device=device)
        self.task = GYM_ID
        self.task_description = instruction or self.trials.instruction
        """The instruction that a policy gets."""
        self._max_episode_steps = self.trials.steps
        self.metadata = {**self.metadata, "render_fps": round(1 / self.trials.control_step)}
        self.render_mode = render_mode
        pixels = {n: gym.spaces.Box(0, 255, (*self.trials.size, 3), np.uint8) for n in self.trials.cameras}
        self.observation_space = gym.spaces.Dict(
            pixels=gym.spaces.Dict(pixels), agent_pos=_numbers(len(self.trials.state)),
            command=_numbers(len(self.trials.action)), proprioception=_numbers(self.trials.proprioception),
        )  # fmt: skip
        self.action_space = _numbers(len(self.trials.action))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin a trial; the seed gives initial state, friction, masses, gains, and errors of sensors and cameras."""
        super().reset(seed=seed)
        del options
        chosen = int(self.np_random.integers(2**31)) if seed is None else seed
        return _observed(self.trials.reset(seed=chosen)), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Command the actuators, in the order of `trials.action`, for one control step."""
        step = self.trials.step(action)
        info: dict[str, Any] = {"is_success": step.success}
        if step.outcome is not None:
            info["outcome"] = step.outcome
        ended = step.outcome is not None and not step.out_of_time
        return _observed(step.observation), float(step.success), ended, step.out_of_time, info

    def render(self) -> np.ndarray:
        """Return the cameras' latest images side by side, shape (H, C W, 3) uint8."""
        if self.trials.latest is None:
            return np.zeros((self.trials.size[0], self.trials.size[1] * len(self.trials.cameras), 3), np.uint8)
        return np.concatenate(list(self.trials.latest.images.values()), axis=1)


def _observed(found: TrialObservation) -> dict[str, Any]:
    """Return an observation by lerobot's names."""
    return {
        "pixels": dict(found.images), "agent_pos": found.state, "command": found.command,
        "proprioception": found.proprioception,
    }  # fmt: skip


def _numbers(count: int) -> gym.spaces.Box:
    """Return the space of so many numbers."""
    return gym.spaces.Box(-np.inf, np.inf, (count,), np.float32)
