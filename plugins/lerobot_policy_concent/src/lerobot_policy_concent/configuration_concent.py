"""Configuration of the policy type "concent"."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig


@PreTrainedConfig.register_subclass("concent")
@dataclass
class ConcentConfig(PreTrainedConfig):
    """A student of `concent distil`, or a flow policy of `concent train-flow`."""

    run: str | None = None
    """Run folder of the policy; not needed with --policy.path, whose folder holds the policy itself."""
    n_action_steps: int | None = None
    """Actions of a chunk that are executed before the next one is predicted; as in the run's settings by default."""
    instruction: str | None = None
    """Instruction of a flow policy, in place of the environment's or data set's."""
    architecture: str | None = None
    """The network and its inputs as JSON, in the folder of a saved policy."""
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )
    """No normalisation: the statistics are part of the weights."""

    @property
    def observation_delta_indices(self) -> None:
        """Return None: a policy sees the present only."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """Return None: the policy is not trained by lerobot."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """Return None: there is no reward."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """Return the optimiser of lerobot's training scripts, which want one."""
        return AdamWConfig()

    def get_scheduler_preset(self) -> None:
        """Return no schedule."""
        return None

    def validate_features(self) -> None:
        """Do nothing: the policy says what it lacks when it acts."""
