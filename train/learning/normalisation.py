"""Normalisation of observations by their running mean and standard deviation, clamped."""

from __future__ import annotations

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization


class BoundedNormalization(EmpiricalNormalization):
    """rsl-rl's running normalisation with clamped results and non-negative variances."""

    def __init__(self, shape: int, max_observation: float) -> None:
        """Create the normalisation of observations of a length, clamped to +-`max_observation` standard deviations."""
        super().__init__(shape)
        self.max_observation = max_observation

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return observations normalised, shape (..., D), each within +-`max_observation`."""
        return super().forward(x).clamp(-self.max_observation, self.max_observation)

    @torch.jit.unused
    def update(self, x: torch.Tensor) -> None:
        """Update mean and variance from observations (N, D)."""
        super().update(x)
        # Rounding can leave the variance of a constant observation below 0, whose root is not a number.
        self._std = torch.sqrt(self.get_buffer("_var").clamp_(min=0.0))


def bound_observations(model: MLPModel, max_observation: float) -> None:
    """Replace a network's observation normalisation by `BoundedNormalization`, if it has one."""
    if model.obs_normalization:
        where = next(model.parameters()).device
        model.obs_normalizer = BoundedNormalization(model.obs_dim, max_observation).to(where)
