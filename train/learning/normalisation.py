"""Normalisation of observations by their running mean and deviation, within bounds."""

from __future__ import annotations

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization

LARGEST = 10.0
"""Largest magnitude of a normalised observation: what is farther out, such as an object that flew away, would make the
networks' outputs, and the losses, as large as it likes."""


class BoundedNormalization(EmpiricalNormalization):
    """rsl-rl's normalisation, its results kept within bounds and its variances above rounding."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return observations normalised, shape (..., D), each within +-`LARGEST`."""
        return super().forward(x).clamp(-LARGEST, LARGEST)

    @torch.jit.unused
    def update(self, x: torch.Tensor) -> None:
        """Learn from observations (N, D)."""
        super().update(x)
        # Of what never changes, rounding may leave a variance below 0, whose root is not a number.
        self._std = torch.sqrt(self.get_buffer("_var").clamp_(min=0.0))


def bound_observations(model: MLPModel) -> None:
    """Have a network normalise its observations within bounds, if it normalises them."""
    if model.obs_normalization:
        where = next(model.parameters()).device
        model.obs_normalizer = BoundedNormalization(model.obs_dim).to(where)
