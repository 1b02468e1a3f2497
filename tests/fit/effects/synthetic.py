"""A prediction that is written down as a formula: oscillations whose parameters and initial states are known.

It takes the place of `Prediction` where the least squares are tested by themselves, without a simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from concent_warp.effects.effect import Parameter
from concent_warp.fit.effects.prediction import SimulationRequest

TRUTH = np.array([0.4, 1.5, 0.2])
"""Decay [1/s], frequency [rad/s] and reading offset that the synthetic measurements have."""
SPREAD = np.array([0.05, 0.2])
"""Spread of the initial states."""
NOISE = 0.01


@dataclass(frozen=True)
class SyntheticWindow:
    """A window of one second."""

    clock: np.ndarray
    measured: np.ndarray
    spread: np.ndarray
    start: float = 0.0
    end: float = 1.0
    number: int = 0
    smooth: bool = False

    @property
    def count(self) -> int:
        return len(self.clock)


def oscillation(values: np.ndarray, state: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Return exp(-v0 t) (a cos(4 v1 t) + b t), for a state (a, b) at the start, shape (T,)."""
    return np.exp(-values[0] * clock) * (state[0] * np.cos(4 * values[1] * clock) + state[1] * clock)


class SyntheticPrediction:
    """Residuals of windows; the last of three parameters shifts readings and needs no simulation.

    Args:
        offsets: True errors of the initial states in units of their spread, one a window, shape (W, 2).
        low: Smallest values of the parameters.
        high: Largest values.
        start: Values to start from.
        impact: Height of a jump of the prediction, in units of noise, between intervals of the first component of
            the initial state: what an impact does with discrete time steps.
        outlier: Size of one outlier in each window, in units of noise.
    """

    def __init__(
        self,
        offsets: np.ndarray,
        *,
        low: Sequence[float] = (0.0, 0.0, -1.0),
        high: Sequence[float] = (5.0, 5.0, 1.0),
        start: Sequence[float] = (0.1, 1.3, 0.0),
        impact: float = 0.0,
        outlier: float = 0.0,
        noise: float = 1.0,
        count: int = 25,
    ) -> None:
        rng = np.random.default_rng(len(offsets))
        self.start = np.array(start, dtype=float)
        self.prior_mean = self.start.copy()
        scales = (0.2, 0.3, 0.1)
        self.parameters = tuple(
            Parameter(name, "1", null, smallest, largest, scale)
            for name, null, smallest, largest, scale in zip("abc", start, low, high, scales, strict=False)
        )
        self.measured_only = np.array([False, False, True])[: len(start)]
        self.nominal = np.zeros(len(start), dtype=bool)
        self.impact, self.simulated = impact, 0.0
        self.requests: list[SimulationRequest] = []
        self.windows: Any = []
        for offset in offsets:
            clock = np.linspace(0.0, 1.0, count)
            seen = oscillation(TRUTH, np.array([1.0, 0.5]) + offset * SPREAD, clock) + TRUTH[2]
            seen += noise * rng.normal(0, NOISE, count)
            seen[count // 3] += outlier * NOISE
            seen += impact * NOISE * self.jump(offset[0] * SPREAD[0]) * clock
            self.windows.append(SyntheticWindow(clock, seen, SPREAD, smooth=not impact))

    @staticmethod
    def jump(position: float) -> float:
        """Return what an impact adds."""
        return float(np.floor(3 * position / SPREAD[0]))

    def only(self, windows: Sequence[int]) -> SyntheticPrediction:
        found = copy(self)
        found.windows = [self.windows[w] for w in windows]
        return found

    def readers(self, trials: Sequence[SimulationRequest]) -> list[Callable[[], np.ndarray]]:
        return [self.reader(trial) for trial in trials]

    def reader(self, trial: SimulationRequest) -> Callable[[], np.ndarray]:
        self.simulated += 1.0
        self.requests.append(trial)
        offset = np.zeros(2) if trial.offset is None else trial.offset
        clock = self.windows[trial.window].clock
        given = np.where(np.isfinite(trial.values), trial.values, 0.0)
        values = np.concatenate([given, TRUTH[len(given) :]])
        predicted = oscillation(values, np.array([1.0, 0.5]) + offset, clock)
        predicted = predicted + self.impact * NOISE * self.jump(offset[0]) * clock
        return lambda: predicted

    def observed(self, window: int, reader: Callable[[], np.ndarray], values: np.ndarray) -> np.ndarray:
        shift = values[2] if len(values) > 2 else TRUTH[2]
        return (self.windows[window].measured - reader() - shift) / NOISE

    def residuals(self, trials: Sequence[SimulationRequest]) -> list[np.ndarray]:
        return [self.observed(t.window, r, t.values) for t, r in zip(trials, self.readers(trials), strict=True)]

    def courses(self, trials: Sequence[SimulationRequest], time: float | None = None) -> list[Any]:
        del time
        assert not trials  # windows are too short for errors to fade in them
        return []
