"""Reinforcement learning of a policy from the contact events of a demonstration (paper, section 3.2).

`train.train` is the entry and `cfg` its settings; `run` writes and reads run folders. The sub-packages: `task` (model,
events, robot), `environment` (vectorised worlds, observation, reward), `resets` (initial states), `learning` (PPO) and
`policy` (evaluation, export, pretrained policies).
"""
