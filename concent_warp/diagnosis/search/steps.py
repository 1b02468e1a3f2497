"""The search for a missing effect: screen all candidates cheaply, fit what survives, judge on held-out data.

Each function here is one step and one unit of parallel work: it takes plain data and returns plain data, so that it
runs in a thread, a process or on a cluster alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from concent_warp.effects.effect import Effect
from concent_warp.fit.effects.cross_validation import Blocks, HeldOut, Sums, block_sums
from concent_warp.fit.effects.initial_states import ROUNDS
from concent_warp.fit.effects.least_squares import Fit, LeastSquaresCfg, Linear, Solver, projected
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.fit.effects.robust import HUBER, huber, huber_limit, huber_weight, trust
from concent_warp.model import Model
from concent_warp.simulate.select import EngineName

BETTER = 0.01
"""Share of the cost by which other initial states have to better a fit to be worth another one."""
ROUGH = 3
"""How often the dependence on the initial states is computed for a rough fit."""
FAR = 1.0
"""Errors of initial states, in units of their spread, that count as far from what was measured."""


@dataclass(frozen=True)
class FittedModel:
    """A model with its own parameters and the initial states fitted: what a candidate has to beat."""

    model: Model
    windows: tuple[Window, ...]
    blocks: Blocks
    fit: Fit
    pieces: tuple[Linear, ...]
    """Residuals and sensitivities to the model's own parameters, initial states eliminated."""
    limit: float
    """Where the robust loss turns linear."""
    errors: np.ndarray
    """Held-out error of each block, shape (B,)."""
    engine: EngineName = "mujoco"

    @property
    def ratio(self) -> float:
        """Root mean square of the residuals over the noise, robust: 1 where the model explains all but noise."""
        return _noise_ratio(self.pieces)


@dataclass(frozen=True)
class Screened:
    """What a look at a candidate has shown, without a fit."""

    effect: Effect
    gain: float
    """Share of the held-out error that a fit would take away, by linear extrapolation."""
    scanned: float
    """Share that the best of the scanned values takes away; 0 where there is none."""
    start: np.ndarray
    """Values of all parameters from which a fit is to start, shape (P,)."""
    pieces: tuple[Linear, ...]
    """Sensitivities at the null value, initial states eliminated."""
    simulated: float
    measured: bool = False
    """Whether the fit is to start from the initial states as measured, and not from the node's."""

    @property
    def promise(self) -> float:
        """The larger of the two."""
        return max(self.gain, self.scanned)


@dataclass(frozen=True)
class Candidate:
    """A candidate that was fitted."""

    effect: Effect
    model: Model
    """The model with it."""
    fit: Fit
    sums: Sums
    pieces: tuple[Linear, ...]
    errors: np.ndarray
    """Held-out error of each block, shape (B,)."""
    ratio: float
    """Residual over noise that is left."""
    simulated: float
    spread: np.ndarray | None = None
    """Standard deviations of the parameters in units of their scale, shape (P,), where more than the linear ones are
    known, see `concent_warp.diagnosis.search.profile_likelihood`."""
    rough: float = 0.0
    """By how much luck with the initial states may have moved the cost, as far as it is known, see there."""
    polished: bool = False
    """Whether it has been taken up again for next to nothing: once more would do the same."""

    def gain(self, base: FittedModel) -> np.ndarray:
        """Return by how much the held-out error of each block falls against a node, shape (B,)."""
        return base.errors - self.errors

    def share(self, base: FittedModel) -> float:
        """Return the gain as a share of the node's held-out error."""
        return float(self.gain(base).sum() / max(base.errors.sum(), 1e-12))


def _noise_ratio(pieces: Sequence[Linear]) -> float:
    """Return the root mean square of residuals in units of noise, rows beyond `HUBER` times it weighed down."""
    pooled = np.concatenate([piece.residual for piece in pieces])
    return float(np.sqrt(np.mean(2 * huber(pooled, HUBER))))


def node(
    model: Model,
    windows: Sequence[Window],
    blocks: Blocks,
    engine: EngineName,
    *,
    rough: bool = False,
) -> FittedModel:
    """Fit a model's own parameters and the initial states; `rough`ly where all that counts is the calmest part."""
    solver = Solver(Prediction(model, (), windows, engine=engine))
    measured = [np.zeros(len(w.spread)) for w in windows]
    fit = solver.fit(None, *solver.refine_starts(solver.p.start, measured, ROUGH if rough else ROUNDS))
    if len(fit.values) and not rough:
        fit = solver.polish(fit)
        model = solver.p.model(fit.values)
    return _assessed(model, windows, blocks, fit, engine)


def without(last: FittedModel, effect: int) -> FittedModel:
    """Return the node of a model less one of its effects, all that is left fitted again."""
    model = replace(last.model, effects=tuple(a for i, a in enumerate(last.model.effects) if i != effect))
    solver = Solver(Prediction(model, (), last.windows, engine=last.engine))
    fit = solver.polish(solver.fit(offsets=last.fit.offsets, starts=last.fit.starts))
    return _assessed(solver.p.model(fit.values), last.windows, last.blocks, fit, last.engine)


def _assessed(model: Model, windows: Sequence[Window], blocks: Blocks, fit: Fit, engine: EngineName) -> FittedModel:
    """Return a fitted model as a node."""
    pieces = tuple(projected(fit))
    limit = huber_limit([piece.residual for piece in pieces])
    errors = HeldOut(block_sums(pieces, blocks, limit), blocks).own()
    return FittedModel(model, tuple(windows), blocks, fit, pieces, limit, errors, engine)


def strengthened(base: FittedModel, rivals: Sequence[Candidate]) -> FittedModel:
    """Return the node with initial states fitted anew from where its rivals have them, window by window.

    A fit may end in a local minimum of an initial state; a rival that only got out of one has explained nothing.
    """
    solver = Solver(Prediction(base.model, (), base.windows, engine=base.engine))
    fit = solver.better_starts(base.fit, [c.fit.offsets for c in rivals])
    found = _assessed(base.model, base.windows, base.blocks, fit, base.engine)
    return replace(found, limit=base.limit) if found.errors.sum() < base.errors.sum() else base


def screen(base: FittedModel, effect: Effect) -> Screened:
    """Look at what a candidate could do, from its sensitivities and a few scanned values.

    Sensitivities are taken at the node's initial states, and at the measured ones where those are far off: initial
    states that make up for a missing effect lead to where its sensitivities mean little.
    """
    solver = Solver(Prediction(base.model, (effect,), base.windows, engine=base.engine))
    values = solver.p.start.copy()
    at = _sensitive_start(solver, values)
    # What matters is the residual of the node itself; at a start off the null value it is another.
    pieces = with_residuals(projected(replace(base.fit, linear=solver.linearise(at, base.fit.offsets))), base.pieces)
    gain = _linear_gain(base, pieces, base.pieces, base.errors)
    if max(float(np.abs(o).max()) for o in base.fit.offsets) > FAR:
        zero = tuple(np.zeros_like(o) for o in base.fit.offsets)
        there = projected(replace(base.fit, linear=solver.linearise(at, zero), offsets=zero))
        plain = [replace(piece, jacobian=piece.jacobian[:, : solver.p.owned]) for piece in there]
        before = HeldOut(block_sums(plain, base.blocks, base.limit), base.blocks).own()
        gain = max(gain, _linear_gain(base, there, plain, before))
    scanned, start = _scan(solver, base, values)
    return Screened(effect, gain, scanned, start, pieces, solver.p.simulated)


def with_residuals(pieces: Sequence[Linear], of: Sequence[Linear]) -> tuple[Linear, ...]:
    """Return sensitivities with the residuals of others."""
    return tuple(replace(piece, residual=known.residual) for piece, known in zip(pieces, of, strict=True))


def _linear_gain(base: FittedModel, pieces: Sequence[Linear], plain: Sequence[Linear], before: np.ndarray) -> float:
    """Return the share of the held-out error that a linear step with the sensitivities takes away."""
    errors = HeldOut(block_sums(with_residuals(pieces, plain), base.blocks, base.limit), base.blocks).own()
    return float((before.sum() - errors.sum()) / max(before.sum(), 1e-12))


def _sensitive_start(solver: Solver, values: np.ndarray) -> np.ndarray:
    """Return where sensitivities are taken: the null values, and finite values for limits that are infinite there."""
    return np.where(np.isfinite(values), values, solver.scale)


def _scan(solver: Solver, base: FittedModel, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Try the values that parameters name for that; return the best one's gain, and where a fit is to start."""
    trials = []
    for k, parameter in enumerate(solver.p.parameters):
        if k < solver.p.owned:
            continue
        for value in parameter.scan:
            moved = values.copy()
            moved[k] = value
            trials.append(moved)
    finite = np.where(np.isfinite(values), values, solver.high)
    best, start = 0.0, finite
    if not trials:
        return best, start
    before = total(base, [piece.residual for piece in base.pieces])
    for moved in trials:
        gain = (before - total(base, remainders(solver, base, moved, base.fit.offsets))) / max(before, 1e-12)
        if gain > best:
            best, start = gain, moved
    return best, start


def remainders(
    solver: Solver, base: FittedModel, values: np.ndarray, offsets: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the residuals at some values, with what a change of the initial states takes up, to first order, left out.

    Args:
        solver: Solver of the candidate.
        base: The node; the dependence on the initial states is its own.
        values: Parameters, shape (P,).
        offsets: Errors of the initial states in units of their spread, one (2 nv,) a window.
    """
    residuals = solver.p.residuals(solver.trials(values, offsets))
    rest = []
    for r, a, o in zip(residuals, base.fit.starts, offsets, strict=True):
        near = trust(o)
        inner = np.linalg.solve(a.T @ a + np.diag(near), a.T @ r + near * o)
        rest.append(r - a @ inner)
    return rest


def total(base: FittedModel, residuals: Sequence[np.ndarray]) -> float:
    """Return the robust sum of squares of projected residuals."""
    return float(2 * sum(huber(r, base.limit).sum() for r in residuals))


def fit_candidate(base: FittedModel, screened: Screened, cfg: LeastSquaresCfg | None = None) -> Candidate:
    """Fit a candidate together with the model's own parameters and the initial states."""
    solver = Solver(Prediction(base.model, (screened.effect,), base.windows, engine=base.engine), cfg)
    if screened.measured:
        return judged(base, screened.effect, solver, solver.fit(screened.start))
    return judged(base, screened.effect, solver, solver.fit(screened.start, base.fit.offsets, base.fit.starts))


def polish_candidate(base: FittedModel, candidate: Candidate, *, thorough: bool = False) -> Candidate:
    """Take up the fit of a candidate again with initial states fitted anew; the worse of the two is dropped.

    Where that brings next to nothing, it is not done again.
    """
    if candidate.polished and not thorough:
        return candidate
    solver = Solver(Prediction(base.model, (candidate.effect,), base.windows, engine=base.engine))
    # To the last bit: a fit that no step has helped is the node's own at the value at which the effect does nothing.
    stuck = candidate.fit.cost == base.fit.cost
    found = judged(base, candidate.effect, solver, solver.polish(candidate.fit, thorough=thorough, stuck=stuck))
    best = found if found.fit.cost < candidate.fit.cost else candidate
    return replace(best, polished=found.fit.cost > (1 - BETTER) * candidate.fit.cost)


def restarted_candidate(base: FittedModel, candidate: Candidate, leader: Fit, quick: bool = False) -> Candidate:
    """Take up the fit of a candidate from the leader's initial states; the worse of the two is dropped.

    Either window by window, where they serve its parameters better, or all of them, with the parameters that go with
    them: those of a fit that is stuck do not. A `quick` one tries the latter alone.
    """
    solver = Solver(Prediction(base.model, (candidate.effect,), base.windows, engine=base.engine))
    fresh = solver.led(candidate.fit, leader)
    if not quick:
        some = solver.better_starts(candidate.fit, [leader.offsets], noise=0.0)
        fresh = min(some, fresh, key=lambda f: f.cost)
    if fresh.cost > (1 - BETTER) * candidate.fit.cost:
        return candidate
    found = judged(base, candidate.effect, solver, solver.fit(fresh.values, fresh.offsets, fresh.starts))
    return found if found.fit.cost < candidate.fit.cost else candidate


def piecewise_candidate(base: FittedModel, candidate: Candidate, pieces: Sequence[Window]) -> Candidate:
    """Take up the fit of a candidate from values that short windows lead to; the worse of the two is dropped.

    Over long windows sticking and slipping make many minima; short ones, each with an initial state of its own, have
    few (multiple shooting: Bock 1983).
    """

    def solver(windows: Sequence[Window]) -> Solver:
        return Solver(Prediction(base.model, (candidate.effect,), windows, engine=base.engine))

    values = solver(pieces).fit(candidate.fit.values).values
    long = solver(base.windows)
    found = judged(base, candidate.effect, long, long.fit(values, base.fit.offsets, base.fit.starts))
    return found if found.fit.cost < candidate.fit.cost else candidate


def extended(base: FittedModel, added: Candidate) -> FittedModel:
    """Return the node of the model that a candidate makes of a node's."""
    return _assessed(added.model, base.windows, base.blocks, added.fit, base.engine)


def judged(base: FittedModel, effect: Effect, solver: Solver, fit: Fit) -> Candidate:
    """Return a fitted candidate with its held-out gain over the node."""
    pieces = tuple(projected(fit))
    sums = block_sums(pieces, base.blocks, base.limit)
    errors = HeldOut(sums, base.blocks).own()
    return Candidate(
        effect,
        solver.p.model(fit.values),
        fit,
        sums,
        pieces,
        errors,
        _noise_ratio(pieces),
        solver.p.simulated,
    )


def chance(base: FittedModel, screened: Sequence[Screened], draws: int, seed: int) -> np.ndarray:
    """Return the largest gain of all candidates on data that lack nothing, as a share of the error, shape (draws,).

    See `concent_warp.fit.effects.cross_validation` for how such data are made.
    """
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], size=(draws, base.blocks.count))
    weight = [np.sqrt(huber_weight(piece.residual, base.limit)) for piece in base.pieces]
    square = np.zeros(base.blocks.count)
    for piece, w, rows in zip(base.pieces, weight, base.blocks.of_row, strict=True):
        square += np.bincount(rows, (piece.residual * w) ** 2, minlength=base.blocks.count)
    own = HeldOut(block_sums(base.pieces, base.blocks, base.limit), base.blocks)
    before = own.errors(signs[..., None] * own.sums.slope, square).sum(axis=1)
    best = np.full(draws, -np.inf)
    for s in screened:
        held = HeldOut(block_sums(s.pieces, base.blocks, base.limit), base.blocks)
        after = held.errors(signs[..., None] * held.sums.slope, square).sum(axis=1)
        best = np.maximum(best, (before - after) / np.maximum(before, 1e-12))
    return best
