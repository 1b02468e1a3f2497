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

from concent_warp.fit.effects.initial_states import ROUNDS, StartSearch, start_cost
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.fit.effects.robust import far, huber, huber_limit, huber_weight, trust

PRIOR = 10.0
"""Weak prior of a parameter, in units of its typical scale."""
STEP = 0.1
"""Step of a finite difference, in units of a parameter's typical scale, at first."""
WANTED = 3.0
"""Mean change of the residuals that a finite difference aims at, in units of noise: contacts make motion jump a little
from value to value, so that smaller steps measure the jumps."""


NOISE = 1.05
"""Residual over noise at which an initial state leaves nothing to be wished for."""
NEXT_TO_NOTHING = 3e-4
"""Share of the cost that counts as a gain where values matter."""
LEAPS, LEAP, WORTH = 6, (1.0, 3.0), 5e-3
"""How often parameters are led on at most, over how many of their steps, and for what gain."""
MOST = 0.5
"""Share of what a leap promises that the windows have to bring together that are tried first."""
MANY, SAMPLE = 16, 8
"""Number of windows beyond which a sample tells whether it is worth taking a fit up again, and the sample's size."""
REFIT_ROUNDS = 2
"""The same within a step of the parameters."""


@dataclass(frozen=True)
class LeastSquaresCfg:
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


class Solver:
    """Fits the parameters of one prediction."""

    def __init__(self, prediction: Prediction, cfg: LeastSquaresCfg | None = None) -> None:
        """Prepare to fit `prediction`."""
        self.p = prediction
        self.cfg = cfg or LeastSquaresCfg()
        self.scale = np.array([q.scale for q in prediction.parameters])
        self.low = np.array([q.low for q in prediction.parameters])
        self.high = np.array([q.high for q in prediction.parameters])
        self.step = np.full(len(self.scale), STEP)
        self.search = StartSearch(prediction)

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
        found, starts, _ = self.search.refined(values, offsets, range(len(offsets)), rounds)
        return found, tuple(starts[w] for w in range(len(offsets)))

    def polish(self, fit: Fit, *, thorough: bool = False, stuck: bool = False) -> Fit:
        """Return a fit taken up again from initial states fitted anew: from where they are, and from the measured ones.

        Initial states that have made up for a wrong parameter do not always find back on their own, and hold it there:
        so the parameters are then led on by steps after each of which the initial states are fitted anew; if
        `thorough`, also where all but the noise is explained, for the sake of their values: there from the initial
        states that go with the step alone, which make up for nothing any more. A fit that is `stuck` where it set out
        has had its initial states fitted there from the measured ones: this is not done again.
        """
        if len(self.p.windows) > MANY:
            return self._polish_by_sample(fit, thorough=thorough, stuck=stuck)
        measured, best = [np.zeros_like(o) for o in fit.offsets], fit
        if not stuck:
            fresh = self.better_starts(fit, [measured])
            # Where none was better, steps that failed with initial states fitted anew would fail again.
            refits = None if fresh.cost < (1 - WORTH) * fit.cost else 0
            best = self.fit(fresh.values, fresh.offsets, fresh.starts, refits=refits)
        noise, worth = (0.0, NEXT_TO_NOTHING) if thorough else (NOISE, WORTH)
        for _ in range(LEAPS if len(fit.values) else 0):
            size = np.mean(np.concatenate([piece.residual for piece in best.linear]) ** 2)
            if size < noise**2:
                break
            move, _ = self.solve(best.linear, best.starts, best.offsets, best.values, self.cfg.damping)
            found = best
            for leap in LEAP:
                values = self.inside(best.values + leap * move * self.scale)
                if size < NOISE**2:
                    led = tuple(self.follow(best, leap * move))
                    there = self.better_starts(replace(best, values=values, offsets=led), [])
                else:
                    there = self._tried(best, values, self._hopeful(best, values), noise)
                found = min(found, there, key=lambda f: f.cost)
            if found.cost > (1 - worth) * best.cost:
                break
            best = found
        return best

    def _hopeful(self, fit: Fit, values: np.ndarray) -> list[int]:
        """Return the windows that are to bring most of what other values promise, by the fit's sensitivities."""
        move, limit = (values - fit.values) / self.scale, huber_limit([piece.residual for piece in fit.linear])
        pieces = projected(fit)
        falls = [huber(q.residual, limit).sum() - huber(q.residual + q.jacobian @ move, limit).sum() for q in pieces]
        order = np.argsort(falls)[::-1]
        reached = np.cumsum(np.maximum(falls, 0.0)[order])
        return order[: int(np.searchsorted(reached, MOST * reached[-1])) + 1].tolist()

    def _tried(self, fit: Fit, values: np.ndarray, first: Sequence[int], noise: float) -> Fit:
        """Return a fit at other values with its initial states fitted anew; as it was if `first` windows get worse."""
        measured = [np.zeros_like(o) for o in fit.offsets]
        there = self.better_starts(replace(fit, values=values), [measured], noise, first)
        limit = huber_limit([piece.residual for piece in fit.linear])
        before, after = (
            sum(start_cost(f.linear[w].residual, f.offsets[w], limit) for w in first) for f in (fit, there)
        )
        if after >= before:
            return fit
        rest = sorted(set(range(len(measured))) - set(first))
        return self.better_starts(there, [measured], noise, rest) if rest else there

    def _polish_by_sample(self, fit: Fit, *, thorough: bool, stuck: bool) -> Fit:
        """Polish a fit on a sample of the windows; where that helps there, go on with all of them from its values."""
        some = np.linspace(0, len(self.p.windows) - 1, SAMPLE).round().astype(int).tolist()
        part = Solver(self.p.only(some), self.cfg)
        linear, offsets, starts = (tuple(rows[w] for w in some) for rows in (fit.linear, fit.offsets, fit.starts))
        cost = part.cost([piece.residual for piece in linear], offsets, fit.values)
        begin = replace(fit, linear=linear, offsets=offsets, starts=starts, cost=cost)
        found = part.polish(begin, thorough=thorough, stuck=stuck)
        if found.cost > (1 - (NEXT_TO_NOTHING if thorough else WORTH)) * begin.cost:
            return fit
        known = dict(zip(some, found.offsets, strict=True))
        led = tuple(known.get(w, o) for w, o in enumerate(fit.offsets))
        measured = [np.zeros_like(o) for o in fit.offsets]
        there = self.better_starts(replace(fit, values=found.values, offsets=led), [measured])
        return min(fit, self.fit(there.values, there.offsets, there.starts, refits=0), key=lambda f: f.cost)

    def better_starts(
        self,
        fit: Fit,
        others: Sequence[Sequence[np.ndarray]],
        noise: float = NOISE,
        windows: Sequence[int] | None = None,
    ) -> Fit:
        """Return a fit at the same parameters with the best initial state of each window that is found.

        Args:
            fit: The fit.
            others: Errors of the initial states to set out from, besides those of the fit, in units of their spread.
            noise: Residual over noise of windows that need no others.
            windows: Those in question; by default all.
        """
        mine = range(len(self.p.windows)) if windows is None else windows
        offsets, fresh, residuals = self.search.refined(fit.values, fit.offsets, mine, 1)
        starts = dict(enumerate(fit.starts)) | fresh
        limit = huber_limit(residuals)
        unsettled = [w for w in mine if np.mean(residuals[w] ** 2) > noise**2]
        for begin in others if unsettled else ():
            rival = {w: start_cost(residuals[w], offsets[w], limit) for w in unsettled}
            there, found, left = self.search.refined(fit.values, begin, unsettled, ROUNDS, rival)
            for w in unsettled:
                if start_cost(left[w], there[w], limit) < start_cost(residuals[w], offsets[w], limit):
                    offsets[w], starts[w], residuals[w] = there[w], found[w], left[w]
        linear = self.linearise(fit.values, offsets)
        cost = self.cost([piece.residual for piece in linear], offsets, fit.values)
        return replace(
            fit, offsets=tuple(offsets), starts=tuple(starts[w] for w in range(len(starts))), linear=linear, cost=cost
        )

    def led(self, fit: Fit, by: Fit, rounds: int = LEAPS) -> Fit:
        """Return a fit at another's initial states, with the parameters that go with those.

        Args:
            fit: The fit whose parameters are led on.
            by: The fit of the same windows whose initial states are taken; its parameters may be others.
            rounds: Most steps of the parameters.
        """
        held = [np.zeros_like(a) for a in by.starts]

        def at(values: np.ndarray) -> Fit:
            linear = self.linearise(values, by.offsets)
            cost = self.cost([piece.residual for piece in linear], by.offsets, values)
            return replace(fit, values=values, offsets=by.offsets, starts=by.starts, linear=linear, cost=cost)

        best, size = at(fit.values), 1.0
        for _ in range(rounds):
            move, _ = self.solve(best.linear, held, best.offsets, best.values, self.cfg.damping)
            found = at(self.inside(best.values + size * move * self.scale))
            if found.cost > best.cost:
                size /= 3
                continue
            settled = found.cost > (1 - WORTH) * best.cost
            best, size = found, 1.0
            if settled:
                break
        return best

    def follow(self, fit: Fit, move: np.ndarray) -> list[np.ndarray]:
        """Return the errors of the initial states that go with a step of the parameters, to first order.

        Args:
            fit: Where the step sets out.
            move: The step, in units of the parameters' scale, shape (P,).
        """
        limit, found = huber_limit([piece.residual for piece in fit.linear]), []
        for piece, a, o in zip(fit.linear, fit.starts, fit.offsets, strict=True):
            aw = a.T * huber_weight(piece.residual, limit)
            found.append(o - np.linalg.solve(aw @ a + np.diag(trust(o)), aw @ (piece.jacobian @ move)))
        return found

    def trials(self, values: np.ndarray, offsets: Sequence[np.ndarray]) -> list[SimulationRequest]:
        """Return one trial a window."""
        return self.search.trials(values, offsets)

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
        refits: int | None = None,
    ) -> Fit:
        """Fit from a start.

        Args:
            values: Parameters at the start, shape (P,); by default as the model has them, or their null values.
            offsets: Errors of the initial states in units of their spread.
            starts: See `Fit.starts`; computed where not given.
            progress: Called with the share done, 0..1.
            refits: See `LeastSquaresCfg.refits`; by default as there.
        """
        values = self.inside(self.p.start if values is None else values)
        offsets = [np.zeros(len(w.spread)) for w in self.p.windows] if offsets is None else list(offsets)
        if starts is None:
            offsets, starts = self.refine_starts(values, offsets)
        if not len(values):
            linear = self.linearise(values, offsets)
            cost = self.cost([piece.residual for piece in linear], offsets, values)
            return Fit(values, tuple(offsets), cost, linear, starts, True, self.p.simulated)
        damping, converged = self.cfg.damping, False
        refits = self.cfg.refits if refits is None else refits
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
