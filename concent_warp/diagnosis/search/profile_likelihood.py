"""The values of an effect that was accepted: are there better ones nearby, and how sharply do the data tell them?

Contacts make the cost rough: derivatives at a point neither lead to the lowest point nor tell how wide its valley is.
So the cost is looked at some standard deviations away along the profile of each parameter, the other parameters where
they are likeliest then and the initial states fitted anew (Bates and Watts, Nonlinear Regression Analysis and Its
Applications, 1988, chapter 6). Where it is lower, the fit is taken up again. Where it does not rise as derivatives
promise, the looks go farther, until the valley shows through the roughness: in the end a parabola through the farthest
ones tells how wide it is, how far off its middle, and how far off the roughness may have led.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from concent_warp.diagnosis.search.steps import Candidate, FittedModel, judged
from concent_warp.fit.effects.intervals import covariance
from concent_warp.fit.effects.least_squares import Solver
from concent_warp.fit.effects.prediction import Prediction

if TYPE_CHECKING:
    pass

NEAR, FARTHER, EXTENSIONS = 2.0, 3.0, 3
"""How far to look at first, in standard deviations; how much farther then, and how often."""
ROUNDS = 4
"""How often the dependence on the initial states is computed at a look."""
WORTH = 1.0
"""Fall of the cost, half a sum of squares in units of noise, for which a fit is taken up again."""
HOPS, STRIDES = 3, 4
"""How often that is done, and how often the way to there is gone on, twice as far each time."""
SHOWN, LEAST = 4.0, 1.0
"""A valley shows where the cost has risen by so many times the roughness, and by the second number at least."""
WIDEST = 100.0
"""By how much a valley that never shows widens an interval."""
ASTRAY = 0.5
"""Share of the distance over which a valley rises by the roughness, squared, that counts as variance."""
WIDTH_ONLY = float("inf")
"""The same where nothing is taken up any more."""


@dataclass(frozen=True)
class ProfilePoint:
    """The cost some way from a fit, initial states fitted anew."""

    parameter: int
    """Along whose profile."""
    reach: float
    """How far, in standard deviations."""
    values: np.ndarray
    """Shape (P,)."""
    offsets: tuple[np.ndarray, ...]
    starts: tuple[np.ndarray, ...]
    cost: float
    expected: float
    """By how much the cost would grow if it were quadratic."""


AllOf = Callable[[Callable[..., ProfilePoint], Sequence[tuple[Any, ...]]], Sequence[ProfilePoint]]
"""Does independent pieces of work, and returns their results in order."""


def _solver_of(base: FittedModel, c: Candidate) -> Solver:
    """Return what fits a candidate."""
    return Solver(Prediction(base.model, (c.effect,), base.windows, engine=base.engine))


def _ways(base: FittedModel, c: Candidate, tried: Sequence[ProfilePoint] = ()) -> list[tuple[int, float]]:
    """Return where to look next: parameter of the candidate, and how far along its profile in standard deviations.

    Both sides of each parameter at first; farther on the sides where the valley does not show yet.
    """
    prediction = Prediction(base.model, (c.effect,), base.windows, engine=base.engine)
    spread = np.sqrt(np.diag(covariance(c.sums, base.blocks)))
    found = []
    for k in range(prediction.owned, len(prediction.parameters)):
        p, value = prediction.parameters[k], c.fit.values[k]
        rough = _roughness(c, tried, k)
        for side in (-1.0, 1.0):
            mine = [s for s in tried if s.parameter == k and s.reach * side > 0]
            far = max(mine, key=lambda s: abs(s.reach), default=None)
            if far is not None and far.cost - c.fit.cost >= max(SHOWN * rough, LEAST):
                continue
            reach = side * NEAR if far is None else FARTHER * far.reach
            if np.isfinite(value) and p.low <= value + reach * spread[k] * p.scale <= p.high:
                found.append((k, reach))
    return found


def _roughness(c: Candidate, tried: Sequence[ProfilePoint], parameter: int) -> float:
    """Return by how much the cost rises more than derivatives promise where it is looked at first, 0 if it does not."""
    near = [s for s in tried if s.parameter == parameter and abs(s.reach) == NEAR]
    return max(float(np.mean([s.cost - c.fit.cost - s.expected for s in near])), 0.0) if near else 0.0


def _look(base: FittedModel, c: Candidate, parameter: int, reach: float) -> ProfilePoint:
    """Look at the cost some way along the profile of a parameter."""
    solver, known = _solver_of(base, c), covariance(c.sums, base.blocks)
    move = reach * known[parameter] / np.sqrt(known[parameter, parameter])
    move = np.where(np.isfinite(c.fit.values), move, 0.0)
    values = solver.inside(c.fit.values + move * solver.scale)
    everywhere = range(len(base.windows))
    offsets, starts, residuals = solver.search.refined(values, solver.follow(c.fit, move), everywhere, ROUNDS)
    expected = 0.5 * float(move @ c.sums.normal.sum(axis=0) @ move)
    cost = solver.cost(residuals, offsets, values)
    return ProfilePoint(parameter, reach, values, tuple(offsets), tuple(starts[w] for w in everywhere), cost, expected)


def _taken_up(base: FittedModel, c: Candidate, seen: ProfilePoint) -> Candidate:
    """Fit a candidate from where a look has found a lower cost; what is not better in the end is dropped."""
    solver = _solver_of(base, c)
    found = judged(base, c.effect, solver, solver.fit(seen.values, seen.offsets, seen.starts))
    return found if found.fit.cost < c.fit.cost else c


def settled(base: FittedModel, c: Candidate, all_of: AllOf) -> Candidate:
    """Return a candidate with values that no look around betters, and with how sharply the data tell them.

    Args:
        base: What it was added to.
        c: The candidate.
        all_of: Does independent pieces of work.
    """
    for _ in range(HOPS):
        seen = _looks(base, c, all_of)
        best = min(seen, key=lambda s: s.cost, default=None)
        if best is None or best.cost > c.fit.cost - WORTH:
            return _told(base, c, seen)
        for _ in range(STRIDES):
            further = _look(base, c, best.parameter, 2 * best.reach)
            if further.cost > best.cost:
                break
            best = further
        c = _taken_up(base, c, best)
    return _told(base, c, _looks(base, c, all_of, WIDTH_ONLY))


def _told(base: FittedModel, c: Candidate, seen: Sequence[ProfilePoint]) -> Candidate:
    """Return a candidate with what looks around it tell: how sharp its values are, and how rough its cost."""
    rough = max((_roughness(c, seen, s.parameter) for s in seen), default=0.0)
    return replace(c, spread=_spreads(base, c, seen), rough=rough)


def _looks(base: FittedModel, c: Candidate, all_of: AllOf, worth: float = WORTH) -> list[ProfilePoint]:
    """Look around a fit, farther where need be; stop where a lower cost is found."""
    seen: list[ProfilePoint] = []
    for _ in range(1 + EXTENSIONS):
        untried = _ways(base, c, seen)
        if not untried:
            break
        seen += all_of(_look, [(base, c, *way) for way in untried])
        if min(s.cost for s in seen) < c.fit.cost - worth:
            break
    return seen


def _spreads(base: FittedModel, c: Candidate, seen: Sequence[ProfilePoint]) -> np.ndarray:
    """Return the standard deviations of a candidate's parameters, in units of their scale, shape (P,).

    Those of the linear fit, larger by what the valley is flatter, by how far its middle is off, and by how far the
    roughness may have led astray.
    """
    spread = np.sqrt(np.diag(covariance(c.sums, base.blocks)))
    for k in {s.parameter for s in seen}:
        mine, rough = [s for s in seen if s.parameter == k], _roughness(c, seen, k)
        far = [
            max((s for s in mine if s.reach * side > 0), key=lambda s: abs(s.reach), default=None) for side in (-1, 1)
        ]
        ends = [s for s in far if s is not None]
        at = np.array([s.reach for s in ends])
        linear, curved = _parabola(at, np.array([s.cost - c.fit.cost - rough for s in ends]))
        if curved <= 0:
            spread[k] *= WIDEST
            continue
        flatter = float(np.mean([s.expected / s.reach**2 for s in ends])) / curved
        off = min(abs(linear) / (2 * curved), float(np.abs(at).max()))
        spread[k] *= min(np.sqrt(max(flatter, 1.0) + off**2 + ASTRAY * rough / curved), WIDEST)
    return spread


def _parabola(at: np.ndarray, rise: np.ndarray) -> tuple[float, float]:
    """Return b and c of the parabola b x + c x^2 through two points; b is zero where they lie on one side only."""
    both = len(at) > 1
    columns = np.column_stack([at, at**2] if both else [at**2])
    found = np.linalg.lstsq(columns, rise, rcond=None)[0]
    return (float(found[0]), float(found[1])) if both else (0.0, float(found[0]))
