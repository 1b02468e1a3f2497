"""Normalisation of observations by their running mean and standard deviation, clamped."""

from __future__ import annotations

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization

MAX_NORMALISED = 10.0
"""Largest magnitude of a normalised observation [standard deviations]: an object that flew away would otherwise make
the networks' outputs and the losses arbitrarily large."""


class BoundedNormalization(EmpiricalNormalization):
    """rsl-rl's running normalisation with clamped results and non-negative variances."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return observations normalised, shape (..., D), each clamped to +-`MAX_NORMALISED`."""
        return super().forward(x).clamp(-MAX_NORMALISED, MAX_NORMALISED)

    @torch.jit.unused
    def update(self, x: torch.Tensor) -> None:
        """Update mean and variance from observations (N, D)."""
        super().update(x)
        # Rounding can leave the variance of a constant observation below 0, whose root is not a number.
        self._std = torch.sqrt(self.get_buffer("_var").clamp_(min=0.0))


def bound_observations(model: MLPModel) -> None:
    """Replace a network's observation normalisation by `BoundedNormalization`, if it has one."""
    if model.obs_normalization:
        where = next(model.parameters()).device
        model.obs_normalizer = BoundedNormalization(model.obs_dim).to(where)
