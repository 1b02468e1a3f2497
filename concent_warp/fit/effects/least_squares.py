"""Effect parameters and initial states by bounded, robust least squares.

Unknown are P parameters, common to all windows, and for each window the error of its initial state. The initial states
are eliminated window by window (Schur complement of the arrowhead normal equations: Bock 1983; Golub and Pereyra,
"Separable nonlinear least squares", Inverse Problems 19, 2003), so that a step costs P + 1 simulations of each window;
how residuals depend on the initial states is computed once and kept. Steps are damped (Levenberg, Marquardt). Residuals
count by Huber's loss relative to their own spread, so that a few outliers have little influence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from concent_warp.checks import Count, Factor, Positive, Share
from concent_warp.fit.effects.bounded_step import step_within
from concent_warp.fit.effects.initial_states import InitialStateCfg, InitialStateSearch, start_cost, start_step
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.fit.effects.robust import RobustLossCfg, cauchy_cost, cauchy_weight, huber, huber_limit, huber_weight


@dataclass(frozen=True)
class LeastSquaresCfg:
    """Settings of a fit of effect parameters."""

    iterations: int = 10
    """Most steps [-]."""
    tolerance: float = 1e-3
    """Relative fall of the cost below which the fit ends [-]."""
    damping: Positive = 1e-3
    """First Levenberg-Marquardt damping, relative to the curvature [-]."""
    max_damping_trials: Count = 5
    """Most values of the damping tried for one step [-]."""
    damping_decrease: Factor = 5.0
    """Factor by which the damping falls after a step that lowers the cost [-]. Empirical, as the following."""
    damping_increase: Factor = 8.0
    """Factor by which the damping rises after a step that does not [-]."""
    min_damping: Positive = 1e-6
    """Damping below which it falls no further [-]."""
    min_raised_damping: Positive = 1e-2
    """Least damping after a step that does not lower the cost [-]."""
    predicted_share: float = 0.25
    """Share of the predicted fall of the cost that a step must reach to be taken without a refit of the initial states
    [-] (Nocedal and Wright, "Numerical Optimization", section 4.1)."""
    restart_ratio: float = 2.0
    """Cost of a step over that before it above which a refit starts from the initial states before the step [-]."""
    refits: int = 3
    """Most refits of the initial states after steps that lower the cost by much less than predicted [-]."""
    refit_iterations: int = 2
    """Most iterations of such a refit [-]."""
    first_step: Positive = 0.1
    """First step of a parameter's finite difference, in units of its typical scale [-]."""
    min_step: Positive = 0.01
    """Least step of a finite difference, in units of the parameter's typical scale [-]."""
    max_step: Positive = 0.3
    """Largest step of a finite difference, in units of the parameter's typical scale [-]."""
    nominal_steps: Positive = 10.0
    """First and largest steps of nominal values over those of other parameters [-]: their scale is a tenth of their
    tolerance, within which residuals are in proportion to them. With smaller steps, what was measured at a joint's stop
    was when it comes there between two time steps."""
    target_change: Positive = 3.0
    """Mean change of the residuals that a finite difference aims at, in units of noise [-]: with contacts, residuals
    jump a little from value to value, and smaller steps measure the jumps."""
    max_change: Positive = 10.0
    """Mean change of the residuals above which a finite difference is taken again with a step for `target_change` where
    there are contacts, in units of noise [-]: an orientation that turns by more than half a revolution, or a body that
    comes to rest elsewhere, changes in the wrong direction. About three times `target_change`."""
    noise_ratio: float = 1.05
    """Residual over noise below which a window's initial state counts as found [-]."""
    same_state: float = 0.3
    """Largest difference of two initial states, in units of their spread, below which a search from one ends where that
    from the other does [-]. Empirical."""
    far_state: Positive = 5.0
    """Error of an initial state, in units of its spread, beyond which another fit begins at the measured states, where
    there are contacts [-]: such a state may make up for a wrong parameter, and then no step leads away. Empirical."""
    together_ratio: float = 1.1
    """Residual over noise below which a polish moves parameters and initial states together [-]: little is left that
    other initial states could hide. Empirical."""
    min_gain: float = 5e-3
    """Relative fall of the cost for which a polish goes on [-]."""
    min_thorough_gain: float = 3e-4
    """The same for a thorough polish, which is for the sake of the parameters' values [-]."""
    polish_steps: int = 4
    """Most steps of the parameters in a polish [-]."""
    polish_step_decrease: Factor = 3.0
    """Factor by which a step at fixed initial states is shortened where it raises the cost [-]."""
    polish_step_lengths: tuple[Positive, ...] = (1.0,)
    """Lengths that are tried for such a step, relative to the least-squares step [-]."""
    screened_gain: float = 0.5
    """Share of a step's predicted fall of the cost in the windows that are simulated first [-]."""
    max_polished_windows: Count = 16
    """Most windows that are polished together; of more, a sample is polished first [-]."""
    polish_sample: Count = 8
    """Windows in such a sample [-]."""
    doubted_share: Share = 0.25
    """Share of a window's sum of squares that derivatives by its initial state must foretell to fall, for a step along
    them to be simulated once the fit has ended [-], see `concent_warp.fit.effects.rough_windows`. Empirical."""
    doubted_step_lengths: tuple[Positive, ...] = (1.0, 0.3, 0.1)
    """Lengths of that step, relative to the one that leads to the foretold minimum [-]."""
    prior: Positive = 10.0
    """Standard deviation of a parameter's weak prior, in units of its typical scale [-]: wide enough to change no value
    that the data determine."""
    robust: RobustLossCfg = field(default_factory=RobustLossCfg)
    """Scales of the robust losses."""
    initial_states: InitialStateCfg = field(default_factory=InitialStateCfg)
    """Settings of the search for initial states."""


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
    polished: bool = False
    """Whether a thorough polish ended here, so that another one finds nothing."""
    searched: np.ndarray | None = None
    """Parameters, shape (P,), at which a polish searched initial states from the measured ones last; None for none."""
    rough: tuple[int, ...] = ()
    """Windows, by index, in which no step of the initial state lowers the residuals as its derivatives foretell; see
    `concent_warp.fit.effects.rough_windows`."""

    @property
    def is_searched(self) -> bool:
        """Whether a polish searched initial states from the measured ones at these very parameters."""
        return self.searched is not None and np.array_equal(self.searched, self.values)


@dataclass(frozen=True)
class _State:
    """A point of a fit."""

    values: np.ndarray
    offsets: list[np.ndarray]
    cost: float
    starts: tuple[np.ndarray, ...]
    refits: int
    """Refits of the initial states that are left."""
    limit: float = np.inf
    """Limit of Huber's loss beyond which that of no point rises [-]; infinite while the cost falls without."""


class Solver:
    """Fits the parameters of one prediction."""

    def __init__(self, prediction: Prediction, cfg: LeastSquaresCfg | None = None) -> None:
        """Prepare to fit `prediction`."""
        self.p = prediction
        self.cfg = cfg or LeastSquaresCfg()
        self.scale = np.array([q.scale for q in prediction.parameters])
        self.low = np.array([q.low for q in prediction.parameters])
        self.high = np.array([q.high for q in prediction.parameters])
        self.wider = np.where(prediction.nominal, self.cfg.nominal_steps, 1.0)
        """Steps of finite differences that are usual for each parameter, over those for parameters of effects [-]."""
        self.step = self.cfg.first_step * self.wider
        self.search = InitialStateSearch(prediction, self.cfg.initial_states, self.cfg.robust)

    def fit_initial_states(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        iterations: int | None = None,
        known: Sequence[np.ndarray] = (),
    ) -> tuple[list[np.ndarray], tuple[np.ndarray, ...]]:
        """Fit the initial states alone, each window by itself, at fixed parameters.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states in units of their spread, where to start.
            iterations: Most computations of the derivatives with respect to the initial states; by default
                `InitialStateCfg.iterations`.
            known: Derivatives by the initial states from a point nearby, one a window, for windows with contacts; see
                `InitialStateSearch`.

        Returns:
            The errors of the initial states, and the residuals' derivatives with respect to them, see `Fit.starts`.
        """
        most = self.cfg.initial_states.iterations if iterations is None else iterations
        near = {w: a for w, a in enumerate(known) if not self.p.windows[w].smooth}
        found, starts, _ = self.search.refined(values, offsets, range(len(offsets)), most, known=near)
        return found, tuple(starts[w] for w in range(len(offsets)))

    def polish(self, fit: Fit, *, thorough: bool = False, stuck: bool = False) -> Fit:
        """Return a fit continued with initial states fitted anew, from where they are and from the measured ones.

        Initial states that compensate for a wrong parameter keep it wrong: therefore the parameters take steps after
        each of which the initial states are fitted anew. From the measured ones they are not where a polish has done so
        at the same parameters.

        Args:
            fit: The fit.
            thorough: Take these steps also where only noise is left to explain; there from the initial states that
                go with the step to first order.
            stuck: The initial states of `fit` have been fitted from the measured ones already, and are not again.
        """
        cfg = self.cfg
        if len(self.p.windows) > cfg.max_polished_windows:
            return self._polish_by_sample(fit, thorough=thorough, stuck=stuck)
        size = np.mean(np.concatenate([window.residual for window in fit.linear]) ** 2)
        if all(w.smooth for w in self.p.windows) or size < cfg.together_ratio**2:
            return self._polish_together(fit, thorough=thorough)
        measured, best = [np.zeros_like(o) for o in fit.offsets], fit
        if not stuck:
            fresh = self.improve_initial_states(fit, [] if fit.is_searched else [measured])
            # If none was better, steps that failed with initial states fitted anew would fail again.
            refits = None if fresh.cost < (1 - cfg.min_gain) * fit.cost else 0
            best = replace(self.fit(fresh.values, fresh.offsets, fresh.starts, refits=refits), searched=fit.values)
        noise, min_gain = (0.0, cfg.min_thorough_gain) if thorough else (cfg.noise_ratio, cfg.min_gain)
        for _ in range(cfg.polish_steps if len(fit.values) else 0):
            size = np.mean(np.concatenate([window.residual for window in best.linear]) ** 2)
            if size < noise**2:
                break
            move, _ = self.solve(best.linear, best.starts, best.offsets, best.values, cfg.damping)
            found = best
            for length in cfg.polish_step_lengths:
                values = self.inside(best.values + length * move * self.scale)
                if size < cfg.noise_ratio**2:
                    offsets = tuple(self.first_order_offsets(best, length * move))
                    there = self.improve_initial_states(replace(best, values=values, offsets=offsets), [])
                else:
                    there = self._fit_at(best, values, self._promising_windows(best, values), noise)
                found = min(found, there, key=lambda f: f.cost)
            if found.cost > (1 - min_gain) * best.cost:
                return replace(best, polished=thorough)
            best = found
        return best

    def _polish_together(self, fit: Fit, *, thorough: bool) -> Fit:
        """Return a fit continued with new derivatives by the initial states, for as long as that lowers the cost.

        Where nothing touches anything, or little more than noise is left, these change little with the parameters, and
        all converge together.
        """
        min_gain, best = self.cfg.min_thorough_gain if thorough else self.cfg.min_gain, fit
        for _ in range(self.cfg.polish_steps):
            there = self.improve_initial_states(best, [])
            if len(fit.values):
                there = self.fit(there.values, there.offsets, there.starts, refits=0)
            if there.cost > (1 - min_gain) * best.cost:
                return replace(min(best, there, key=lambda f: f.cost), polished=thorough)
            best = there
        return best

    def _promising_windows(self, fit: Fit, values: np.ndarray) -> list[int]:
        """Return the windows with the largest falls of the cost predicted for other values, see `screened_gain`."""
        move, limit = (
            (values - fit.values) / self.scale,
            huber_limit([window.residual for window in fit.linear], self.cfg.robust),
        )
        linear = projected(fit, self.cfg.robust)
        falls = [huber(q.residual, limit).sum() - huber(q.residual + q.jacobian @ move, limit).sum() for q in linear]
        order = np.argsort(falls)[::-1]
        reached = np.cumsum(np.maximum(falls, 0.0)[order])
        return order[: int(np.searchsorted(reached, self.cfg.screened_gain * reached[-1])) + 1].tolist()

    def _fit_at(self, fit: Fit, values: np.ndarray, first: Sequence[int], noise: float) -> Fit:
        """Return a fit at other values, initial states fitted anew; unchanged if the cost of `first` windows rises."""
        measured = [np.zeros_like(o) for o in fit.offsets]
        moved = replace(fit, values=values, searched=values)
        there = self.improve_initial_states(moved, [measured], noise, first, fresh=False)
        limit = huber_limit([window.residual for window in fit.linear], self.cfg.robust)
        before, after = (
            sum(start_cost(f.linear[w].residual, f.offsets[w], limit, self.cfg.robust) for w in first)
            for f in (fit, there)
        )
        if after >= before:
            return fit
        rest = sorted(set(range(len(measured))) - set(first))
        return self.improve_initial_states(there, [measured], noise, rest, fresh=False) if rest else there

    def _polish_by_sample(self, fit: Fit, *, thorough: bool, stuck: bool) -> Fit:
        """Return a fit polished on a sample of the windows, and where that helps on all of them from its values."""
        some = np.linspace(0, len(self.p.windows) - 1, self.cfg.polish_sample).round().astype(int).tolist()
        part = Solver(self.p.only(some), self.cfg)
        linear, offsets, starts = (tuple(rows[w] for w in some) for rows in (fit.linear, fit.offsets, fit.starts))
        cost = part.cost([window.residual for window in linear], offsets, fit.values)
        begin = replace(fit, linear=linear, offsets=offsets, starts=starts, cost=cost, rough=())
        found = part.polish(begin, thorough=thorough, stuck=stuck)
        min_gain = self.cfg.min_thorough_gain if thorough else self.cfg.min_gain
        if found.cost > (1 - min_gain) * begin.cost:
            return replace(fit, polished=True) if thorough else fit
        known = dict(zip(some, found.offsets, strict=True))
        offsets = tuple(known.get(w, o) for w, o in enumerate(fit.offsets))
        measured = [np.zeros_like(o) for o in fit.offsets]
        there = self.improve_initial_states(replace(fit, values=found.values, offsets=offsets), [measured])
        return min(fit, self.fit(there.values, there.offsets, there.starts, refits=0), key=lambda f: f.cost)

    def improve_initial_states(
        self,
        fit: Fit,
        others: Sequence[Sequence[np.ndarray]],
        noise: float | None = None,
        windows: Sequence[int] | None = None,
        *,
        fresh: bool = True,
    ) -> Fit:
        """Return a fit at the same parameters with the best initial state of each window that is found.

        Args:
            fit: The fit.
            others: Errors of the initial states to start from, besides those of the fit, in units of their spread.
            noise: Residual over noise of windows that need no others; by default `LeastSquaresCfg.noise_ratio`.
            windows: Indices of the windows to improve; by default all.
            fresh: Whether derivatives by the initial states are computed anew; else where those of the fit mislead.
        """
        mine = range(len(self.p.windows)) if windows is None else windows
        noise = self.cfg.noise_ratio if noise is None else noise
        known, most = ({}, 1) if fresh else (dict(enumerate(fit.starts)), self.cfg.refit_iterations)
        offsets, renewed, residuals = self.search.refined(fit.values, fit.offsets, mine, most, known=known)
        starts = dict(enumerate(fit.starts)) | renewed
        limit = huber_limit(residuals, self.cfg.robust)
        for begin in others:
            outlying = [
                w
                for w in mine
                if np.mean(residuals[w] ** 2) > noise**2 and np.abs(begin[w] - offsets[w]).max() > self.cfg.same_state
            ]
            upper_bounds = {w: start_cost(residuals[w], offsets[w], limit, self.cfg.robust) for w in outlying}
            if not outlying:
                continue
            near = {w: starts[w] for w in outlying if not self.p.windows[w].smooth}
            there, found, left = self.search.refined(
                fit.values, begin, outlying, self.cfg.initial_states.iterations, upper_bounds, near
            )
            for w in outlying:
                if start_cost(left[w], there[w], limit, self.cfg.robust) < start_cost(
                    residuals[w], offsets[w], limit, self.cfg.robust
                ):
                    offsets[w], starts[w], residuals[w] = there[w], found[w], left[w]
        linear = self.linearise(fit.values, offsets)
        cost = self.cost([window.residual for window in linear], offsets, fit.values)
        ordered = tuple(starts[w] for w in range(len(starts)))
        return replace(fit, offsets=tuple(offsets), starts=ordered, linear=linear, cost=cost, rough=())

    def fit_at_states_of(self, other: Fit, fit: Fit) -> Fit:
        """Return a fit of the parameters at the initial states of another fit, which stay fixed.

        Args:
            other: Fit of the same windows whose initial states are taken; its parameters may be others.
            fit: The fit from whose parameters to start.
        """
        fixed = [np.zeros_like(a) for a in other.starts]

        def at(values: np.ndarray) -> Fit:
            linear = self.linearise(values, other.offsets)
            cost = self.cost([window.residual for window in linear], other.offsets, values)
            moved = {"offsets": other.offsets, "starts": other.starts, "rough": ()}
            return replace(fit, values=values, linear=linear, cost=cost, **moved)

        best, size = at(fit.values), 1.0
        for _ in range(self.cfg.polish_steps):
            move, _ = self.solve(best.linear, fixed, best.offsets, best.values, self.cfg.damping)
            found = at(self.inside(best.values + size * move * self.scale))
            if found.cost > best.cost:
                size /= self.cfg.polish_step_decrease
                continue
            converged = found.cost > (1 - self.cfg.min_gain) * best.cost
            best, size = found, 1.0
            if converged:
                break
        return best

    def better_from_measured_states(self, fit: Fit) -> Fit:
        """Return the better of a fit whose initial states are far from the measured ones and one that begins at these.

        The parameters are fitted at the measured states first. A velocity that is too high goes with a friction that
        is: from such states a fit does not find back. Without contacts, or near the measured states, it is returned as
        it is.
        """
        if not len(fit.values) or all(w.smooth for w in self.p.windows):
            return fit
        if max(float(np.abs(o).max(initial=0.0)) for o in fit.offsets) <= self.cfg.far_state:
            return fit
        measured = [np.zeros_like(o) for o in fit.offsets]
        there = self.fit_at_states_of(replace(fit, offsets=tuple(measured)), fit)
        return min(fit, self.fit(there.values, *self.fit_initial_states(there.values, measured)), key=lambda f: f.cost)

    def first_order_offsets(self, fit: Fit, move: np.ndarray) -> list[np.ndarray]:
        """Return the errors of the initial states that go with a step of the parameters, to first order.

        Args:
            fit: Where the step starts.
            move: The step, in units of the parameters' scale, shape (P,).
        """
        limit, found = huber_limit([window.residual for window in fit.linear], self.cfg.robust), []
        for window, a, o in zip(fit.linear, fit.starts, fit.offsets, strict=True):
            aw = a.T * huber_weight(window.residual, limit)
            found.append(
                o - np.linalg.solve(aw @ a + np.diag(cauchy_weight(o, self.cfg.robust)), aw @ (window.jacobian @ move))
            )
        return found

    def trials(self, values: np.ndarray, offsets: Sequence[np.ndarray]) -> list[SimulationRequest]:
        """Return one simulation for each window."""
        return self.search.trials(values, offsets)

    def linearise(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        known: Sequence[Linear] = (),
        *,
        residual_known: bool = False,
    ) -> tuple[Linear, ...]:
        """Return residuals and sensitivities at a point.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states in units of their spread, one (2 nv,) a window.
            known: The same of a model without the last parameters, at a point where these change nothing: its
                sensitivities are taken over.
            residual_known: Whether its residuals are those of this model too.
        """
        count, size = len(self.p.windows), len(self.scale)
        first = known[0].jacobian.shape[1] if known else 0
        dynamic = [k for k in range(first, size) if not self.p.measured_only[k]]
        measured = [k for k in range(first, size) if self.p.measured_only[k]]
        steps = self._steps(values)
        simulated = bool(measured) or not residual_known
        points = [values] if simulated else []
        for k in dynamic:
            points.append(values.copy())
            points[-1][k] += steps[k]
        trials = [trial for point in points for trial in self.trials(point, offsets)]
        readers = self.p.readers(trials)
        seen = [self.p.observed(trial.window, read, trial.values) for trial, read in zip(trials, readers, strict=True)]
        base = seen[:count] if simulated else [window.residual for window in known]
        jacobian = [np.zeros((len(r), size)) for r in base]
        for i, k in enumerate(dynamic, start=int(simulated)):
            for w in range(count):
                jacobian[w][:, k] = (seen[i * count + w] - base[w]) / steps[k]
        for k in measured:
            moved = values.copy()
            moved[k] += steps[k]
            for w in range(count):
                jacobian[w][:, k] = (self.p.observed(w, readers[w], moved) - base[w]) / steps[k]
        for w, window in enumerate(known):
            jacobian[w][:, :first] = window.jacobian / self.scale[:first]
        self._adapt(jacobian)
        self._retake(values, offsets, base, jacobian, {k: steps[k] for k in dynamic})
        return tuple(Linear(r, j * self.scale) for r, j in zip(base, jacobian, strict=True))

    def _retake(
        self,
        values: np.ndarray,
        offsets: Sequence[np.ndarray],
        residuals: Sequence[np.ndarray],
        jacobian: Sequence[np.ndarray],
        taken: Mapping[int, float],
    ) -> None:
        """Take finite differences again whose steps change all residuals by more than `max_change`.

        Only windows with contacts that change by more than that themselves are simulated again.

        Args:
            values: Parameters, shape (P,).
            offsets: Errors of the initial states in units of their spread, one (2 nv,) a window.
            residuals: Residuals there by window, each (n,).
            jacobian: Their derivatives by the parameters, each (n, P); changed in place.
            taken: Steps that were taken, by index of the parameter.
        """
        steps, share = self._steps(values), self.cfg.target_change / self.cfg.max_change
        smaller = {k: steps[k] for k, h in taken.items() if abs(steps[k]) < share * abs(h)}
        far = [
            (k, w)
            for k in smaller
            for w, j in enumerate(jacobian)
            if not self.p.windows[w].smooth and np.sqrt(np.mean(j[:, k] ** 2)) * abs(taken[k]) > self.cfg.max_change
        ]
        if not far:
            return
        moved = {k: values + h * (np.arange(len(values)) == k) for k, h in smaller.items()}
        trials = {k: self.trials(moved[k], offsets) for k in {k for k, _ in far}}
        found = self.p.residuals([trials[k][w] for k, w in far])
        for (k, w), residual in zip(far, found, strict=True):
            jacobian[w][:, k] = (residual - residuals[w]) / smaller[k]
        self._adapt(jacobian)

    def _steps(self, values: np.ndarray) -> np.ndarray:
        """Return the steps of finite differences, away from the bounds."""
        steps = self.step * self.scale
        return np.where(values + steps > self.high, -steps, steps)

    def _adapt(self, jacobian: Sequence[np.ndarray]) -> None:
        """Choose the next steps of finite differences, so that residuals change by about `target_change`."""
        change = np.sqrt(np.mean(np.concatenate(jacobian) ** 2, axis=0)) * self.scale
        steps = np.where(change > 0, self.cfg.target_change / np.maximum(change, 1e-12), 1.0)
        self.step = np.clip(steps, self.cfg.min_step, self.cfg.max_step * self.wider)

    def fit(
        self,
        values: np.ndarray | None = None,
        offsets: Sequence[np.ndarray] | None = None,
        starts: tuple[np.ndarray, ...] | None = None,
        progress: Callable[[float], None] | None = None,
        refits: int | None = None,
    ) -> Fit:
        """Fit from a start.

        The limit of Huber's loss follows the spread of the residuals. Where many residuals are small and some far off,
        a step that betters the latter for little in the others raises the limit, and the cost with it. Where no step
        lowers the cost otherwise, the limit therefore rises no more.

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
            offsets, starts = self.fit_initial_states(values, offsets)
        if not len(values):
            linear = self.linearise(values, offsets)
            cost = self.cost([window.residual for window in linear], offsets, values)
            return Fit(values, tuple(offsets), cost, linear, starts, True, self.p.simulated)
        damping, converged = self.cfg.damping, False
        refits = self.cfg.refits if refits is None else refits
        linear = self.linearise(values, offsets)
        cost, limit = self.cost([window.residual for window in linear], offsets, values), np.inf
        for iteration in range(self.cfg.iterations):
            state = _State(values, list(offsets), cost, starts, refits, limit)
            found, damping = self._advance(state, linear, damping)
            refits, limit = found.refits, found.limit
            gain = (cost - found.cost) / max(cost, 1e-12)
            if found.cost < cost:
                values, offsets, cost, starts = found.values, found.offsets, found.cost, found.starts
                linear = self.linearise(values, offsets)
            if progress is not None:
                progress((iteration + 1) / self.cfg.iterations)
            if gain < self.cfg.tolerance:
                converged = True
                break
        if np.any(self.p.nominal):
            state = self._undamped(_State(values, list(offsets), cost, starts, refits, limit), linear)
            if state.cost < cost:
                values, offsets = state.values, state.offsets
                linear = self.linearise(values, offsets)
        cost = self.cost([window.residual for window in linear], offsets, values)
        return Fit(values, tuple(offsets), cost, linear, starts, converged, self.p.simulated)

    def _undamped(self, state: _State, linear: Sequence[Linear]) -> _State:
        """Return the point after one step without damping, or the same one where that does not lower the cost.

        Nominal values that scale together leave a flat direction, along which damped steps hardly move to the prior.
        """
        move, moves = self.solve(linear, state.starts, state.offsets, state.values, 0.0, state.limit)
        values = self.inside(state.values + move * self.scale)
        offsets = [o + m for o, m in zip(state.offsets, moves, strict=True)]
        cost = self.cost(self.p.residuals(self.trials(values, offsets)), offsets, values, state.limit)
        return replace(state, values=values, offsets=offsets, cost=cost) if cost < state.cost else state

    def _limit(self, linear: Sequence[Linear]) -> float:
        """Return the limit of Huber's loss that goes with the spread of some residuals."""
        return huber_limit([window.residual for window in linear], self.cfg.robust)

    def _advance(self, state: _State, linear: Sequence[Linear], damping: float) -> tuple[_State, float]:
        """Return a better point, or the same one where there is none, and the next damping.

        A step uses the derivatives by the initial states as computed last. Where the cost falls by less than
        `predicted_share` of the prediction, the initial states are fitted anew at the new parameters before the step is
        judged, unless all parameters stay. Where no step lowers the cost by more than `tolerance`, the first one counts
        that does with the limit of Huber's loss at this point.
        """
        cfg, held = self.cfg, None
        for _ in range(cfg.max_damping_trials):
            move, moves = self.solve(linear, state.starts, state.offsets, state.values, damping, state.limit)
            values = self.inside(state.values + move * self.scale)
            offsets = [o + m for o, m in zip(state.offsets, moves, strict=True)]
            expected = [
                window.residual + window.jacobian @ move + a @ m
                for window, a, m in zip(linear, state.starts, moves, strict=True)
            ]
            predicted = state.cost - self.cost(expected, offsets, values, state.limit)
            residuals = self.p.residuals(self.trials(values, offsets))
            cost = self.cost(residuals, offsets, values, state.limit)
            as_predicted = state.cost - cost > cfg.predicted_share * max(predicted, 0.0)
            if held is not None and 0 <= state.cost - cost < cfg.tolerance * state.cost:
                return held
            if cost < state.cost and (as_predicted or not state.refits):
                lowered = max(damping / cfg.damping_decrease, cfg.min_damping)
                return replace(state, values=values, offsets=offsets, cost=cost), lowered
            if state.refits and not np.array_equal(values, state.values):
                begin = state.offsets if cost > cfg.restart_ratio * state.cost else offsets
                refitted, starts = self.fit_initial_states(values, begin, cfg.refit_iterations, state.starts)
                again = self.cost(self.p.residuals(self.trials(values, refitted)), refitted, values, state.limit)
                state = replace(state, refits=state.refits - 1)
                if again < state.cost:
                    return replace(state, values=values, offsets=refitted, cost=again, starts=starts), damping
            if held is None and np.isinf(state.limit):
                limit = self._limit(linear)
                least = self.cost(residuals, offsets, values, limit)
                if least < (1 - cfg.tolerance) * state.cost:
                    held = _State(values, offsets, least, state.starts, state.refits, limit), damping
            damping = max(damping * cfg.damping_increase, cfg.min_raised_damping)
        return held or (state, damping)

    def inside(self, values: np.ndarray) -> np.ndarray:
        """Return values within their bounds; infinite ones stay."""
        return np.where(np.isinf(values), values, np.clip(values, self.low, self.high))

    def _step_inside(self, normal: np.ndarray, slope: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the step within the bounds, shape (P,) in units of the scales; infinite values stay."""
        move = np.zeros(len(values))
        low, high = np.minimum(self.low - values, 0.0) / self.scale, np.maximum(self.high - values, 0.0) / self.scale
        free = ~np.isinf(values) & (low < high)
        if free.any():
            move[free] = step_within(normal[np.ix_(free, free)], slope[free], low[free], high[free])
        return move

    def prior(self, values: np.ndarray) -> np.ndarray:
        """Return the parameters' distances from the mean of their prior, in units of its standard deviation."""
        mean = self.p.prior_mean
        away = np.subtract(values, mean, out=np.zeros(len(values)), where=np.isfinite(values) & np.isfinite(mean))
        return away / (self.cfg.prior * self.scale)

    def cost(
        self,
        residuals: Sequence[np.ndarray],
        offsets: Sequence[np.ndarray],
        values: np.ndarray,
        most: float = np.inf,
    ) -> float:
        """Return half the robust sum of squares, with the priors.

        Args:
            residuals: Residuals by window in units of noise, each (n,).
            offsets: Errors of the initial states in units of their spread, one (2 nv,) a window.
            values: Parameters, shape (P,).
            most: Largest limit of Huber's loss [-].
        """
        limit = min(huber_limit(residuals, self.cfg.robust), most)
        total = sum(float(huber(r, limit).sum()) for r in residuals)
        total += sum(cauchy_cost(o, self.cfg.robust) for o in offsets)
        prior = self.prior(values)
        return total + 0.5 * float(prior @ prior)

    def solve(
        self,
        linear: Sequence[Linear],
        starts: Sequence[np.ndarray],
        offsets: Sequence[np.ndarray],
        values: np.ndarray,
        damping: float,
        most: float = np.inf,
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the damped step of the parameters, in units of their scale, and of each initial state.

        Args:
            linear: Residuals and sensitivities by window.
            starts: See `Fit.starts`.
            offsets: Errors of the initial states in units of their spread, one (2 nv,) a window.
            values: Parameters, shape (P,).
            damping: Levenberg-Marquardt damping, relative to the curvature [-].
            most: Largest limit of Huber's loss [-].
        """
        size = len(self.scale)
        limit = min(self._limit(linear), most)
        normal, slope = np.eye(size) / self.cfg.prior**2, self.prior(values) / self.cfg.prior
        parts = []
        for window, a, o in zip(linear, starts, offsets, strict=True):
            weight = huber_weight(window.residual, limit)
            aw = a.T * weight
            near = cauchy_weight(o, self.cfg.robust)
            m = aw @ a + np.diag(near * (1 + damping))
            c = aw @ window.jacobian
            b = aw @ window.residual + near * o
            jw = window.jacobian.T * weight
            solved = np.linalg.solve(m, np.column_stack([c, b]))
            normal += jw @ window.jacobian - c.T @ solved[:, :size]
            slope += jw @ window.residual - c.T @ solved[:, size]
            parts.append(solved)
        damped = normal + damping * np.diag(np.maximum(np.diag(normal), 1e-9))
        move = self._step_inside(damped, slope, values)
        return move, [-(s[:, size] + s[:, :size] @ move) for s in parts]


LEAST_SHARE = 1e-3
"""Part of a sensitivity that changes of the initial state leave, over the whole, up to which it may count as none [-]:
as large are errors of finite differences. The bias of a cart's position on a level rail is such a parameter."""
LEAST_CHANGE = 0.1
"""RMS of that part, in units of noise, up to which it counts as none then [-]: ten scales, as far as the parameter's
prior reaches, are no more than noise."""


def projected(fit: Fit, cfg: RobustLossCfg | None = None) -> list[Linear]:
    """Return residuals and sensitivities with the initial states eliminated, window by window.

    They are those parts that no change of the initial state within its prior can explain; a sensitivity that such a
    change explains but for `LEAST_SHARE` and `LEAST_CHANGE` is 0. Residuals of `Fit.rough` windows are as they are.

    Args:
        fit: The fit.
        cfg: Scales of the robust losses.
    """
    found = []
    for w, (window, a, o) in enumerate(zip(fit.linear, fit.starts, fit.offsets, strict=True)):
        m = a.T @ a + np.diag(cauchy_weight(o, cfg))
        jacobian, whole = window.jacobian - a @ np.linalg.solve(m, a.T @ window.jacobian), window.jacobian
        left = np.linalg.norm(jacobian, axis=0)
        determined = left > LEAST_SHARE * np.linalg.norm(whole, axis=0)
        determined |= left > LEAST_CHANGE * np.sqrt(len(jacobian))
        residual = window.residual
        if w not in fit.rough:
            residual = residual + a @ start_step(residual, a, o, np.inf, 0.0, cfg)
        found.append(replace(window, jacobian=jacobian * determined, residual=residual))
    return found
