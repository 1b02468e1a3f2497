"""The state before the step in which a world first diverged."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np
import torch


class FirstDivergence:
    """Keeps that state on the device; its operations can be captured in a CUDA graph."""

    def __init__(self, m: mujoco.MjModel, device: str) -> None:
        """Allocate room for a state of the model."""
        self._shapes = {"qpos": (m.nq,), "qvel": (m.nv,), "ctrl": (m.nu,), "mocap_pos": (m.nmocap, 3)}
        self._shapes |= {"mocap_quat": (m.nmocap, 4), "world": ()}
        size = sum(math.prod(shape) for shape in self._shapes.values())
        self._state = torch.zeros(size, dtype=torch.float64, device=device)
        self.happened = torch.zeros((), dtype=torch.bool, device=device)
        """Whether a world has diverged, shape ()."""

    def record(self, diverged: torch.Tensor, before: Sequence[torch.Tensor]) -> None:
        """Store the state of the first world of a mask (N,) bool, unless one is stored.

        Args:
            diverged: Worlds that diverged in this step.
            before: State before the step, N rows each: qpos, qvel, ctrl, positions and orientations of fixed objects,
                index of the world.
        """
        world = diverged.to(torch.uint8).argmax()
        state = torch.cat([values.index_select(0, world[None]).flatten().double() for values in before])
        first = diverged.any() & ~self.happened
        self._state.copy_(torch.where(first, state, self._state))
        self.happened.logical_or_(first)

    def state(self) -> dict[str, np.ndarray] | None:
        """Return the state by name, None if no world has diverged; see `Environment.diverged_state`."""
        if not bool(self.happened):
            return None
        parts = np.split(self._state.cpu().numpy(), np.cumsum([math.prod(s) for s in self._shapes.values()])[:-1])
        return {name: part.reshape(shape) for part, (name, shape) in zip(parts, self._shapes.items(), strict=True)}
