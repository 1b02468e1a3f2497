"""Plug-in for lerobot: policies of ConCent-Warp that see. Importing it registers the policy type "concent"."""

from lerobot_policy_concent.configuration_concent import ConcentConfig
from lerobot_policy_concent.modeling_concent import ConcentPolicy
from lerobot_policy_concent.processor_concent import make_concent_pre_post_processors

__all__ = ["ConcentConfig", "ConcentPolicy", "make_concent_pre_post_processors"]
