"""Screening of candidate effects: the expected gain of a fit, from sensitivities and a few scanned values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import without_outward
from concent_warp.diagnosis.candidates.candidate import FittedModel, ScreenedCandidate
from concent_warp.diagnosis.cfg import SearchCfg
from concent_warp.effects.effect import Effect
from concent_warp.fit.effects.cross_validation import bootstrap_interval
from concent_warp.fit.effects.least_squares import Linear, Solver
from concent_warp.fit.effects.robust import cauchy_weight, huber

FIRST_RANKING = "first ranking"
"""How the text of the progress begins that has it."""
RANKED = 4
"""Candidates in it."""


def screen(
    base: FittedModel, effect: Effect, cfg: SearchCfg | None = None, at_measured: tuple[Linear, ...] = ()
) -> ScreenedCandidate:
    """Return a candidate with the gain that a fit is expected to have.

    Sensitivities are taken and values are scanned at the baseline's initial states, and at the measured ones where
    those are far away: initial states that compensate for a missing effect lead to a point where its sensitivities mean
    little, and where no value is better than none.

    Args:
        base: The fitted baseline.
        effect: The candidate.
        cfg: Settings.
        at_measured: See `linear_at_measured_states`; computed where not given.
    """
    cfg = cfg or SearchCfg()
    solver = base.solver(effect)
    values = solver.p.start.copy()
    # Sensitivities need finite values where the null value is infinite, as that of a limit is.
    at = np.where(np.isfinite(values), values, solver.scale)
    taken_over = bool(np.isfinite(values).all())
    same = taken_over and not effect.prepares
    known = base.fit.linear if taken_over else ()
    # The residual is the baseline's own; at a start off the null value it is another.
    linear = solver.linearise(at, base.fit.offsets, known, residual_known=same)
    projected = base.projected(replace(base.fit, linear=linear))
    pieces = tuple(without_outward(base, with_residuals(projected, base.pieces)))
    gain = _linear_gain(base, pieces, base.pieces, base.errors)
    far, zero = _are_far(base, cfg), tuple(np.zeros_like(o) for o in base.fit.offsets)
    if far:
        known = (at_measured or linear_at_measured_states(base, cfg)) if taken_over else ()
        linear = solver.linearise(at, zero, known, residual_known=same)
        there = base.projected(replace(base.fit, linear=linear, offsets=zero, rough=()))
        plain = [replace(piece, jacobian=piece.jacobian[:, : solver.p.owned]) for piece in there]
        there, plain = without_outward(base, there), without_outward(base, plain)
        before = base.held_out(plain).own()
        gain = max(gain, _linear_gain(base, there, plain, before))
    scanned_gain, start = _scan(solver, base, values, base.fit.offsets, cfg)
    measured = False
    if far:
        other_gain, other = _scan(solver, base, values, zero, cfg)
        if other_gain > scanned_gain:
            scanned_gain, start, measured = other_gain, other, True
    return ScreenedCandidate(effect, gain, scanned_gain, start, pieces, measured)


def ranking(base: FittedModel, screened: Sequence[ScreenedCandidate], names: Sequence[str], seed: int = 0) -> str:
    """Return the candidates with the largest expected gains in words, with 95 % intervals over the blocks of time.

    Intervals are those of the linear step; a gain that a scanned value promises has none.

    Args:
        base: The fitted baseline.
        screened: All candidates.
        names: Their names.
        seed: Seed of the bootstrap.
    """
    said = []
    for k in sorted(range(len(screened)), key=lambda k: -screened[k].expected_gain)[:RANKED]:
        s, rng = screened[k], np.random.default_rng(seed)
        text = f"{names[k]} {100 * s.expected_gain:.0f} %"
        if s.linear_gain >= s.scanned_gain:
            gain = base.errors - base.held_out(with_residuals(s.pieces, base.pieces)).own()
            low, high = bootstrap_interval(gain, base.errors, base.blocks.demonstration, rng)
            text += f" [{100 * min(low, s.linear_gain):.0f}, {100 * max(high, s.linear_gain):.0f}]"
        said.append(text)
    return f"{FIRST_RANKING}, error expected to fall by: {', '.join(said)}"


def linear_at_measured_states(base: FittedModel, cfg: SearchCfg) -> tuple[Linear, ...]:
    """Return residuals and sensitivities of a fitted model at the measured initial states; none where it is near them.

    All candidates share them.
    """
    if not _are_far(base, cfg):
        return ()
    return base.solver().linearise(base.fit.values, [np.zeros_like(o) for o in base.fit.offsets])


def _are_far(base: FittedModel, cfg: SearchCfg) -> bool:
    """Return whether fitted initial states are far from the measured ones."""
    return max(float(np.abs(o).max()) for o in base.fit.offsets) > cfg.max_state_offset


def with_residuals(pieces: Sequence[Linear], of: Sequence[Linear]) -> tuple[Linear, ...]:
    """Return sensitivities with the residuals of others, window by window."""
    return tuple(replace(piece, residual=other.residual) for piece, other in zip(pieces, of, strict=True))


def projected_residuals(
    solver: Solver,
    base: FittedModel,
    values: np.ndarray,
    offsets: Sequence[np.ndarray],
    windows: Sequence[int] | None = None,
) -> list[np.ndarray]:
    """Return residuals by window without what a change of the initial states takes up to first order, each (n,).

    Args:
        solver: Solver of the candidate.
        base: The fitted baseline; the dependence on the initial states is its own.
        values: Parameters, shape (P,).
        offsets: Errors of the initial states in units of their standard deviation, one (2 nv,) a window.
        windows: Indices of the windows; by default all.
    """
    mine = range(len(offsets)) if windows is None else windows
    trials = solver.trials(values, offsets)
    residuals, found = solver.p.residuals([trials[w] for w in mine]), []
    for w, r in zip(mine, residuals, strict=True):
        a, o = base.fit.starts[w], offsets[w]
        near = cauchy_weight(o, base.cfg.least_squares.robust)
        inner = np.linalg.solve(a.T @ a + np.diag(near), a.T @ r + near * o)
        found.append(r - a @ inner)
    return found


def foretold_residuals(base: FittedModel) -> list[np.ndarray]:
    """Return what `projected_residuals` are compared with: those of the baseline, in `Fit.rough` windows too."""
    pieces = base.projected(replace(base.fit, rough=())) if base.fit.rough else base.pieces
    return [piece.residual for piece in pieces]


def robust_sum(base: FittedModel, residuals: Sequence[np.ndarray]) -> float:
    """Return the robust sum of squares of projected residuals."""
    return float(2 * sum(huber(r, base.limit).sum() for r in residuals))


def _linear_gain(base: FittedModel, pieces: Sequence[Linear], plain: Sequence[Linear], before: np.ndarray) -> float:
    """Return the share of the held-out error that a linear step along the sensitivities removes."""
    errors = base.held_out(with_residuals(pieces, plain)).own()
    return float((before.sum() - errors.sum()) / max(before.sum(), 1e-12))


def _scan(
    solver: Solver, base: FittedModel, values: np.ndarray, offsets: Sequence[np.ndarray], cfg: SearchCfg
) -> tuple[float, np.ndarray]:
    """Return the gain of the best scanned values, and the parameters (P,) from which to fit.

    Threshold effects such as adhesion or backlash have no sensitivity at their null value. Values that gain nothing in
    the windows with the largest residuals are simulated in no others, and those beyond one that is far worse there than
    an earlier one in no window. Limits are tried between scanned values, too, see `_between`.

    Args:
        solver: Solver of the candidate.
        base: The fitted baseline.
        values: Parameters at their null values, shape (P,).
        offsets: Errors of the initial states in units of their standard deviation, one (2 nv,) a window.
        cfg: Settings.
    """
    best, start = 0.0, np.where(np.isfinite(values), values, solver.high)
    before = np.array([robust_sum(base, [residual]) for residual in foretold_residuals(base)])
    order = np.argsort(before)[::-1]
    count = int(np.searchsorted(np.cumsum(before[order]), cfg.first_scanned_share * before.sum())) + 1
    first, rest = order[:count].tolist(), order[count:].tolist()
    first_before, total = float(before[first].sum()), max(float(before.sum()), 1e-12)
    unlimited = np.isinf(values)

    def left_first(moved: np.ndarray) -> float:
        return robust_sum(base, projected_residuals(solver, base, moved, offsets, first))

    def gain_of(moved: np.ndarray, left: float) -> float:
        if left >= first_before:
            return 0.0
        if rest:
            left += robust_sum(base, projected_residuals(solver, base, moved, offsets, rest))
        return 1 - left / total

    for outward in _outward(solver, values):
        limits = unlimited.any() and all(np.isfinite(moved[unlimited]).all() for moved in outward)
        line, tried = outward[_idle(outward, left_first) if limits else 0 :], []
        for moved in line:
            left = left_first(moved)
            tried.append(left)
            if left > max(cfg.max_scanned_rise * min(tried), first_before):
                break
            if (gain := gain_of(moved, left)) > best:
                best, start = gain, moved
        if limits and len(tried) > 1:
            moved, left = _between(line, int(np.argmin(tried)), min(tried), left_first, cfg.limit_halvings)
            if (gain := gain_of(moved, left)) > best:
                best, start = gain, moved
    return best, start


def _between(
    line: Sequence[np.ndarray], k: int, least: float, left: Callable[[np.ndarray], float], halvings: int
) -> tuple[np.ndarray, float]:
    """Return the parameters (P,) near the best of a line that leave least, and what they leave.

    What a limit takes away grows slowly from where it is first reached, and just below the true one far too much is cut
    off: the best value may lie in a narrow range between two scanned ones.

    Args:
        line: Scanned parameters, (P,) each.
        k: Which of them leaves least.
        least: What that leaves.
        left: Returns the robust sum of squares that parameters leave.
        halvings: How often the distance to the neighbours is halved.
    """
    before, best, after = line[max(k - 1, 0)], line[k], line[min(k + 1, len(line) - 1)]
    for _ in range(halvings):
        ends = [(before + best) / 2, (best + after) / 2]
        found = [left(end) if (end != best).any() else np.inf for end in ends]
        if min(found) >= least:
            before, after = ends
        elif found[0] < found[1]:
            before, best, after, least = before, ends[0], best, found[0]
        else:
            before, best, after, least = best, ends[1], after, found[1]
    return best, least


def _idle(outward: Sequence[np.ndarray], left: Callable[[np.ndarray], float]) -> int:
    """Return how many of the first values of a limit, from the largest down, are never reached: these leave the same.

    Args:
        outward: Scanned parameters, (P,) each.
        left: Returns the robust sum of squares that parameters leave.
    """
    if len(outward) < 2:
        return 0
    unreached, low, high = left(outward[0]), 0, len(outward)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if left(outward[middle]) == unreached else (low, middle)
    return low


def _outward(solver: Solver, values: np.ndarray) -> Iterator[list[np.ndarray]]:
    """Yield lines of scanned parameters of a candidate, (P,) each: from the null value to each side, and together."""

    def moved(k: int, row: Sequence[float]) -> np.ndarray:
        found = values.copy()
        found[k : k + len(row)] = row
        return found

    for k, parameter in enumerate(solver.p.parameters):
        if k < solver.p.owned:
            continue
        yield [moved(k, [v]) for v in sorted((v for v in parameter.scan if v < values[k]), reverse=True)]
        yield [moved(k, [v]) for v in sorted(v for v in parameter.scan if v > values[k])]
        for line in parameter.scan_together:
            yield [moved(k, row) for row in line]
