"""The policy type "concent": students and flow policies behind lerobot's interface."""

from __future__ import annotations

import json
from collections import deque
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import nn

from lerobot_policy_concent.acting import acting_of, described_run
from lerobot_policy_concent.configuration_concent import ConcentConfig


class ConcentPolicy(PreTrainedPolicy):
    """Acts by images and proprioception; returns absolute commands of the actuators, as data sets of `render` have."""

    config_class = ConcentConfig
    name = "concent"

    def __init__(self, config: ConcentConfig, *_: Any, **__: Any) -> None:
        """Make the policy: of its run folder, or for weights that are loaded afterwards.

        Raises:
            ValueError: There is neither a run folder nor a saved policy.
            concent_warp.TrainError: The folder holds no policy that sees.
        """
        super().__init__(config)
        if config.architecture is not None:
            self.acting = acting_of(json.loads(config.architecture))
        elif config.run is not None:
            described, self.acting = described_run(Path(config.run))
            config.architecture = json.dumps(described)
        else:
            raise ValueError(
                "no policy is given: name the run folder of concent distil or train-flow with --policy.run, or the "
                "folder of lerobot-concent-convert with --policy.path"
            )
        size = (3, *self.acting.size)
        images = {f"{OBS_IMAGES}.{name}": PolicyFeature(FeatureType.VISUAL, size) for name in self.acting.cameras}
        config.input_features = {**images, **_numbers(self.acting.numbers)}
        config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (self.acting.actions,))}
        if config.n_action_steps is None:
            config.n_action_steps = self.acting.execute
        if not 1 <= config.n_action_steps <= self.acting.chunk:
            raise ValueError(f"n_action_steps is {config.n_action_steps}, expected 1 to {self.acting.chunk}")
        self.reset()

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, *, strict: bool = True, **options: Any) -> Any:
        """Return a saved policy; weights that are missing are an error."""
        return super().from_pretrained(pretrained_name_or_path, strict=strict, **options)

    def reset(self) -> None:
        """Forget the chunk and the past images: an episode begins."""
        self._queue: deque[torch.Tensor] = deque()
        self.acting.reset()

    def get_optim_params(self) -> list[nn.Parameter]:
        """Return the parameters."""
        return list(self.parameters())

    def forward(self, batch: dict[str, torch.Tensor]) -> tuple[torch.Tensor, dict | None]:
        """Raise: policies are trained by `concent distil` and `concent train-flow`.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError("policies of type concent are trained by concent distil and concent train-flow")

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> torch.Tensor:
        """Return chunks of commands, shape (N, C, A); C is 1 for a student.

        Args:
            batch: Images in 0..1 (N, 3, H, W), numbers (N, n), and the "task" as text, one for all or N of them.
            kwargs: Noise (N, C, A) that a flow starts from.
        """
        return self.acting.chunk_of(batch, self.config.instruction, kwargs.get("noise"))

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> torch.Tensor:
        """Return the next commands, shape (N, A): of the chunk that is being executed, or of a new one."""
        self.acting.see(batch)
        if not self._queue:
            chunk = self.predict_action_chunk(batch, **kwargs)
            self._queue.extend(chunk[:, : self.config.n_action_steps].unbind(dim=1))
        return self._queue.popleft()


def _numbers(sizes: dict[str, int]) -> dict[str, PolicyFeature]:
    """Return features of numbers by name."""
    return {name: PolicyFeature(FeatureType.STATE, (size,)) for name, size in sizes.items()}
