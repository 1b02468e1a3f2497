"""The initial states of windows, each window by itself, at fixed parameters.

Damped steps along derivatives (Levenberg, Marquardt) find them where motion is smooth. An impact turns small
differences into large ones and, in steps of time, into jumps: there steps of several sizes, draws and new beginnings
help on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.fit.effects.fading import ReferenceSimulation, is_long, residuals_near
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.fit.effects.robust import far, huber, huber_limit, huber_weight, trust

DAMPINGS = (1e-3, 3e-2, 3e-1, 3.0, 30.0)
"""Dampings that are tried on initial states."""
PROBE = (0.003, 1.0)
"""Bounds of the step of a finite difference of the initial state, in units of its spread."""
PROBE_FIRST = 0.3
"""The step at first."""
SEEN = (1.0, 3.0, 0.3)
"""Mean change of the residuals that such a step aims at, in units of noise: an impact turns a small difference into a
large one, and is straight over a small one only. The next one is taken where an odd window gets no further."""
DRAWS = (0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)
"""Spread of initial states that are drawn where derivatives lead no further, in standard deviations of the fit."""
ROUNDS = 12
"""How often the dependence on the initial states is computed, as long as it still helps."""
ODD = 1.2
"""A window whose residual is this many times that of the others has probably not found its initial state: only for
such ones more is tried than a few damped steps."""
BEGINNINGS, WIDTHS = 128, (0.5, 1.0, 2.0)
"""Such a window is begun anew from the likeliest of so many initial states, drawn with these spreads in turn."""
FALL = 3e-3
"""A window's initial state is found once a step lowers its cost by less than this share."""
PROSPECT = 3.0
"""How many times the last fall of a cost the falls to come may add up to."""


@dataclass(frozen=True)
class _Look:
    """What small changes of one window's initial state do."""

    columns: np.ndarray
    """dr / d(offset / spread), shape (n, 2 nv)."""
    offsets: np.ndarray
    """The states tried, one a row, shape (2 nv, 2 nv)."""
    residuals: list[np.ndarray]
    """Their residuals, each (n,)."""


class StartSearch:
    """Looks for the initial states of the windows of a prediction."""

    def __init__(self, prediction: Prediction) -> None:
        """Prepare to look for those of `prediction`."""
        self.p = prediction
        self.probe = [np.full(len(w.spread), PROBE_FIRST) for w in prediction.windows]
        self.fading = [np.full(len(w.spread), is_long(prediction, i)) for i, w in enumerate(prediction.windows)]
        """Components of each window's initial state whose errors have faded so far."""

    def trials(self, values: np.ndarray, offsets: Sequence[np.ndarray]) -> list[SimulationRequest]:
        """Return one trial a window."""
        return [SimulationRequest(w, values, offset * self.p.windows[w].spread) for w, offset in enumerate(offsets)]

    def look_around(
        self, values: np.ndarray, offsets: Sequence[np.ndarray], residuals: Sequence[np.ndarray], windows: Sequence[int]
    ) -> list[_Look]:
        """Move each component of the initial state of some windows a little, and see what that does.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states of all windows, in units of their spread.
            residuals: Residuals of all windows there.
            windows: Which ones to look at.
        """
        trials, moved, hoped = [], [], []
        for w in windows:
            moved.append(offsets[w] + np.diag(self.probe[w]))
            trials += [SimulationRequest(w, values, row * self.p.windows[w].spread) for row in moved[-1]]
            hoped += self.fading[w].tolist()
        found, faded = residuals_near(self.p, self.known(values, offsets, residuals, windows), trials, hoped)
        looks, at = [], 0
        for w, offset in zip(windows, moved, strict=True):
            seen = found[at : at + len(offset)]
            self.fading[w] &= faded[at : at + len(offset)]
            at += len(offset)
            columns = np.stack([(r - residuals[w]) / h for r, h in zip(seen, self.probe[w], strict=True)], axis=1)
            wild = np.abs(columns).max(axis=0) * self.probe[w] > 0.5 * np.abs(residuals[w]).max() + 1e2
            columns[:, wild] = 0.0
            looks.append(_Look(columns, offset, seen))
        return looks

    def known(
        self, values: np.ndarray, offsets: Sequence[np.ndarray], residuals: Sequence[np.ndarray], windows: Sequence[int]
    ) -> dict[int, ReferenceSimulation]:
        """Return the simulations of some windows that others are close to."""
        return {
            w: ReferenceSimulation(SimulationRequest(w, values, offsets[w] * self.p.windows[w].spread), residuals[w])
            for w in windows
        }

    def refined(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        windows: Sequence[int],
        rounds: int,
        rival: Mapping[int, float] | None = None,
    ) -> tuple[list[np.ndarray], dict[int, np.ndarray], list[np.ndarray]]:
        """Fit the initial states of some windows; returns all states, the dependence of those, and all residuals.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states of all windows, in units of their spread.
            windows: Whose initial states are fitted.
            rounds: How often the dependence on the initial states is computed at most.
            rival: Costs that windows are to get below, or else are of no use; they are given up where the falls of
                their costs do not promise it.
        """
        offsets, starts, rng = [np.array(o) for o in offsets], {}, np.random.default_rng(0)
        residuals = self.p.residuals(self.trials(values, offsets))
        self._settle(values, offsets, residuals, starts, windows, rounds, rng, rival or {})
        size = np.array([np.sqrt(np.mean(r**2)) for r in residuals])
        odd = [w for w in windows if size[w] > ODD * max(1.0, float(np.median(size)))] if rounds == ROUNDS else []
        if odd and BEGINNINGS:
            found, limit = dict(starts), huber_limit(residuals)
            begin, there = self._drawn(values, offsets, residuals, odd, limit, rng)
            beaten = {w: start_cost(residuals[w], offsets[w], limit) for w in odd}
            self._settle(values, begin, there, found, odd, rounds, rng, beaten)
            for w in odd:
                if start_cost(there[w], begin[w], limit) < beaten[w]:
                    offsets[w], residuals[w], starts[w] = begin[w], there[w], found[w]
        return offsets, starts, residuals

    def _drawn(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        residuals: Sequence[np.ndarray],
        windows: Sequence[int],
        limit: float,
        rng: np.random.Generator,
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return all initial states with the likeliest of some drawn ones for some windows, and all residuals."""
        begin, there = list(offsets), list(residuals)
        widths = np.resize(WIDTHS, (BEGINNINGS, 1))
        drawn = [widths * rng.normal(size=(BEGINNINGS, len(offsets[w]))) for w in windows]
        rows = [
            SimulationRequest(w, values, o * self.p.windows[w].spread)
            for w, of in zip(windows, drawn, strict=True)
            for o in of
        ]
        seen = self.p.residuals(rows)
        for k, w in enumerate(windows):
            mine = seen[k * BEGINNINGS : (k + 1) * BEGINNINGS]
            best = int(np.argmin([start_cost(r, o, limit) for r, o in zip(mine, drawn[k], strict=True)]))
            begin[w], there[w] = drawn[k][best], mine[best]
        return begin, there

    def _settle(
        self,
        values: np.ndarray,
        offsets: list[np.ndarray],
        residuals: list[np.ndarray],
        starts: dict[int, np.ndarray],
        windows: Sequence[int],
        rounds: int,
        rng: np.random.Generator,
        rival: Mapping[int, float],
    ) -> None:
        """Take the initial states of some windows to where no step helps any more; writes into what it is given."""
        unsettled, aim = list(windows), [0] * len(offsets)
        odd = ODD * max(1.0, float(np.median([np.sqrt(np.mean(r**2)) for r in residuals])))
        for _ in range(rounds):
            looks = self.look_around(values, offsets, residuals, unsettled)
            limit = huber_limit(residuals)
            tried, rows, hoped = [], [], []
            for w, look in zip(unsettled, looks, strict=True):
                there = [offsets[w] + start_step(residuals[w], look.columns, offsets[w], limit, d) for d in DAMPINGS]
                if np.mean(residuals[w] ** 2) > odd**2:
                    there += _around(residuals[w], look.columns, offsets[w], there[0], limit, rng)
                tried.append(there)
                rows += [SimulationRequest(w, values, o * self.p.windows[w].spread) for o in there]
                hoped += [bool(self.fading[w].all())] * len(there)
            known = self.known(values, offsets, residuals, unsettled)
            (found, _), moving, at = residuals_near(self.p, known, rows, hoped), [], 0
            for k, (w, look) in enumerate(zip(unsettled, looks, strict=True)):
                starts[w] = look.columns
                there = [*tried[k], *look.offsets]
                seen = [*found[at : at + len(tried[k])], *look.residuals]
                at += len(tried[k])
                cost = start_cost(residuals[w], offsets[w], limit)
                costs = [start_cost(r, o, limit) for r, o in zip(seen, there, strict=True)]
                best = int(np.argmin(costs))
                if costs[best] < cost:
                    offsets[w], residuals[w] = there[best], seen[best]
                if costs[best] > (1 - FALL) * cost:
                    aim[w] += 1 if np.mean(residuals[w] ** 2) > odd**2 else len(SEEN)
                short = min(costs[best], cost) - rival.get(w, np.inf)
                if aim[w] < len(SEEN) and short <= PROSPECT * max(cost - costs[best], 0.0):
                    moving.append(w)
                    change = np.sqrt(np.mean(look.columns**2, axis=0))
                    self.probe[w] = np.clip(SEEN[aim[w]] / np.maximum(change, 1e-12), *PROBE)
            unsettled = moving
            if not unsettled:
                break


def start_cost(residual: np.ndarray, offset: np.ndarray, limit: float) -> float:
    """Return the cost of one window with the prior of its initial state."""
    return float(huber(residual, limit).sum()) + far(offset)


def start_step(residual: np.ndarray, start: np.ndarray, offset: np.ndarray, limit: float, damping: float) -> np.ndarray:
    """Return the damped step of one window's initial state, in units of its spread, shape (2 nv,)."""
    weighted = start.T * huber_weight(residual, limit)
    normal = weighted @ start
    near = trust(offset)
    normal += np.diag(near + damping * (near + np.diag(normal)))
    return -np.linalg.solve(normal, weighted @ residual + near * offset)


def _around(
    residual: np.ndarray,
    start: np.ndarray,
    offset: np.ndarray,
    step: np.ndarray,
    limit: float,
    rng: np.random.Generator,
) -> list[np.ndarray]:
    """Return initial states drawn about one and about where a step leads, farthest where residuals tell least.

    Time steps cut an impact's course into teeth, each with a minimum of its own: derivatives do not lead from one to
    the next, draws do.
    """
    weighted = start.T * huber_weight(residual, limit)
    factor = np.linalg.cholesky(weighted @ start + np.diag(trust(offset)))
    return [
        centre + size * np.linalg.solve(factor.T, rng.normal(size=len(offset)))
        for size in DRAWS
        for centre in (offset, step)
    ]
