"""Commands that act late or sluggishly in the worlds of a training: delay and first-order lag, a value for each world.

What was commanded is kept for as long as the longest delay. Delays and lags are linear and the same at all times, so
their order is free: of all effects on an actuator, the delays add up, and the lags follow one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

ATOMIC = 1e-5
"""Time constant below which a lag counts as none [s], as in `effects.drives.ActuatorLag`."""


@dataclass(frozen=True)
class CommandDynamics:
    """How what acts in N worlds follows what was commanded."""

    delay: np.ndarray
    """Delays [s], shape (N, nu)."""
    lags: tuple[np.ndarray, ...] = ()
    """Time constants of lags, one after the other [s], shape (N, nu) each."""

    @staticmethod
    def of(parts: Sequence[CommandDynamics]) -> CommandDynamics | None:
        """Return what several come to, None where nothing is late."""
        if not parts:
            return None
        lags = tuple(lag for part in parts for lag in part.lags if lag.max() > ATOMIC)
        delay = np.sum([part.delay for part in parts], axis=0)
        return CommandDynamics(delay, lags) if lags or delay.max() > 0 else None


class CommandFilter:
    """Turns the commands of N worlds into what acts in each step of an action. Captured with what surrounds it."""

    def __init__(self, following: CommandDynamics, timestep: float, decimation: int, device: str) -> None:
        """Make room.

        Args:
            following: Delays and lags, shape (N, nu).
            timestep: Of the simulation [s].
            decimation: D, steps of one action.
            device: Torch's name of the device.
        """

        def real(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        late = np.maximum(following.delay, 0.0) / timestep
        # Step k of an action shows what was commanded `late` steps before, in the action then: so many actions ago.
        wanted = np.arange(decimation)[:, None, None] - late
        step = np.floor(wanted + 1e-6)
        kept = math.ceil(late.max() / decimation) + 1
        ago = [np.clip(-np.floor(s / decimation), 0, kept).astype(int) for s in (step, step + 1)]
        self._older, self._newer = (torch.as_tensor(index, device=device) for index in ago)
        self._share = real(np.clip(wanted - step, 0.0, 1.0))
        lags = [np.where(lag > ATOMIC, lag, 1e-9 * timestep) for lag in following.lags]
        self._keep = [real(np.exp(-timestep / lag)) for lag in lags]
        self._mean = [real((1 - np.exp(-timestep / lag)) * lag / timestep) for lag in lags]
        shape = following.delay.shape
        self.commanded = torch.zeros(kept + 1, *shape, device=device)
        """Commands of this action and of those before it, shape (actions, N, nu)."""
        self.set_points = torch.zeros(len(lags), *shape, device=device)
        """Where each lag has got to, shape (lags, N, nu)."""
        self.acting = torch.zeros(decimation, *shape, device=device)
        """What acts in each step of this action, shape (D, N, nu)."""

    @property
    def memory(self) -> dict[str, torch.Tensor]:
        """What the future depends on."""
        return {"commanded": self.commanded, "set points": self.set_points}

    def begin(self, where: torch.Tensor, ctrl: torch.Tensor) -> None:
        """Take commands, shape (N, nu), as having been held for long in the worlds of a mask, shape (N,) bool."""
        for kept in (self.commanded, self.set_points):
            kept.copy_(torch.where(where[:, None], ctrl, kept))

    def follow(self, ctrl: torch.Tensor) -> None:
        """Take the commands of the next action, shape (N, nu), and fill `acting`."""
        self.commanded[1:] = self.commanded[:-1].clone()
        self.commanded[0] = ctrl
        older, newer = (self.commanded.gather(0, index) for index in (self._older, self._newer))
        self.acting.copy_(torch.lerp(older, newer, self._share))
        for set_point, keep, mean in zip(self.set_points, self._keep, self._mean, strict=True):
            for acts in self.acting:
                wanted = acts.clone()
                acts.copy_(torch.lerp(wanted, set_point, mean))
                set_point.copy_(torch.lerp(wanted, set_point, keep))
