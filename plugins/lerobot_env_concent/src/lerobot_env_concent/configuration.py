"""Configuration of the environment type "concent"."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE, OBS_STR

from lerobot_env_concent.environment import GYM_ID, ConcentTrialEnv


@EnvConfig.register_subclass("concent")
@dataclass
class ConcentEnv(EnvConfig):
    """Trials of a task in Reality, by Reality's cameras, or in simulation."""

    task: str | None = "Trial-v0"
    """The environment's name among gymnasium's, always this one."""
    task_of: str = "shape_sorter"
    """Policy or student whose task it is: a run folder of ConCent-Warp or the name of a pretrained policy."""
    world: str = "reality"
    """"reality", or "simulation" with images as `concent render` writes them."""
    cameras: list[str] = field(default_factory=list)
    """Names of the cameras; by default those of a student, else base and wrist."""
    size: int | None = None
    """Height and width of the images [px]; by default those of a student, else 96."""
    base_fovy: float | None = None
    """Vertical field of view of the base camera [degrees]; by default that of a student, else of `concent render`."""
    hide: list[str] = field(default_factory=list)
    """Effects hidden in Reality, each as name=value."""
    instruction: str | None = None
    """What the policy is told; by default the demonstration's task."""
    device: str | None = None
    """Warp's name of the device that simulates and renders; the first CUDA device by default, else the CPU."""

    def __post_init__(self) -> None:
        """Find the sizes of observation and action in the task."""
        made = ConcentTrialEnv(**self.gym_kwargs)
        trials = made.trials
        self.fps = made.metadata["render_fps"]
        shape = (*trials.size, 3)
        images = {f"{OBS_IMAGES}.{name}": PolicyFeature(FeatureType.VISUAL, shape) for name in trials.cameras}
        numbers = {
            name: PolicyFeature(FeatureType.STATE, (size,))
            for name, size in (
                ("agent_pos", len(trials.state)),
                ("command", len(trials.action)),
                ("proprioception", trials.proprioception),
            )
        }
        self.features = {**images, **numbers, ACTION: PolicyFeature(FeatureType.ACTION, (len(trials.action),))}
        self.features_map = {name: name for name in (*images, ACTION)}
        self.features_map |= {
            "agent_pos": OBS_STATE, "command": f"{OBS_STR}.command", "proprioception": f"{OBS_STR}.proprioception",
        }  # fmt: skip

    @property
    def package_name(self) -> str:
        """Package to import where the environment is not registered."""
        return GYM_ID.split("/")[0]

    @property
    def gym_id(self) -> str:
        """Name of the environment among gymnasium's."""
        return GYM_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment."""
        return {
            "task_of": self.task_of, "world": self.world, "cameras": self.cameras, "size": self.size,
            "base_fovy": self.base_fovy, "hide": self.hide, "instruction": self.instruction, "device": self.device,
        }  # fmt: skip
