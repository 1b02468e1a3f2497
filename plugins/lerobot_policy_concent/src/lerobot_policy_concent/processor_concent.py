"""What lerobot does to observations before the policy and to actions after it: devices and names only."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_policy_concent.configuration_concent import ConcentConfig


def make_concent_pre_post_processors(
    config: ConcentConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Return the pipelines before and after the policy."""
    return make_default_pre_post_processors(config, dataset_stats)
