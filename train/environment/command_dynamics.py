"""Delay and first-order lag of commands, with values of their own in each world.

Past commands are buffered for the longest delay. Delays and lags are linear and time-invariant, so their order does not
matter: the delays of all effects on an actuator are summed, and the lags are applied in series.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

MIN_TIME_CONSTANT = 1e-5
"""Time constant below which a lag is omitted [s], as in `effects.drives.ActuatorLag`."""


@dataclass(frozen=True)
class CommandDynamics:
    """Delays and lags of the commands in N worlds."""

    delay: np.ndarray
    """Delays [s], shape (N, nu)."""
    lags: tuple[np.ndarray, ...] = ()
    """Time constants of lags in series [s], shape (N, nu) each."""

    @staticmethod
    def combined(parts: Sequence[CommandDynamics]) -> CommandDynamics | None:
        """Return the dynamics of several in series, None without any delay or lag."""
        if not parts:
            return None
        lags = tuple(lag for part in parts for lag in part.lags if lag.max() > MIN_TIME_CONSTANT)
        delay = np.sum([part.delay for part in parts], axis=0)
        return CommandDynamics(delay, lags) if lags or delay.max() > 0 else None


class CommandFilter:
    """Applies delays and lags to the commands of N worlds; its operations can be captured in a CUDA graph."""

    def __init__(self, dynamics: CommandDynamics, timestep: float, decimation: int, device: str) -> None:
        """Allocate the buffers.

        Args:
            dynamics: Delays and lags.
            timestep: Time step of the simulation [s].
            decimation: D, simulation steps per action.
            device: Torch's name of the device.
        """

        def real(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        delay = np.maximum(dynamics.delay, 0.0) / timestep
        # In step k of an action, the command of `delay` steps before acts: that of so many actions ago.
        source = np.arange(decimation)[:, None, None] - delay
        step = np.floor(source + 1e-6)
        kept = math.ceil(delay.max() / decimation) + 1
        ago = [np.clip(-np.floor(s / decimation), 0, kept).astype(int) for s in (step, step + 1)]
        self._older, self._newer = (torch.as_tensor(index, device=device) for index in ago)
        self._share = real(np.clip(source - step, 0.0, 1.0))
        lags = [np.where(lag > MIN_TIME_CONSTANT, lag, 1e-9 * timestep) for lag in dynamics.lags]
        self._keep = [real(np.exp(-timestep / lag)) for lag in lags]
        self._mean = [real((1 - np.exp(-timestep / lag)) * lag / timestep) for lag in lags]
        shape = dynamics.delay.shape
        self.commanded = torch.zeros(kept + 1, *shape, device=device)
        """Commands of this action and of earlier ones, the latest first, shape (actions, N, nu)."""
        self.set_points = torch.zeros(len(lags), *shape, device=device)
        """State of each lag, shape (lags, N, nu)."""
        self.acting = torch.zeros(decimation, *shape, device=device)
        """Commands that act in each step of this action, shape (D, N, nu)."""

    @property
    def memory(self) -> dict[str, torch.Tensor]:
        """State of the filter by name, for checkpoints."""
        return {"commanded": self.commanded, "set points": self.set_points}

    def reset(self, mask: torch.Tensor, ctrl: torch.Tensor) -> None:
        """Set the state to the steady state of commands (N, nu) in the worlds of a mask (N,) bool."""
        for kept in (self.commanded, self.set_points):
            kept.copy_(torch.where(mask[:, None], ctrl, kept))

    def apply(self, ctrl: torch.Tensor) -> None:
        """Set the commands of the next action, shape (N, nu), and compute `acting`."""
        self.commanded[1:] = self.commanded[:-1].clone()
        self.commanded[0] = ctrl
        older, newer = (self.commanded.gather(0, index) for index in (self._older, self._newer))
        self.acting.copy_(torch.lerp(older, newer, self._share))
        for set_point, keep, mean in zip(self.set_points, self._keep, self._mean, strict=True):
            for acts in self.acting:
                target = acts.clone()
                acts.copy_(torch.lerp(target, set_point, mean))
                set_point.copy_(torch.lerp(target, set_point, keep))
