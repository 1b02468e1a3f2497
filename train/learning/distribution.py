"""The policy's action distribution: a Gaussian squashed into -1..1 by tanh (paper, appendix C)."""

from __future__ import annotations

import math

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from torch import nn

MAX_ACTION = 1.0 - 1e-6
"""Largest magnitude of an action: nearer to 1, tanh cannot be inverted in single precision."""
MAX_MEAN = 4.0
"""Largest magnitude of the mean of u in training: tanh(4) is 0.9993. For an observation far from those seen before, the
network's output can be in the hundreds, where a small update changes the density by more than single precision
represents, and the losses become non-finite."""


class SquashedGaussian(GaussianDistribution):
    """a = tanh(u), u normal: log p(a) = log N(u) - sum log(1 - tanh(u)^2).

    `mean`, `std`, `params` and the divergence are those of u; the divergence of two squashed Gaussians is that of the
    Gaussians, as tanh is one to one.
    """

    def update(self, mlp_output: torch.Tensor) -> None:
        """Set the distribution from means (..., A) of u, clamped to -4..4."""
        super().update(mlp_output.clamp(-MAX_MEAN, MAX_MEAN))

    def sample(self) -> torch.Tensor:
        """Return actions, shape (..., A), strictly between -1 and 1."""
        return torch.tanh(super().sample()).clamp(-MAX_ACTION, MAX_ACTION)

    def log_prob(self, outputs: torch.Tensor) -> torch.Tensor:
        """Return the log density of actions (..., A), shape (...)."""
        u = torch.atanh(outputs.clamp(-MAX_ACTION, MAX_ACTION))
        return super().log_prob(u) - _log_slope(u).sum(dim=-1)

    @property
    def entropy(self) -> torch.Tensor:
        """Return the entropy, shape (...): that of u, and the mean of log da/du estimated from one sample."""
        assert self._distribution is not None
        u = self._distribution.rsample()
        return super().entropy + _log_slope(u).sum(dim=-1)

    def deterministic_output(self, mlp_output: torch.Tensor) -> torch.Tensor:
        """Return the squashed mean."""
        return torch.tanh(mlp_output)

    def as_deterministic_output_module(self) -> nn.Module:
        """Return the module that maps the mean of u to the action, for export."""
        return nn.Tanh()


def _log_slope(u: torch.Tensor) -> torch.Tensor:
    """Return log(1 - tanh(u)^2) in a numerically stable form, shape of `u`."""
    return 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
