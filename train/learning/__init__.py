"""Proximal policy optimisation on rsl-rl.

`ppo` trains and writes checkpoints; `distribution` is the squashed Gaussian of the actions, `normalisation` that of the
observations; `distributed` connects the ranks of data-parallel training; `metrics` writes per-iteration metrics.
"""
