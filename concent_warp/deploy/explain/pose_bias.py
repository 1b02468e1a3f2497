"""A constant error of the tracked poses of the manipulated object that explains trials.

If the tracker shows the object where it is not, the model, started from what is shown, lets it touch other bodies at
other times and places than it did. The error under which short windows of the trials (`contact_windows`) are foreseen
best is searched for by the cross-entropy method (Rubinstein and Kroese 2004).

A search always finds something better than no error on the trials that it saw. So it is made on each half of the
trials and judged on the other half: the gains there, trial by trial, against none by the exact sign-flip test.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from concent_warp.deploy.explain.cfg import PoseBiasCfg
from concent_warp.deploy.explain.contact_start import moved
from concent_warp.deploy.explain.contact_windows import TrialWindows, WindowSimulation
from concent_warp.deploy.explain.measured_start import MeasuredStart

MOST_FLIPPED = 12
"""Most values whose signs are flipped in all ways; beyond, in as many random ones."""


@dataclass(frozen=True)
class PoseBias:
    """An error of tracked poses, in common to T trials."""

    value: np.ndarray
    """Tracked less true: position [m] and rotation vector, world frame, shape (6,)."""
    std: np.ndarray
    """Standard deviation of the best samples, shape (6,)."""
    noise: np.ndarray
    """Standard deviation of single tracked poses, shape (6,)."""
    before: np.ndarray
    """Mean loss of the windows of each trial without it, shape (T,)."""
    after: np.ndarray
    """The same with it, shape (T,)."""
    gain: np.ndarray
    """By how much the loss is smaller with the error found in other trials, shape (G,); of each trial, or of pieces of
    it where trials are few."""
    p: float
    """Probability of such gains where there is no error [-]."""

    @property
    def size(self) -> float:
        """Largest part of it over the noise of the tracker [-]."""
        return float((np.abs(self.value) / self.noise).max())

    @property
    def explained(self) -> np.ndarray:
        """Share of each trial's loss that it removes, shape (T,)."""
        return 1 - self.after / np.maximum(self.before, 1e-9)

    @property
    def held_out(self) -> float:
        """Mean gain in trials that the error was not fitted to over the loss without it [-]."""
        return float(self.gain.mean() / max(float(self.before.mean()), 1e-9))

    def of_first(self, count: int) -> PoseBias:
        """Return it with the losses of the first trials only."""
        return replace(self, before=self.before[:count], after=self.after[:count])


class PoseBiasSearch:
    """Searches for an error of tracked poses in trials."""

    def __init__(self, simulation: WindowSimulation, cfg: PoseBiasCfg, *, seed: int = 0) -> None:
        """Prepare.

        Args:
            simulation: Simulates the windows.
            cfg: Settings.
            seed: Seed of the samples.
        """
        self._simulation, self._cfg, self._seed = simulation, cfg, seed

    def run(self, trials: Sequence[TrialWindows], progress: Callable[[float], None] | None = None) -> PoseBias:
        """Return the error that explains trials best, and what it gains in trials that it was not fitted to.

        Args:
            trials: Windows of each.
            progress: Called with the share done, 0..1.
        """
        report = progress or _ignore
        units = self._units(trials)
        halves = [units[0::2], units[1::2]]
        found = []
        for k, half in enumerate(halves):
            part = half or units
            found.append(
                self._fit(part, self._guesses(), self._cfg.iterations, lambda s, k=k: report(0.4 * (k + s)))[0]
            )
        gains = np.zeros(len(units))
        for k, held_out in enumerate((halves[1], halves[0])):
            both = self._losses(held_out, np.stack([np.zeros(6), found[k]])) if held_out else np.zeros((2, 0))
            gains[1 - k :: 2] = both[0] - both[1]
        guesses = np.stack([*found, np.mean(found, axis=0), np.zeros(6)])
        value, std = self._fit(units, guesses, self._cfg.last_iterations, lambda s: report(0.8 + 0.2 * s))
        both = self._losses(trials, np.stack([np.zeros(6), value]))
        noise = np.repeat(trials[0].pose_std, 3)
        return PoseBias(value, std, noise, both[0], both[1], gains, sign_flip(gains, self._seed))

    def _units(self, trials: Sequence[TrialWindows]) -> list[TrialWindows]:
        """Return what counts as one independent piece of evidence: trials, or pieces of them where they are few."""
        parts = -(-self._cfg.least_units // len(trials))
        found = []
        for k in range(parts):
            for trial in trials:
                rows = np.array_split(np.arange(len(trial)), parts)[k]
                if len(rows):
                    found.append(trial.some(rows.tolist()))
        return found

    def _guesses(self) -> np.ndarray:
        """Return no error, and errors along and about single axes, shape (N, 6)."""
        found = [np.zeros(6)]
        for axis in range(6):
            for size in self._cfg.positions if axis < 3 else self._cfg.orientations:
                found += [sign * size * np.eye(6)[axis] for sign in (1, -1)]
        return np.array(found)

    def _fit(
        self, units: Sequence[TrialWindows], guesses: np.ndarray, iterations: int, progress: Callable[[float], None]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the error (6,) of the least mean loss, and the standard deviation of the best samples (6,)."""
        cfg, rng = self._cfg, np.random.default_rng(self._seed)
        floor, std = np.repeat(cfg.floor, 3), np.repeat((cfg.position, cfg.orientation), 3)
        cost = self._cost(units, guesses)
        best = mean = guesses[cost.argmin()]
        lowest = float(cost.min())
        for k in range(iterations):
            samples = np.concatenate([mean[None], mean + std * rng.normal(size=(cfg.samples, 6))])
            cost = self._cost(units, samples)
            order = np.argsort(cost)
            if cost[order[0]] < lowest:
                best, lowest = samples[order[0]], float(cost[order[0]])
            elite = samples[order[: cfg.elite]]
            mean, std = elite.mean(axis=0), np.maximum(elite.std(axis=0), floor)
            progress((k + 1) / iterations)
        return best, std

    def _cost(self, units: Sequence[TrialWindows], bias: np.ndarray) -> np.ndarray:
        """Return the mean loss under errors (N, 6), larger for large errors, shape (N,)."""
        prior = np.square(bias / np.repeat(self._cfg.prior, 3)).sum(axis=1)
        return self._losses(units, bias).mean(axis=1) + prior

    def _losses(self, trials: Sequence[TrialWindows], bias: np.ndarray) -> np.ndarray:
        """Return the mean loss of the windows of T trials under errors (N, 6), shape (N, T)."""
        return np.stack([self._simulation.losses(t, bias).mean(axis=1) for t in trials], axis=1)


def corrected(start: MeasuredStart, address: int, bias: np.ndarray) -> MeasuredStart:
    """Return a start whose manipulated object stands where it is if its tracked pose has an error (6,)."""
    qpos = start.qpos.copy()
    qpos[address : address + 7] = moved(start.qpos[address : address + 7], -bias)
    return replace(start, qpos=qpos)


def sign_flip(gains: np.ndarray, seed: int = 0) -> float:
    """Return the probability of a mean of gains (G,) as large if their signs were random (exact up to 12 of them)."""
    if not len(gains):
        return 1.0
    if len(gains) <= MOST_FLIPPED:
        signs = np.array(list(product((1, -1), repeat=len(gains))))
    else:
        signs = np.random.default_rng(seed).choice((1, -1), size=(2**MOST_FLIPPED, len(gains)))
        signs[0] = 1
    return float(((signs * gains).mean(axis=1) >= gains.mean() - 1e-12).mean())


def _ignore(_: float) -> None:
    """Show no progress."""
