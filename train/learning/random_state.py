"""Random number generators of a training: seeding, and their state in checkpoints."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch


def seed_everything(seed: int) -> None:
    """Seed all generators."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


def random_state(device: str) -> dict[str, Any]:
    """Return the state of torch's generators on the CPU and on a device; training samples from no others."""
    cuda = torch.cuda.get_rng_state(device).cpu() if device.startswith("cuda") else None
    return {"cpu": torch.get_rng_state(), "cuda": cuda}


def restore_random_state(state: dict[str, Any], device: str) -> None:
    """Set torch's generators to a state that `random_state` returned."""
    torch.set_rng_state(state["cpu"].cpu())
    if state["cuda"] is not None and device.startswith("cuda"):
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)
