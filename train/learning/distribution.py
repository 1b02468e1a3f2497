"""The policy's action distribution: a Gaussian squashed into -1..1 by tanh (paper, appendix C)."""

from __future__ import annotations

import math

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from torch import nn

LARGEST = 1.0 - 1e-6
"""Magnitude to which actions are kept off the ends, where the squashing cannot be undone in single precision."""


FARTHEST = 4.0
"""Magnitude to which means of u are kept in training: tanh(4) is 0.9993. What a network answers to an observation far
out of the ordinary may be in the hundreds; there a small update changes densities by more than single precision holds,
and one such step of one world would end a training with losses that are not finite."""


class SquashedGaussian(GaussianDistribution):
    """a = tanh(u), u normal: log p(a) = log N(u) - sum log(1 - tanh(u)^2).

    `mean`, `std`, `params` and the divergence are those of u; the divergence of two squashed Gaussians is that of the
    Gaussians, as tanh is one to one.
    """

    def update(self, mlp_output: torch.Tensor) -> None:
        """Take means (..., A) of u, kept within -4..4."""
        super().update(mlp_output.clamp(-FARTHEST, FARTHEST))

    def sample(self) -> torch.Tensor:
        """Return actions, shape (..., A), strictly between -1 and 1."""
        return torch.tanh(super().sample()).clamp(-LARGEST, LARGEST)

    def log_prob(self, outputs: torch.Tensor) -> torch.Tensor:
        """Return the log density of actions (..., A), shape (...)."""
        u = torch.atanh(outputs.clamp(-LARGEST, LARGEST))
        return super().log_prob(u) - _log_slope(u).sum(dim=-1)

    @property
    def entropy(self) -> torch.Tensor:
        """Return the entropy, shape (...): that of u, and the mean of log da/du estimated from one draw."""
        assert self._distribution is not None
        u = self._distribution.rsample()
        return super().entropy + _log_slope(u).sum(dim=-1)

    def deterministic_output(self, mlp_output: torch.Tensor) -> torch.Tensor:
        """Return the squashed mean."""
        return torch.tanh(mlp_output)

    def as_deterministic_output_module(self) -> nn.Module:
        """Return the same as a module for export."""
        return nn.Tanh()


def _log_slope(u: torch.Tensor) -> torch.Tensor:
    """Return log(1 - tanh(u)^2), in the form that does not run out of precision."""
    return 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
