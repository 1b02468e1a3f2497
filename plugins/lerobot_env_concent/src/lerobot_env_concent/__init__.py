"""Plug-in for lerobot: trials of ConCent-Warp. Importing it registers the environment type "concent"."""

from lerobot_env_concent.configuration import ConcentEnv
from lerobot_env_concent.environment import GYM_ID, ConcentTrialEnv, register_environment

register_environment()

__all__ = ["GYM_ID", "ConcentEnv", "ConcentTrialEnv"]
