"""Effect parameters and initial states by bounded, robust least squares.

Unknown are P parameters, common to all windows, and for each window the error of its initial state. The initial states
are eliminated window by window (Schur complement of the arrowhead normal equations: Bock 1983; Golub and Pereyra,
"Separable nonlinear least squares", Inverse Problems 19, 2003), so that a step costs P + 1 simulations of each window;
how residuals depend on the initial states is computed once and kept. Steps are damped (Levenberg, Marquardt). Residuals
count by Huber's loss about their own spread, so that a few outliers do not decide.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from concent_warp.fit.prediction import Prediction, Trial
from concent_warp.fit.robust import far, huber, huber_limit, huber_weight, trust

PRIOR = 10.0
"""Weak prior of a parameter, in units of its typical scale."""
STEP = 0.1
"""Step of a finite difference, in units of a parameter's typical scale, at first."""
WANTED = 3.0
"""Mean change of the residuals that a finite difference aims at, in units of noise: contacts make motion jump a little
from value to value, so that smaller steps measure the jumps."""


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
NOISE = 1.05
"""Residual over noise at which an initial state leaves nothing to be wished for."""
RESTARTS = 4
"""How often such a window is begun anew from a drawn initial state."""
LEAPS, LEAP, WORTH = 4, (1.0, 3.0), 5e-3
"""How often parameters are led on at most, over how many of their steps, and for what gain."""
REFIT_ROUNDS = 2
"""The same within a step of the parameters."""
FALL = 3e-3
"""A window's initial state is found once a step lowers its cost by less than this share."""


@dataclass(frozen=True)
class FitCfg:
    """Settings of a fit of effect parameters."""

    iterations: int = 10
    """Most steps."""
    tolerance: float = 1e-3
    """The fit ends when a step lowers the cost by less than this share."""
    damping: float = 1e-3
    """Damping at first, relative to the curvature."""
    refits: int = 3
    """How often initial states may be fitted anew where a step does not bring what it promised."""


@dataclass(frozen=True)
class Linear:
    """Residuals of one window about a point, with their dependence on the parameters."""

    residual: np.ndarray
    """Residuals r in units of noise, shape (n,)."""
    jacobian: np.ndarray
    """dr / d(parameter / scale), shape (n, P)."""


@dataclass(frozen=True)
class Fit:
    """Result of a fit."""

    values: np.ndarray
    """Parameters, shape (P,)."""
    offsets: tuple[np.ndarray, ...]
    """Errors of the initial states, one (2 nv,) a window."""
    cost: float
    """Robust cost, initial states and priors included."""
    linear: tuple[Linear, ...]
    """Residuals and sensitivities at the end, by window."""
    starts: tuple[np.ndarray, ...]
    """dr / d(initial state / spread), one (n, 2 nv) a window."""
    converged: bool
    simulated: float
    """Simulated time [s]."""


@dataclass(frozen=True)
class _State:
    """A point of a fit."""

    values: np.ndarray
    offsets: list[np.ndarray]
    cost: float
    starts: tuple[np.ndarray, ...]
    refits: int
    """How often initial states may still be fitted anew."""


@dataclass(frozen=True)
class _Look:
    """What small changes of one window's initial state do."""

    columns: np.ndarray
    """dr / d(offset / spread), shape (n, 2 nv)."""
    offsets: np.ndarray
    """The states tried, one a row, shape (2 nv, 2 nv)."""
    residuals: list[np.ndarray]
    """Their residuals, each (n,)."""


class Solver:
    """Fits the parameters of one prediction."""

    def __init__(self, prediction: Prediction, cfg: FitCfg | None = None) -> None:
        """Prepare to fit `prediction`."""
        self.p = prediction
        self.cfg = cfg or FitCfg()
        self.scale = np.array([q.scale for q in prediction.parameters])
        self.low = np.array([q.low for q in prediction.parameters])
        self.high = np.array([q.high for q in prediction.parameters])
        self.step = np.full(len(self.scale), STEP)
        self.probe = [np.full(len(w.spread), PROBE_FIRST) for w in prediction.windows]

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
        trials, moved = [], []
        for w in windows:
            moved.append(offsets[w] + np.diag(self.probe[w]))
            trials += [Trial(w, values, row * self.p.windows[w].spread) for row in moved[-1]]
        found, at = self.p.residuals(trials), 0
        looks = []
        for w, offset in zip(windows, moved, strict=True):
            seen = found[at : at + len(offset)]
            at += len(offset)
            columns = np.stack([(r - residuals[w]) / h for r, h in zip(seen, self.probe[w], strict=True)], axis=1)
            wild = np.abs(columns).max(axis=0) * self.probe[w] > 0.5 * np.abs(residuals[w]).max() + 1e2
            columns[:, wild] = 0.0
            looks.append(_Look(columns, offset, seen))
        return looks

    def refine_starts(
        self, values: np.ndarray, offsets: Sequence[np.ndarray], rounds: int = ROUNDS
    ) -> tuple[list[np.ndarray], tuple[np.ndarray, ...]]:
        """Fit the initial states alone, each window by itself, at fixed parameters.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states in units of their spread, where to start.
            rounds: How often the dependence on the initial states is computed at most.

        Returns:
            The errors of the initial states, and how the residuals depend on them at the last round, see `Fit.starts`.
        """
        found, starts, _ = self._refined(values, offsets, range(len(offsets)), rounds)
        return found, tuple(starts[w] for w in range(len(offsets)))

    def _refined(
        self, values: np.ndarray, offsets: Sequence[np.ndarray], windows: Sequence[int], rounds: int
    ) -> tuple[list[np.ndarray], dict[int, np.ndarray], list[np.ndarray]]:
        """Fit the initial states of some windows; returns all states, the dependence of those, and all residuals."""
        offsets, starts, rng = [np.array(o) for o in offsets], {}, np.random.default_rng(0)
        residuals = self.p.residuals(self.trials(values, offsets))
        self._settle(values, offsets, residuals, starts, windows, rounds, rng)
        for _ in range(RESTARTS if rounds == ROUNDS else 0):
            size = np.array([np.sqrt(np.mean(r**2)) for r in residuals])
            odd = [w for w in windows if size[w] > ODD * max(1.0, float(np.median(size)))]
            if not odd:
                break
            begin, found = list(offsets), dict(starts)
            for w in odd:
                begin[w] = rng.normal(size=len(offsets[w]))
            there = self.p.residuals(self.trials(values, begin))
            self._settle(values, begin, there, found, odd, rounds, rng)
            limit = huber_limit(residuals)
            for w in odd:
                if start_cost(there[w], begin[w], limit) < start_cost(residuals[w], offsets[w], limit):
                    offsets[w], residuals[w], starts[w] = begin[w], there[w], found[w]
        return offsets, starts, residuals

    def _settle(
        self,
        values: np.ndarray,
        offsets: list[np.ndarray],
        residuals: list[np.ndarray],
        starts: dict[int, np.ndarray],
        windows: Sequence[int],
        rounds: int,
        rng: np.random.Generator,
    ) -> None:
        """Take the initial states of some windows to where no step helps any more; writes into what it is given."""
        unsettled, aim = list(windows), [0] * len(offsets)
        odd = ODD * max(1.0, float(np.median([np.sqrt(np.mean(r**2)) for r in residuals])))
        for _ in range(rounds):
            looks = self.look_around(values, offsets, residuals, unsettled)
            limit = huber_limit(residuals)
            tried, rows = [], []
            for w, look in zip(unsettled, looks, strict=True):
                there = [offsets[w] + start_step(residuals[w], look.columns, offsets[w], limit, d) for d in DAMPINGS]
                if np.mean(residuals[w] ** 2) > odd**2:
                    there += around(residuals[w], look.columns, offsets[w], there[0], limit, rng)
                tried.append(there)
                rows += [Trial(w, values, o * self.p.windows[w].spread) for o in there]
            found, moving, at = self.p.residuals(rows), [], 0
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
                if aim[w] < len(SEEN):
                    moving.append(w)
                    change = np.sqrt(np.mean(look.columns**2, axis=0))
                    self.probe[w] = np.clip(SEEN[aim[w]] / np.maximum(change, 1e-12), *PROBE)
            unsettled = moving
            if not unsettled:
                break

    def polish(self, fit: Fit) -> Fit:
        """Return a fit taken up again from initial states fitted anew: from where they are, and from the measured ones.

        Initial states that have made up for a wrong parameter do not always find back on their own, and hold it there:
        so the parameters are then led on by steps after each of which the initial states are fitted anew.
        """
        measured = [np.zeros_like(o) for o in fit.offsets]
        fresh = self.better_starts(fit, [measured])
        best = self.fit(fresh.values, fresh.offsets, fresh.starts)
        for _ in range(LEAPS if len(fit.values) else 0):
            if np.mean(np.concatenate([piece.residual for piece in best.linear]) ** 2) < NOISE**2:
                break
            move, _ = self.solve(best.linear, best.starts, best.offsets, best.values, self.cfg.damping)
            found = best
            for size in LEAP:
                values = self.inside(best.values + size * move * self.scale)
                there = self.better_starts(replace(best, values=values), [measured])
                found = min(found, there, key=lambda f: f.cost)
            if found.cost > (1 - WORTH) * best.cost:
                break
            best = found
        return best

    def better_starts(self, fit: Fit, others: Sequence[Sequence[np.ndarray]]) -> Fit:
        """Return a fit at the same parameters with the best initial state of each window that is found.

        Args:
            fit: The fit.
            others: Errors of the initial states to set out from, besides those of the fit, in units of their spread.
        """
        everywhere = range(len(self.p.windows))
        offsets, starts, residuals = self._refined(fit.values, fit.offsets, everywhere, 1)
        limit = huber_limit(residuals)
        unsettled = [w for w in everywhere if np.mean(residuals[w] ** 2) > NOISE**2]
        for begin in others if unsettled else ():
            there, found, left = self._refined(fit.values, begin, unsettled, ROUNDS)
            for w in unsettled:
                if start_cost(left[w], there[w], limit) < start_cost(residuals[w], offsets[w], limit):
                    offsets[w], starts[w], residuals[w] = there[w], found[w], left[w]
        linear = self.linearise(fit.values, offsets)
        cost = self.cost([piece.residual for piece in linear], offsets, fit.values)
        return replace(
            fit, offsets=tuple(offsets), starts=tuple(starts[w] for w in everywhere), linear=linear, cost=cost
        )

    def trials(self, values: np.ndarray, offsets: Sequence[np.ndarray]) -> list[Trial]:
        """Return one trial a window."""
        return [Trial(w, values, offset * self.p.windows[w].spread) for w, offset in enumerate(offsets)]

    def linearise(self, values: np.ndarray, offsets: Sequence[np.ndarray]) -> tuple[Linear, ...]:
        """Return residuals and sensitivities at a point; `offsets` in units of their spread."""
        count, size = len(self.p.windows), len(self.scale)
        dynamic = [k for k in range(size) if not self.p.measured_only[k]]
        steps = self._steps(values)
        trials = self.trials(values, offsets)
        for k in dynamic:
            moved = values.copy()
            moved[k] += steps[k]
            trials += self.trials(moved, offsets)
        readers = self.p.readers(trials)
        base = [self.p.observed(w, readers[w], values) for w in range(count)]
        jacobian = [np.zeros((len(r), size)) for r in base]
        for i, k in enumerate(dynamic):
            for w in range(count):
                row = (i + 1) * count + w
                jacobian[w][:, k] = (self.p.observed(w, readers[row], trials[row].values) - base[w]) / steps[k]
        for k in set(range(size)) - set(dynamic):
            moved = values.copy()
            moved[k] += steps[k]
            for w in range(count):
                jacobian[w][:, k] = (self.p.observed(w, readers[w], moved) - base[w]) / steps[k]
        self._adapt(jacobian)
        return tuple(Linear(r, j * self.scale) for r, j in zip(base, jacobian, strict=True))

    def _steps(self, values: np.ndarray) -> np.ndarray:
        """Return the steps of finite differences, away from the bounds."""
        steps = self.step * self.scale
        return np.where(values + steps > self.high, -steps, steps)

    def _adapt(self, jacobian: Sequence[np.ndarray]) -> None:
        """Choose steps for the next time that change the residuals enough to be seen and little enough to be linear."""
        change = np.sqrt(np.mean(np.concatenate(jacobian) ** 2, axis=0)) * self.scale
        wanted = np.where(change > 0, WANTED / np.maximum(change, 1e-12), 1.0)
        self.step = np.clip(wanted, 0.01, 0.3)

    def fit(
        self,
        values: np.ndarray | None = None,
        offsets: Sequence[np.ndarray] | None = None,
        starts: tuple[np.ndarray, ...] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Fit:
        """Fit from a start.

        Args:
            values: Parameters at the start, shape (P,); by default as the model has them, or their null values.
            offsets: Errors of the initial states in units of their spread.
            starts: See `Fit.starts`; computed where not given.
            progress: Called with the share done, 0..1.
        """
        values = self.inside(self.p.start if values is None else values)
        offsets = [np.zeros(len(w.spread)) for w in self.p.windows] if offsets is None else list(offsets)
        if starts is None:
            offsets, starts = self.refine_starts(values, offsets)
        if not len(values):
            linear = self.linearise(values, offsets)
            cost = self.cost([piece.residual for piece in linear], offsets, values)
            return Fit(values, tuple(offsets), cost, linear, starts, True, self.p.simulated)
        damping, refits, converged = self.cfg.damping, self.cfg.refits, False
        linear = self.linearise(values, offsets)
        cost = self.cost([piece.residual for piece in linear], offsets, values)
        for iteration in range(self.cfg.iterations):
            state = _State(values, list(offsets), cost, starts, refits)
            found, damping = self._advance(state, linear, damping)
            refits = found.refits
            gain = (cost - found.cost) / max(cost, 1e-12)
            if found.cost < cost:
                values, offsets, cost, starts = found.values, found.offsets, found.cost, found.starts
                linear = self.linearise(values, offsets)
            if progress is not None:
                progress((iteration + 1) / self.cfg.iterations)
            if gain < self.cfg.tolerance:
                converged = True
                break
        return Fit(values, tuple(offsets), cost, linear, starts, converged, self.p.simulated)

    def _advance(self, state: _State, linear: Sequence[Linear], damping: float) -> tuple[_State, float]:
        """Return a better point, or the same one where there is none, and the next damping.

        A step takes the dependence on the initial states as it was computed last. Where it brings less than a quarter
        of what it promised, they are fitted anew at the new parameters before it is judged.
        """
        for _ in range(5):
            move, moves = self.solve(linear, state.starts, state.offsets, state.values, damping)
            values = self.inside(state.values + move * self.scale)
            offsets = [o + m for o, m in zip(state.offsets, moves, strict=True)]
            expected = [
                piece.residual + piece.jacobian @ move + a @ m
                for piece, a, m in zip(linear, state.starts, moves, strict=True)
            ]
            promised = state.cost - self.cost(expected, offsets, values)
            cost = self.cost(self.p.residuals(self.trials(values, offsets)), offsets, values)
            good = state.cost - cost > 0.25 * max(promised, 0.0)
            if cost < state.cost and (good or not state.refits):
                return _State(values, offsets, cost, state.starts, state.refits), max(damping / 5, 1e-6)
            if state.refits:
                begin = state.offsets if cost > 2 * state.cost else offsets
                refitted, starts = self.refine_starts(values, begin, rounds=REFIT_ROUNDS)
                again = self.cost(self.p.residuals(self.trials(values, refitted)), refitted, values)
                state = replace(state, refits=state.refits - 1)
                if again < state.cost:
                    return _State(values, refitted, again, starts, state.refits), damping
            damping = max(damping * 8, 1e-2)
        return state, damping

    def inside(self, values: np.ndarray) -> np.ndarray:
        """Return values within their bounds; infinite ones stay."""
        return np.where(np.isinf(values), values, np.clip(values, self.low, self.high))

    def prior(self, values: np.ndarray) -> np.ndarray:
        """Return the parameters' distances from where the fit started, in units of their weak prior."""
        start = np.where(np.isfinite(self.p.start), self.p.start, values)
        finite = np.isfinite(values)
        return np.where(finite, (values - start) / (PRIOR * self.scale), 0.0)

    def cost(self, residuals: Sequence[np.ndarray], offsets: Sequence[np.ndarray], values: np.ndarray) -> float:
        """Return half the robust sum of squares, with the priors."""
        limit = huber_limit(residuals)
        total = sum(float(huber(r, limit).sum()) for r in residuals)
        total += sum(far(o) for o in offsets)
        prior = self.prior(values)
        return total + 0.5 * float(prior @ prior)

    def solve(
        self,
        linear: Sequence[Linear],
        starts: Sequence[np.ndarray],
        offsets: Sequence[np.ndarray],
        values: np.ndarray,
        damping: float,
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the damped step of the parameters, in units of their scale, and of each initial state."""
        size = len(self.scale)
        limit = huber_limit([piece.residual for piece in linear])
        normal, slope = np.eye(size) / PRIOR**2, self.prior(values) / PRIOR
        parts = []
        for piece, a, o in zip(linear, starts, offsets, strict=True):
            weight = huber_weight(piece.residual, limit)
            aw = a.T * weight
            near = trust(o)
            m = aw @ a + np.diag(near * (1 + damping))
            c = aw @ piece.jacobian
            b = aw @ piece.residual + near * o
            jw = piece.jacobian.T * weight
            solved = np.linalg.solve(m, np.column_stack([c, b]))
            normal += jw @ piece.jacobian - c.T @ solved[:, :size]
            slope += jw @ piece.residual - c.T @ solved[:, size]
            parts.append(solved)
        curvature = np.maximum(np.diag(normal), 1e-9)
        move = -np.linalg.solve(normal + damping * np.diag(curvature), slope)
        # Parameters on a bound that would leave it stay, and the others move as if they were known.
        held = ((values <= self.low) & (move < 0)) | ((values >= self.high) & (move > 0)) | np.isinf(values)
        if held.any():
            free = ~held
            move = np.zeros(size)
            if free.any():
                sub = normal[np.ix_(free, free)] + damping * np.diag(curvature[free])
                move[free] = -np.linalg.solve(sub, slope[free])
        return move, [-(s[:, size] + s[:, :size] @ move) for s in parts]


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


def around(
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


def projected(fit: Fit) -> list[Linear]:
    """Return residuals and sensitivities with the initial states eliminated, window by window.

    What is left of each is what no change of the initial state within its prior can take up.
    """
    found = []
    for piece, a, o in zip(fit.linear, fit.starts, fit.offsets, strict=True):
        near = trust(o)
        m = a.T @ a + np.diag(near)
        both = np.column_stack([piece.jacobian, piece.residual])
        inner = a.T @ both
        inner[:, -1] += near * o
        rest = both - a @ np.linalg.solve(m, inner)
        found.append(replace(piece, jacobian=rest[:, :-1], residual=rest[:, -1]))
    return found
