"""Fits of one candidate effect, each a unit of parallel work: plain data in, plain data out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import held_out_errors, without_bounded
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel, ScreenedCandidate
from concent_warp.diagnosis.cfg import SearchCfg
from concent_warp.effects.effect import Effect
from concent_warp.fit.effects.least_squares import Fit, Solver
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.robust import robust_noise_ratio
from concent_warp.fit.effects.rough_windows import with_rough_windows


def candidate_solver(base: FittedModel, effect: Effect, windows: Sequence[Window] = ()) -> Solver:
    """Return the solver of the baseline with one effect more; over other windows where some are given."""
    return base.solver(effect, windows=windows or ())


def fitted_candidate(base: FittedModel, effect: Effect, solver: Solver, fit: Fit) -> FittedCandidate:
    """Return a fit of a candidate with its residuals and held-out errors."""
    model, fit = solver.p.model(fit.values), with_rough_windows(solver, fit)
    pieces = tuple(without_bounded(model, base.projected(fit)))
    sums, prior = base.held_out(pieces).sums, base.cfg.least_squares.prior
    errors = held_out_errors(model, sums, base.blocks, prior)
    ratio = robust_noise_ratio([piece.residual for piece in pieces], base.cfg.least_squares.robust)
    ratio *= base.noise_scale
    return FittedCandidate(effect, model, fit, sums, pieces, errors, ratio)


def fit_candidate(base: FittedModel, screened: ScreenedCandidate) -> FittedCandidate:
    """Fit a screened candidate together with the model's own parameters and the initial states."""
    solver = candidate_solver(base, screened.effect)
    if screened.measured:
        return fitted_candidate(base, screened.effect, solver, solver.fit(screened.start))
    fit = solver.fit(screened.start, base.fit.offsets, base.fit.starts)
    return fitted_candidate(base, screened.effect, solver, fit)


def polish_candidate(
    base: FittedModel, candidate: FittedCandidate, cfg: SearchCfg | None = None, *, thorough: bool = False
) -> FittedCandidate:
    """Return the better of a fit and its refit with initial states fitted again.

    A fit that a refit hardly bettered is returned as it is, unless `thorough`.
    """
    if candidate.polished and not thorough:
        return candidate
    cfg, solver = cfg or SearchCfg(), candidate_solver(base, candidate.effect)
    # To the last bit: a fit that no step improves has the baseline's own cost, at the effect's null value.
    stuck = candidate.fit.cost == base.fit.cost
    fit = solver.polish(candidate.fit, thorough=thorough, stuck=stuck)
    found = _better(candidate, fitted_candidate(base, candidate.effect, solver, fit))
    if found.fit.polished != fit.polished:
        found = replace(found, fit=replace(found.fit, polished=fit.polished))
    return replace(found, polished=fit.cost > (1 - cfg.min_cost_fall) * candidate.fit.cost)


def search_candidate_value(
    base: FittedModel, candidate: FittedCandidate, start: np.ndarray, cfg: SearchCfg | None = None
) -> FittedCandidate:
    """Return the better of a fit that ended where it started, at a scanned value, and a fit from values beyond it.

    Contacts make the cost rough: derivatives lead to the next local minimum of the initial states. The scanned value is
    therefore moved by larger steps, initial states fitted anew after each, for as long as the cost falls.

    Args:
        base: The fitted baseline.
        candidate: The fit.
        start: Parameters from which it started, shape (P,).
        cfg: Settings.
    """
    cfg, solver = cfg or SearchCfg(), candidate_solver(base, candidate.effect)
    away = np.where(np.isfinite(start) & np.isfinite(solver.p.start), start - solver.p.start, 0.0)
    away[: solver.p.owned] = 0.0
    if not away.any():
        return candidate
    best, measured = candidate.fit, [np.zeros_like(o) for o in candidate.fit.offsets]
    move, _ = solver.solve(best.linear, best.starts, best.offsets, best.values, base.cfg.least_squares.damping)
    forth = 1.0 if move @ (away / solver.scale) >= 0 else -1.0
    for direction in (forth, -forth):
        for _ in range(cfg.max_scan_steps):
            values = solver.inside(best.values + direction * cfg.scan_step * away)
            there = solver.improve_initial_states(replace(best, values=values), [measured], noise=0.0, fresh=False)
            if there.cost >= best.cost:
                break
            best = there
        if best is not candidate.fit:
            break
    if best.cost > (1 - cfg.min_cost_fall) * candidate.fit.cost:
        return candidate
    fit = solver.fit(best.values, best.offsets, best.starts)
    return _better(candidate, fitted_candidate(base, candidate.effect, solver, fit))


def restart_candidate(
    base: FittedModel, candidate: FittedCandidate, leader: Fit, cfg: SearchCfg | None = None, quick: bool = False
) -> FittedCandidate:
    """Return the better of a fit and its refit from the initial states of the leading candidate's fit.

    Those are taken window by window where they lower the cost, or all together with the parameters that go with them,
    which a stuck fit needs; `quick` tries the latter alone.
    """
    cfg, solver = cfg or SearchCfg(), candidate_solver(base, candidate.effect)
    start = solver.fit_at_states_of(leader, candidate.fit)
    if not quick:
        by_window = solver.improve_initial_states(candidate.fit, [leader.offsets], noise=0.0)
        start = min(by_window, start, key=lambda f: f.cost)
    if start.cost > (1 - cfg.min_cost_fall) * candidate.fit.cost:
        return candidate
    fit = solver.fit(start.values, start.offsets, start.starts)
    return _better(candidate, fitted_candidate(base, candidate.effect, solver, fit))


def restart_like(base: FittedModel, candidate: FittedCandidate, leader: FittedCandidate) -> FittedCandidate:
    """Return the better of a fit and its refit from the value of an effect that moves the same, as far as is known.

    Both have one parameter of the same unit, as a delay of commands and one of readings. Initial states begin at the
    measured ones, as those of the other effect may have another meaning: late readings show an earlier state.
    """
    solver = candidate_solver(base, candidate.effect)
    fit = solver.polish(solver.fit(leader.fit.values))
    return _better(candidate, fitted_candidate(base, candidate.effect, solver, fit))


def multiple_shooting_candidate(
    base: FittedModel, candidate: FittedCandidate, short_windows: Sequence[Window]
) -> FittedCandidate:
    """Return the better of a fit and its refit from the values of a multiple-shooting fit over short windows.

    Over long windows stick and slip cause many local minima; short ones, each with its own initial state, have few
    (multiple shooting: Bock 1983). Derivatives alone lead to these states.
    """
    cfg = base.cfg.least_squares
    states = replace(cfg.initial_states, sample_spreads=(), restart_samples=0)
    short = Solver(base.prediction(candidate.effect, windows=short_windows), replace(cfg, initial_states=states))
    values = short.fit(candidate.fit.values).values
    solver = candidate_solver(base, candidate.effect)
    fit = solver.fit(values, base.fit.offsets, base.fit.starts)
    return _better(candidate, fitted_candidate(base, candidate.effect, solver, fit))


def _better(candidate: FittedCandidate, refitted: FittedCandidate) -> FittedCandidate:
    """Return the refit where its cost is lower, else the fit as it was."""
    return refitted if refitted.fit.cost < candidate.fit.cost else candidate
