"""PPO through rsl-rl."""
