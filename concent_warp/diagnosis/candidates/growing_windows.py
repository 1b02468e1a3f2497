"""Fits of candidates over the first part of each window, which are continued as the windows grow.

Impacts give the cost of a long window many local minima, in which errors of its initial state stand in for a missing
effect. The cost of a short one has few. Where the state was measured, a recording is cut into short windows (multiple
shooting: Bock 1983). Where it was not, as that of a ball that is tracked by position, only their beginnings are short:
what is found there is continued to longer and longer ones (quasi-static variational assimilation: Pires, Vautard and
Talagrand, "On extending the limits of variational assimilation in nonlinear chaotic systems", Tellus A 48, 1996).
"""

from __future__ import annotations

from collections.abc import Sequence

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel
from concent_warp.diagnosis.candidates.fit_candidate import candidate_solver, fit_candidate, fitted_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import SearchCfg
from concent_warp.effects.effect import Effect
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.least_squares import Fit, Solver
from concent_warp.fit.effects.observation import Window, first_part


def first_parts(windows: Sequence[Window], length: float) -> list[Window]:
    """Return the first parts of windows, each of a length [s] at most."""
    return [first_part(w, length) for w in windows]


def baseline_of_first_parts(base: FittedModel, length: float) -> FittedModel:
    """Return a fitted model over the first parts of its windows, of a length [s], from the measured initial states."""
    windows = first_parts(base.windows, length)
    return fit_baseline(base.model, windows, cut_blocks(windows, base.cfg.blocks), base.engine, cfg=base.cfg)


def fit_first_parts(near: FittedModel, effect: Effect, cfg: SearchCfg, least: float) -> FittedCandidate | None:
    """Return a candidate fitted over the first parts of the windows; None where it promises too little there.

    Args:
        near: The model over these parts, see `baseline_of_first_parts`.
        effect: The candidate.
        cfg: Settings.
        least: Expected gain from which on it is fitted.
    """
    screened = screen(near, effect, cfg)
    return fit_candidate(near, screened) if screened.expected_gain > least else None


def continue_fit(
    base: FittedModel,
    found: FittedCandidate,
    cfg: SearchCfg,
    least: float = 0.0,
    best: FittedCandidate | None = None,
) -> FittedCandidate | None:
    """Return a candidate fitted over the model's windows, continued from a fit over the first parts of these.

    It is None where a fit on the way gains too little over the model, whose initial states are those of whole windows,
    or far less than the best candidate: it has ended in a local minimum, and longer windows have more of them.

    Args:
        base: The fitted model.
        found: The fit over the first parts, see `fit_first_parts`.
        cfg: Settings.
        least: Share of the model's cost over parts of the windows that a fit over these must remove.
        best: The best fit over whole windows; over such parts a fit must remove `SearchCfg.shooting_min_gain` of what
            this one does.
    """
    length, longest = cfg.shooting_window, max(w.end - w.start for w in base.windows)
    values, offsets = found.fit.values, found.fit.offsets
    while True:
        length *= cfg.window_growth
        windows = base.windows if length >= longest else first_parts(base.windows, length)
        solver = candidate_solver(base, found.effect, windows)
        fit = solver.fit(values, *solver.fit_initial_states(values, offsets))
        if length >= longest:
            return fitted_candidate(base, found.effect, solver, fit)
        before = _cost_over(base.solver(windows=windows), base.fit)
        needed = least
        if best is not None:
            of_best = 1 - _cost_over(candidate_solver(base, best.effect, windows), best.fit) / before
            needed = max(least, cfg.shooting_min_gain * of_best)
        if fit.cost > (1 - needed) * before:
            return None
        values, offsets = fit.values, fit.offsets


def _cost_over(solver: Solver, fit: Fit) -> float:
    """Return the cost of a fit over the windows of a solver, first parts of those it was fitted to."""
    residuals = solver.p.residuals(solver.trials(fit.values, fit.offsets))
    return solver.cost(residuals, fit.offsets, fit.values)
