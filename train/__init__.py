"""Reinforcement learning from contact events. Empty in this version."""
