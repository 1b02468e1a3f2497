"""Baselines of the search: a model with its own parameters and the initial states fitted, and its held-out errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import is_

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel, nominal_parameters
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.cross_validation import Blocks, HeldOut, Sums, block_sums
from concent_warp.fit.effects.intervals import FittedParameter
from concent_warp.fit.effects.least_squares import Fit, Linear, Solver, projected
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.fit.effects.robust import huber, huber_limit
from concent_warp.fit.effects.rough_windows import with_rough_windows
from concent_warp.model import Model
from concent_warp.simulate.select import EngineName
from concent_warp.simulate.time_limit import unlimited

BOUND_DISTANCE = 1e-3
"""Distance from a bound up to which a parameter is at it, in units of its scale [-]; that of `FittedParameter`."""


def fit_baseline(
    model: Model,
    windows: Sequence[Window],
    blocks: Blocks,
    engine: EngineName = "mujoco",
    *,
    cfg: EffectSolverCfg | None = None,
) -> FittedModel:
    """Fit a model's own parameters and the initial states of all windows.

    Args:
        model: The model.
        windows: The measured windows.
        blocks: Blocks of time of the windows' residuals.
        engine: Which engine simulates.
        cfg: Settings.
    """
    cfg = cfg or EffectSolverCfg()
    solver = Solver(Prediction(model, (), windows, engine=engine, cfg=cfg.prediction), cfg.least_squares)
    measured = [np.zeros(len(w.spread)) for w in windows]
    fit = solver.fit(None, *solver.fit_initial_states(solver.p.start, measured))
    if len(fit.values):
        fit = solver.polish(fit)
        model = solver.p.model(fit.values)
    return fitted_model(model, windows, blocks, fit, engine, cfg)


def refit_without_effect(last: FittedModel, effect: int) -> FittedModel:
    """Return the fitted model without one of its effects, by its index, all that is left fitted again."""
    model = replace(last.model, effects=tuple(a for i, a in enumerate(last.model.effects) if i != effect))
    solver = replace(last, model=model).solver()
    fit = solver.polish(solver.fit(offsets=last.fit.offsets, starts=last.fit.starts))
    return fitted_model(solver.p.model(fit.values), last.windows, last.blocks, fit, last.engine, last.cfg)


def without_effect(last: FittedModel, effect: int, among: Sequence[FittedModel]) -> FittedModel | None:
    """Return which of some models is the last one without an effect, fitted to the same windows; None for none.

    Args:
        last: The fitted model.
        effect: Index of the effect.
        among: Fitted models.
    """
    left = [added.effect for i, added in enumerate(last.model.effects) if i != effect]
    for one in among:
        same_windows = len(one.windows) == len(last.windows) and all(map(is_, one.windows, last.windows))
        if same_windows and [added.effect for added in one.model.effects] == left:
            return one
    return None


def add_candidate(base: FittedModel, added: FittedCandidate) -> FittedModel:
    """Return the baseline with the effect of a fitted candidate."""
    return fitted_model(added.model, base.windows, base.blocks, added.fit, base.engine, base.cfg)


def refit_from_rivals(base: FittedModel, rivals: Sequence[FittedCandidate]) -> FittedModel:
    """Return the baseline with the best initial state of each window, also tried from those of its rivals.

    A fit may end in a local minimum of an initial state; a rival that only left such a minimum has explained nothing.
    """
    solver = base.solver()
    fit = solver.improve_initial_states(base.fit, [c.fit.offsets for c in rivals])
    found = fitted_model(base.model, base.windows, base.blocks, fit, base.engine, base.cfg)
    return replace(found, limit=base.limit) if found.errors.sum() < base.errors.sum() else base


def fitted_model(
    model: Model, windows: Sequence[Window], blocks: Blocks, fit: Fit, engine: EngineName, cfg: EffectSolverCfg
) -> FittedModel:
    """Return a fitted model with its residuals, the limit of its robust loss and its held-out errors.

    The few simulations that this takes are made although the time may be over: the fit would be lost without them.
    """
    settings = cfg.least_squares
    solver = Solver(Prediction(model, (), windows, engine=engine, cfg=cfg.prediction), settings)
    with unlimited():
        fit = with_rough_windows(solver, fit)
    pieces = tuple(without_bounded(model, projected(fit, settings.robust)))
    limit = huber_limit([piece.residual for piece in pieces], settings.robust)
    errors = held_out_errors(model, block_sums(pieces, blocks, limit), blocks, settings.prior)
    return FittedModel(model, tuple(windows), blocks, fit, pieces, limit, errors, engine, cfg)


def errors_like(one: FittedModel, base: FittedModel) -> np.ndarray:
    """Return the held-out error of each block of a fitted model, shape (B,), with the robust loss of another one.

    The limit of the loss follows the spread of the residuals. Errors of which each has its own limit fall by more than
    the residuals do where a few are large: those that are compared have that of the simpler model.

    Args:
        one: The fitted model.
        base: What it is compared with, over the same blocks.
    """
    if one.limit == base.limit:
        return one.errors
    sums = block_sums(one.pieces, one.blocks, base.limit)
    return held_out_errors(one.model, sums, one.blocks, one.cfg.least_squares.prior)


def cost_like(one: FittedModel, base: FittedModel) -> float:
    """Return the cost of the fit of a model with the robust loss of another one, see `errors_like`.

    Args:
        one: The fitted model.
        base: What it is compared with.
    """
    if one.limit == base.limit:
        return one.fit.cost
    own, other = (
        huber_limit([w.residual for w in fitted.fit.linear], fitted.cfg.least_squares.robust) for fitted in (one, base)
    )
    change = sum(float((huber(w.residual, other) - huber(w.residual, own)).sum()) for w in one.fit.linear)
    return one.fit.cost + change


def held_out_errors(model: Model, sums: Sums, blocks: Blocks, prior: float) -> np.ndarray:
    """Return the held-out error of each block, shape (B,), for the residuals of a fitted model.

    Parameters at a bound beyond which the error would fall further stay there: a fit without a fold leads beyond it as
    little as that to all data, and what a linear step there would remove is no gain.

    Args:
        model: The fitted model.
        sums: Sums over the blocks of its residuals and sensitivities.
        blocks: The blocks.
        prior: See `LeastSquaresCfg.prior`.
    """
    plain = replace(model, effects=()).compile()
    parameters = [p for added in model.effects for p in added.effect.parameters(plain)]
    values = np.array([value for added in model.effects for value in added.values])
    low, high, scale = np.array([(p.low, p.high, p.scale) for p in parameters]).reshape(-1, 3).T
    slope = sums.slope.sum(axis=0)
    held = (values <= low + BOUND_DISTANCE * scale) & (slope > 0)
    held |= (values >= high - BOUND_DISTANCE * scale) & (slope < 0)
    free = np.where(held, 0.0, 1.0)
    sums = replace(sums, normal=sums.normal * np.outer(free, free), slope=sums.slope * free)
    return HeldOut(sums, blocks, prior, nominal_parameters(model)).of_fit()


def without_bounded(model: Model, pieces: Sequence[Linear]) -> Sequence[Linear]:
    """Return sensitivities of 0 to nominal values at their bounds, beyond which no linear step may lead.

    Args:
        model: The fitted model.
        pieces: Residuals and sensitivities by window.
    """
    if not any(added.effect.nominal for added in model.effects):
        return pieces
    mask = np.ones(pieces[0].jacobian.shape[1])
    directions = _ways_out(model)
    mask[: len(directions)] = directions == 0
    return [replace(piece, jacobian=piece.jacobian * mask) for piece in pieces]


def without_outward(base: FittedModel, pieces: Sequence[Linear]) -> Sequence[Linear]:
    """Return sensitivities of 0 to nominal values at their bounds that a linear step would lead beyond these.

    Beside a candidate a nominal value may leave the bound to which the lack of it has led. Those that a step of all
    parameters moves outward are held one after another, until none is (active set method: Nocedal and Wright,
    "Numerical Optimization", section 16.5).

    Args:
        base: The fitted model.
        pieces: Residuals and sensitivities by window, to parameters of a candidate, too, behind those of the model.
    """
    ways = _ways_out(base.model)
    if not ways.any():
        return pieces
    size, prior = pieces[0].jacobian.shape[1], base.cfg.least_squares.prior
    ways = np.pad(ways, (0, size - len(ways)))
    sums = block_sums(pieces, base.blocks, base.limit)
    normal, slope = sums.normal.sum(axis=0) + np.eye(size) / prior**2, sums.slope.sum(axis=0)
    slope[: len(base.fit.values)] += base.solver().prior(base.fit.values) / prior
    free = np.ones(size, dtype=bool)
    while True:
        move = np.zeros(size)
        move[free] = -np.linalg.pinv(normal[np.ix_(free, free)], hermitian=True) @ slope[free]
        outward = free & (ways * move > 0)
        if not outward.any():
            return [replace(piece, jacobian=piece.jacobian * free) for piece in pieces]
        free &= ~outward


def _ways_out(model: Model) -> np.ndarray:
    """Return for each parameter of a model's effects which way leads out of its bounds, shape (P,): 1, -1 or 0.

    It is 0 where the value is not at a bound, and for all that are no nominal values.
    """
    plain, found = replace(model, effects=()).compile(), []
    for added in model.effects:
        for p, value in zip(added.effect.parameters(plain), added.values, strict=True):
            at_bound = added.effect.nominal and FittedParameter.within(p, value, 0.0).at_bound
            found.append((1 if value > p.null else -1) if at_bound else 0)
    return np.array(found, dtype=int)
