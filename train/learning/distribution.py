"""The policy's action distribution: a Gaussian squashed into -1..1 by tanh (paper, appendix C)."""

from __future__ import annotations

import math
from typing import Any

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from torch import nn

MAX_ACTION = 1.0 - 1e-6
"""Largest magnitude of an action: nearer to 1, tanh cannot be inverted in single precision."""


class SquashedGaussian(GaussianDistribution):
    """a = tanh(u), u normal: log p(a) = log N(u) - sum log(1 - tanh(u)^2).

    `mean`, `std`, `params` and the divergence are those of u; the divergence of two squashed Gaussians is that of the
    Gaussians, as tanh is one to one.
    """

    def __init__(self, *args: Any, max_mean: float = 4.0, **options: Any) -> None:
        """Create the distribution.

        Args:
            args: Those of `GaussianDistribution`.
            max_mean: Largest magnitude of the mean of u, see `PpoCfg.max_mean`.
            options: Those of `GaussianDistribution`.
        """
        super().__init__(*args, **options)
        self.max_mean = max_mean

    def update(self, mlp_output: torch.Tensor) -> None:
        """Set the distribution from means (..., A) of u, clamped to +-`max_mean`."""
        super().update(mlp_output.clamp(-self.max_mean, self.max_mean))

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
