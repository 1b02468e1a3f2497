"""The initial states of windows, each window by itself, at fixed parameters.

Damped steps along derivatives (Levenberg, Marquardt) find them where motion is smooth. An impact amplifies small
differences and, with discrete time steps, makes residuals jump: there steps of several sizes, random samples and
restarts are tried as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from concent_warp.checks import Count, Positive
from concent_warp.fit.effects.fading import FadingCfg, ReferenceSimulation, is_long, residuals_near
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.fit.effects.robust import RobustLossCfg, cauchy_cost, cauchy_weight, huber, huber_limit, huber_weight


@dataclass(frozen=True)
class InitialStateCfg:
    """Settings of the search for the initial states of windows.

    The values were chosen on recordings with impacts: see `tests/fit/effects/test_least_squares.py` for the share of
    initial states that are found.
    """

    iterations: int = 12
    """Most computations of the derivatives with respect to the initial states [-]."""
    min_fall: float = 3e-3
    """Relative fall of a window's cost below which its initial state counts as found [-]."""
    max_expected_falls: float = 3.0
    """Multiple of a window's last fall of the cost that must suffice to reach its bound, or its fit ends [-]."""
    dampings: tuple[Positive, ...] = (1e-3, 3e-2, 3e-1, 3.0, 30.0)
    """Levenberg-Marquardt dampings that are tried in each iteration, relative to the curvature [-]."""
    reliable_share: float = 0.9
    """Share of the predicted fall of a window's cost that the step with the first damping must reach to be taken
    without trying the others [-], where motion is smooth: the derivatives are then right to about a tenth."""
    known_share: float = 0.5
    """Share of the predicted fall that a step along derivatives from nearby must reach, or these are computed anew [-].
    Empirical."""
    settled_fall: float = 0.01
    """Predicted fall of a window's cost below which its initial state counts as found without another simulation, where
    motion is smooth [cost]: a hundredth of the log likelihood's unit."""
    settled_share: float = 1e-5
    """The same in units of the window's cost, in addition [-]. Empirical."""
    first_step: Positive = 0.3
    """First step of a finite difference, in units of the state's spread [-]."""
    smallest_step: Positive = 0.003
    """Smallest step of a finite difference, in units of the state's spread [-]."""
    largest_step: Positive = 1.0
    """Largest step of a finite difference, in units of the state's spread [-]."""
    target_changes: tuple[Positive, ...] = (1.0, 3.0, 0.3)
    """Mean changes of the residuals that finite differences aim at, in units of noise [-]. An impact is linear over a
    small difference only, so the next value is taken where an outlying window makes no progress."""
    outlier_ratio: float = 1.2
    """Residual of a window over the median of all windows beyond which its initial state counts as not found [-]:
    samples are tried for such windows in addition to damped steps."""
    sample_spreads: tuple[float, ...] = (0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)
    """Spreads of the states sampled about an iterate, in standard deviations of the linear fit [-]; empty for none."""
    restart_ratio: float = 1.4
    """The same beyond which a window is restarted from other samples [-]: errors of contact models leave as much as
    `outlier_ratio` in good fits, too. Empirical."""
    restart_samples: int = 128
    """States sampled about the measured one, of which the likeliest restarts an outlying window; 0 for none."""
    restart_trials: Count = 16
    """Of these, how many tell whether the initial state matters [-]: a window is restarted from none where half of them
    cost no more than `restart_rise` beyond the least cost."""
    restart_rise: Positive = 0.5
    """Share of the least cost of a window by which half of these samples must exceed it [-]: where a model lacks an
    effect, that leaves more than any initial state does, and others end where the search has ended already.
    Empirical."""
    restart_spreads: tuple[float, ...] = (0.5, 1.0, 2.0)
    """Spreads of these samples, used in turn, in units of the state's spread [-]."""
    fading: FadingCfg = field(default_factory=FadingCfg)
    """When errors of an initial state count as faded."""


@dataclass(frozen=True)
class _FiniteDifferences:
    """Finite differences of one window by its initial state."""

    columns: np.ndarray
    """dr / d(offset / spread), shape (n, 2 nv)."""
    offsets: np.ndarray
    """The states tried, one a row, shape (2 nv, 2 nv)."""
    residuals: list[np.ndarray]
    """Their residuals, each (n,)."""


@dataclass(frozen=True)
class _PredictedStep:
    """A step of one window's initial state."""

    move: np.ndarray
    """In units of the state's spread, shape (2 nv,)."""
    fall: float
    """Predicted fall of the window's cost."""


class InitialStateSearch:
    """Fits the initial states of the windows of a prediction."""

    def __init__(
        self, prediction: Prediction, cfg: InitialStateCfg | None = None, robust: RobustLossCfg | None = None
    ) -> None:
        """Prepare to fit those of `prediction`."""
        self.p, self.cfg, self.robust = prediction, cfg or InitialStateCfg(), robust or RobustLossCfg()
        self.steps = [np.full(len(w.spread), self.cfg.first_step) for w in prediction.windows]
        self.fading = [
            np.full(len(w.spread), is_long(prediction, i, self.cfg.fading)) for i, w in enumerate(prediction.windows)
        ]
        """Components of each window's initial state whose errors have faded so far."""

    def trials(self, values: np.ndarray, offsets: Sequence[np.ndarray]) -> list[SimulationRequest]:
        """Return one simulation for each window."""
        return [SimulationRequest(w, values, offset * self.p.windows[w].spread) for w, offset in enumerate(offsets)]

    def finite_differences(
        self, values: np.ndarray, offsets: Sequence[np.ndarray], residuals: Sequence[np.ndarray], windows: Sequence[int]
    ) -> list[_FiniteDifferences]:
        """Return finite differences of the residuals of some windows by each component of the initial state.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states of all windows, in units of their spread.
            residuals: Residuals of all windows there.
            windows: Indices of the windows.
        """
        trials, moved, may_fade = [], [], []
        for w in windows:
            moved.append(offsets[w] + np.diag(self.steps[w]))
            trials += [SimulationRequest(w, values, row * self.p.windows[w].spread) for row in moved[-1]]
            may_fade += self.fading[w].tolist()
        references = self.references(values, offsets, residuals, windows)
        found, faded = residuals_near(self.p, references, trials, may_fade, self.cfg.fading)
        differences, at = [], 0
        for w, offset in zip(windows, moved, strict=True):
            seen = found[at : at + len(offset)]
            self.fading[w] &= faded[at : at + len(offset)]
            at += len(offset)
            columns = np.stack([(r - residuals[w]) / h for r, h in zip(seen, self.steps[w], strict=True)], axis=1)
            invalid = np.abs(columns).max(axis=0) * self.steps[w] > 0.5 * np.abs(residuals[w]).max() + 1e2
            columns[:, invalid] = 0.0
            differences.append(_FiniteDifferences(columns, offset, seen))
        return differences

    def references(
        self, values: np.ndarray, offsets: Sequence[np.ndarray], residuals: Sequence[np.ndarray], windows: Sequence[int]
    ) -> dict[int, ReferenceSimulation]:
        """Return the simulations of some windows at given initial states, as references for `residuals_near`."""
        return {
            w: ReferenceSimulation(SimulationRequest(w, values, offsets[w] * self.p.windows[w].spread), residuals[w])
            for w in windows
        }

    def refined(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        windows: Sequence[int],
        iterations: int,
        upper_bounds: Mapping[int, float] | None = None,
        known: Mapping[int, np.ndarray] | None = None,
    ) -> tuple[list[np.ndarray], dict[int, np.ndarray], list[np.ndarray]]:
        """Fit the initial states of some windows; returns all states, the derivatives of those, and all residuals.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states of all windows, in units of their spread.
            windows: Whose initial states are fitted.
            iterations: Most computations of the derivatives with respect to the initial states.
            upper_bounds: Costs by window to fall below; the fit of a window ends where the falls of its cost do not
                suffice for it, see `InitialStateCfg.max_expected_falls`.
            known: Derivatives by window from a point nearby, which serve for as long as steps along them lower the cost
                as they predict; a window with a bound is not found before its own predict no more.
        """
        offsets, starts, rng = [np.array(o) for o in offsets], {}, np.random.default_rng(0)
        residuals = self.p.residuals(self.trials(values, offsets))
        self._iterate(values, offsets, residuals, starts, windows, iterations, rng, upper_bounds or {}, known)
        size = np.array([np.sqrt(np.mean(r**2)) for r in residuals])
        outlying = (
            [
                w
                for w in windows
                if size[w] > self.cfg.restart_ratio * max(1.0, float(np.median(size))) and not self.p.windows[w].smooth
            ]
            if iterations == self.cfg.iterations
            else []
        )
        if outlying and self.cfg.restart_samples:
            found, limit = dict(starts), huber_limit(residuals, self.robust)
            begin, there, outlying = self._restarts(values, offsets, residuals, outlying, limit, rng)
            beaten = {w: start_cost(residuals[w], offsets[w], limit, self.robust) for w in outlying}
            self._iterate(values, begin, there, found, outlying, iterations, rng, beaten)
            for w in outlying:
                if start_cost(there[w], begin[w], limit, self.robust) < beaten[w]:
                    offsets[w], residuals[w], starts[w] = begin[w], there[w], found[w]
        return offsets, starts, residuals

    def _restarts(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        residuals: Sequence[np.ndarray],
        windows: Sequence[int],
        limit: float,
        rng: np.random.Generator,
    ) -> tuple[list[np.ndarray], list[np.ndarray], list[int]]:
        """Return all initial states, with the likeliest of random samples for some windows, and all residuals.

        The last is for which of these windows there are samples: not for those whose cost they hardly change.
        """
        count = self.cfg.restart_samples
        first = min(self.cfg.restart_trials, count)
        begin, there = list(offsets), list(residuals)
        widths = np.resize(self.cfg.restart_spreads, (count, 1))
        samples = {w: widths * rng.normal(size=(count, len(offsets[w]))) for w in windows}
        seen, chosen = self._residuals_of({w: of[:first] for w, of in samples.items()}, values), []
        for w in windows:
            costs = [start_cost(r, o, limit, self.robust) for r, o in zip(seen[w], samples[w], strict=False)]
            least = min(start_cost(residuals[w], offsets[w], limit, self.robust), *costs)
            if np.median(costs) > (1 + self.cfg.restart_rise) * least:
                chosen.append(w)
        more = self._residuals_of({w: samples[w][first:] for w in chosen}, values)
        for w in chosen:
            mine = [*seen[w], *more[w]]
            best = int(np.argmin([start_cost(r, o, limit, self.robust) for r, o in zip(mine, samples[w], strict=True)]))
            begin[w], there[w] = samples[w][best], mine[best]
        return begin, there, chosen

    def _residuals_of(self, samples: Mapping[int, np.ndarray], values: np.ndarray) -> dict[int, list[np.ndarray]]:
        """Return the residuals of each window at some initial states, one a row, by window."""
        rows = [SimulationRequest(w, values, o * self.p.windows[w].spread) for w, of in samples.items() for o in of]
        found = iter(self.p.residuals(rows))
        return {w: [next(found) for _ in of] for w, of in samples.items()}

    def _iterate(
        self,
        values: np.ndarray,
        offsets: list[np.ndarray],
        residuals: list[np.ndarray],
        starts: dict[int, np.ndarray],
        windows: Sequence[int],
        iterations: int,
        rng: np.random.Generator,
        upper_bounds: Mapping[int, float],
        known: Mapping[int, np.ndarray] | None = None,
    ) -> None:
        """Iterate the initial states of some windows until no step lowers their cost; changes its arguments."""
        cfg, known = self.cfg, dict(known or {})
        remaining, aim = list(windows), [0] * len(offsets)
        outlying = cfg.outlier_ratio * max(1.0, float(np.median([np.sqrt(np.mean(r**2)) for r in residuals])))
        for _ in range(iterations):
            differences = self._differences(values, offsets, residuals, remaining, known)
            limit = huber_limit(residuals, self.robust)
            costs_before = {w: start_cost(residuals[w], offsets[w], limit, self.robust) for w in remaining}
            steps = [
                self._step(residuals[w], difference.columns, offsets[w], limit)
                for w, difference in zip(remaining, differences, strict=True)
            ]
            tried: list[list[np.ndarray]] = []
            for w, difference, step in zip(remaining, differences, steps, strict=True):
                there: list[np.ndarray] = []
                if w in known:
                    if not self._is_negligible(step, costs_before[w]):
                        there = self._damped(residuals[w], difference.columns, offsets[w], limit)[::2]
                elif np.mean(residuals[w] ** 2) > outlying**2 and not self.p.windows[w].smooth:
                    there = self._damped(residuals[w], difference.columns, offsets[w], limit)
                    there += self._samples_about(residuals[w], difference.columns, offsets[w], there[0], limit, rng)
                elif not self.p.windows[w].smooth:
                    there = self._damped(residuals[w], difference.columns, offsets[w], limit)
                elif not self._is_settled(step, costs_before[w]):
                    there = [offsets[w] + step.move]
                tried.append(there)
            found = self._residuals_at(values, offsets, residuals, remaining, tried)
            # The other dampings, where the first one disappoints.
            rest: list[list[np.ndarray]] = [[] for _ in remaining]
            reliable = [False] * len(remaining)
            for k, (w, difference) in enumerate(zip(remaining, differences, strict=True)):
                if w in known or not self.p.windows[w].smooth or len(tried[k]) != 1:
                    continue
                fall = costs_before[w] - start_cost(found[k][0], tried[k][0], limit, self.robust)
                reliable[k] = fall >= cfg.reliable_share * steps[k].fall
                if not reliable[k]:
                    rest[k] = self._damped(residuals[w], difference.columns, offsets[w], limit)[1:]
            more = self._residuals_at(values, offsets, residuals, remaining, rest)
            moving = []
            for k, (w, difference) in enumerate(zip(remaining, differences, strict=True)):
                starts[w] = difference.columns
                there = [*tried[k], *rest[k], *difference.offsets]
                seen = [*found[k], *more[k], *difference.residuals]
                cost = costs_before[w]
                costs = [start_cost(r, o, limit, self.robust) for r, o in zip(seen, there, strict=True)]
                if w in known:
                    fall = max(cost - min(costs, default=cost), 0.0)
                    if fall > 0:
                        best = int(np.argmin(costs))
                        offsets[w], residuals[w] = there[best], seen[best]
                    if not tried[k]:
                        if w in upper_bounds:  # another start: the derivatives may be those of another valley
                            del known[w]
                            moving.append(w)
                        continue
                    if fall < cfg.known_share * steps[k].fall:
                        del known[w]
                    moving.append(w)
                    continue
                best = int(np.argmin(costs))
                if costs[best] < cost:
                    offsets[w], residuals[w] = there[best], seen[best]
                if costs[best] > (1 - cfg.min_fall) * cost:
                    aim[w] += 1 if np.mean(residuals[w] ** 2) > outlying**2 else len(cfg.target_changes)
                short = min(costs[best], cost) - upper_bounds.get(w, np.inf)
                if reliable[k]:
                    step = self._step(residuals[w], difference.columns, offsets[w], limit)
                    if self._is_settled(step, costs[best]):
                        continue
                if aim[w] < len(cfg.target_changes) and short <= cfg.max_expected_falls * max(cost - costs[best], 0.0):
                    moving.append(w)
                    change = np.sqrt(np.mean(difference.columns**2, axis=0))
                    self.steps[w] = np.clip(
                        cfg.target_changes[aim[w]] / np.maximum(change, 1e-12), cfg.smallest_step, cfg.largest_step
                    )
            remaining = moving
            if not remaining:
                break

    def _step(self, residual: np.ndarray, columns: np.ndarray, offset: np.ndarray, limit: float) -> _PredictedStep:
        """Return the least damped step of a window, with the fall of the cost that its derivatives predict."""
        move = start_step(residual, columns, offset, limit, self.cfg.dampings[0], self.robust)
        after = start_cost(residual + columns @ move, offset + move, limit, self.robust)
        return _PredictedStep(move, start_cost(residual, offset, limit, self.robust) - after)

    def _differences(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        residuals: Sequence[np.ndarray],
        windows: Sequence[int],
        known: Mapping[int, np.ndarray],
    ) -> list[_FiniteDifferences]:
        """Return finite differences of some windows; derivatives that are known, without simulations, for others."""
        fresh = [w for w in windows if w not in known]
        found = dict(zip(fresh, self.finite_differences(values, offsets, residuals, fresh), strict=True))
        none = np.empty((0, 0))
        return [found[w] if w in found else _FiniteDifferences(known[w], none, []) for w in windows]

    def _is_negligible(self, step: _PredictedStep, cost: float) -> bool:
        """Return whether a step along derivatives from nearby promises too little to be simulated."""
        return step.fall <= max(self.cfg.settled_fall, self.cfg.min_fall * cost)

    def _is_settled(self, step: _PredictedStep, cost: float) -> bool:
        """Return whether a step promises too little to be simulated in a window of smooth motion with some cost."""
        return step.fall <= self.cfg.settled_fall + self.cfg.settled_share * cost

    def _damped(self, residual: np.ndarray, columns: np.ndarray, offset: np.ndarray, limit: float) -> list[np.ndarray]:
        """Return the initial states to which steps of each damping lead."""
        return [offset + start_step(residual, columns, offset, limit, d, self.robust) for d in self.cfg.dampings]

    def _residuals_at(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        residuals: Sequence[np.ndarray],
        windows: Sequence[int],
        tried: Sequence[Sequence[np.ndarray]],
    ) -> list[list[np.ndarray]]:
        """Return the residuals of some windows at other initial states, a list for each window.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states of all windows.
            residuals: Residuals of all windows there.
            windows: Indices of the windows.
            tried: Errors of the initial states to try, a list for each of them.
        """
        rows, may_fade = [], []
        for w, there in zip(windows, tried, strict=True):
            rows += [SimulationRequest(w, values, o * self.p.windows[w].spread) for o in there]
            may_fade += [bool(self.fading[w].all())] * len(there)
        if not rows:
            return [[] for _ in tried]
        references = self.references(values, offsets, residuals, windows)
        found, _ = residuals_near(self.p, references, rows, may_fade, self.cfg.fading)
        ends = np.cumsum([0, *(len(there) for there in tried)])
        return [found[a:b] for a, b in pairwise(ends)]

    def _samples_about(
        self,
        residual: np.ndarray,
        start: np.ndarray,
        offset: np.ndarray,
        step: np.ndarray,
        limit: float,
        rng: np.random.Generator,
    ) -> list[np.ndarray]:
        """Return initial states sampled about one and about where a step leads, farthest where residuals depend least.

        With discrete time steps the cost of an impact has many local minima; derivatives do not lead from one to the
        next.
        """
        weighted = start.T * huber_weight(residual, limit)
        factor = np.linalg.cholesky(weighted @ start + np.diag(cauchy_weight(offset, self.robust)))
        return [
            centre + size * np.linalg.solve(factor.T, rng.normal(size=len(offset)))
            for size in self.cfg.sample_spreads
            for centre in (offset, step)
        ]


def start_cost(residual: np.ndarray, offset: np.ndarray, limit: float, cfg: RobustLossCfg | None = None) -> float:
    """Return the cost of one window with the prior of its initial state."""
    return float(huber(residual, limit).sum()) + cauchy_cost(offset, cfg)


def start_step(
    residual: np.ndarray,
    start: np.ndarray,
    offset: np.ndarray,
    limit: float,
    damping: float,
    cfg: RobustLossCfg | None = None,
) -> np.ndarray:
    """Return the damped step of one window's initial state, in units of its spread, shape (2 nv,)."""
    weighted = start.T * huber_weight(residual, limit)
    normal = weighted @ start
    near = cauchy_weight(offset, cfg)
    normal += np.diag(near + damping * (near + np.diag(normal)))
    return -np.linalg.solve(normal, weighted @ residual + near * offset)
