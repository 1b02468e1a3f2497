"""Profile likelihood of an accepted effect's parameters: better values nearby, and their standard deviations.

Contacts make the cost rough, so that derivatives at a point neither lead to its minimum nor give its width. The cost is
therefore evaluated some standard deviations away along the profile of each parameter: the other parameters at their
conditional optimum to first order, the initial states fitted again (Bates and Watts, Nonlinear Regression Analysis and
Its Applications, 1988, chapter 6). A point with a lower cost restarts the fit, before the profiles of further
parameters are evaluated: these would be other ones after it. Residuals that are correlated make costs differ by more
than independent ones do: falls are judged in units of this overdispersion, as quasi-likelihoods are (McCullagh and
Nelder, Generalized Linear Models, 1989, chapter 9). Where the cost rises by less than its roughness, points farther
away follow. In the end a parabola through the farthest points gives the width, the offset of the minimum, and the
variance that the roughness adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel
from concent_warp.diagnosis.candidates.fit_candidate import candidate_solver, fitted_candidate
from concent_warp.diagnosis.cfg import ProfileLikelihoodCfg
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.fit.effects.intervals import covariance
from concent_warp.simulate.time_limit import TimeUpError


@dataclass(frozen=True)
class ProfilePoint:
    """The cost at one point of a parameter's profile, initial states fitted again."""

    parameter: int
    """Index of the parameter."""
    distance: float
    """Signed distance from the fit [standard deviations]."""
    values: np.ndarray
    """All parameters, shape (P,)."""
    offsets: tuple[np.ndarray, ...]
    """Errors of the initial states in units of their standard deviation, one (2 nv,) a window."""
    starts: tuple[np.ndarray, ...]
    """Dependence of the residuals on the initial states, one (n, 2 nv) a window."""
    cost: float
    expected_rise: float
    """Rise of a quadratic cost."""

    @property
    def overdispersion(self) -> float:
        """Variance of the parameter over that which independent residuals leave, 1 at least [-].

        With these a quadratic cost rises by half the squared distance [standard deviations].
        """
        return max(2 * self.expected_rise / self.distance**2, 1.0)


def refine_by_profile(
    base: FittedModel,
    c: FittedCandidate,
    runner: TaskRunner,
    cfg: ProfileLikelihoodCfg | None = None,
    *,
    restarts: bool = True,
) -> FittedCandidate:
    """Return a candidate at a minimum of its profile likelihood, with standard deviations and roughness.

    Where the time does not suffice for all of it, they are those of the points that there are.

    Args:
        base: The baseline that it was added to.
        c: The candidate.
        runner: Runs the evaluations.
        cfg: Settings.
        restarts: Whether a lower cost restarts the fit; else it stays as it is.

    Raises:
        TimeUpError: There was no time for the first points.
    """
    cfg = cfg or ProfileLikelihoodCfg()
    left = cfg.max_restarts if restarts else 0
    points = _profile(base, c, runner, cfg, restarts=left > 0)
    while left and (best := _lower(c, points, cfg)) is not None:
        left -= 1
        try:
            found = _restarted(base, c, _line_search(base, c, best, cfg))
            points = _profile(base, found, runner, cfg, restarts=left > 0)
        except TimeUpError:
            break
        c = found
    return _with_spread(base, c, points, cfg)


def profile_point(
    base: FittedModel, c: FittedCandidate, parameter: int, distance: float, cfg: ProfileLikelihoodCfg
) -> ProfilePoint:
    """Evaluate the cost at a signed distance [standard deviations] along the profile of a parameter."""
    solver, known = candidate_solver(base, c.effect), covariance(c.sums, base.blocks, base.cfg.least_squares.prior)
    move = distance * known[parameter] / np.sqrt(known[parameter, parameter])
    move = np.where(np.isfinite(c.fit.values), move, 0.0)
    values = solver.inside(c.fit.values + move * solver.scale)
    windows = range(len(base.windows))
    offsets, starts, residuals = solver.search.refined(
        values,
        solver.first_order_offsets(c.fit, move),
        windows,
        cfg.state_iterations,
        known=dict(enumerate(c.fit.starts)),
    )
    expected = 0.5 * float(move @ c.sums.normal.sum(axis=0) @ move)
    cost = solver.cost(residuals, offsets, values)
    return ProfilePoint(parameter, distance, values, tuple(offsets), tuple(starts[w] for w in windows), cost, expected)


def _profile(
    base: FittedModel, c: FittedCandidate, runner: TaskRunner, cfg: ProfileLikelihoodCfg, *, restarts: bool
) -> list[ProfilePoint]:
    """Return points on the profile of each parameter, farther away where needed, until a lower one restarts the fit.

    Both sides of a parameter are evaluated together, one parameter after the other.
    """
    points: list[ProfilePoint] = []
    for _ in range(1 + cfg.max_extensions):
        distances, first = _next_distances(base, c, points, cfg), not points
        if not distances:
            break
        for _, each in groupby(distances, key=itemgetter(0)):
            tasks = [(base, c, *at, cfg) for at in each]
            found = runner.run_in_time(profile_point, tasks, "profile likelihood")
            finished = [s for s in found if s is not None]
            if first and len(finished) < len(found):
                raise TimeUpError("the profile likelihood was not evaluated on both sides in the time given")
            points += finished
            if len(finished) < len(found) or (restarts and _lower(c, points, cfg) is not None):
                return points
    return points


def _lower(c: FittedCandidate, points: Sequence[ProfilePoint], cfg: ProfileLikelihoodCfg) -> ProfilePoint | None:
    """Return the point with the lowest cost, None where none is below the fit's by more than they may differ.

    They differ by the overdispersion, and by the roughness of the cost: of several points about a fit one is lower by
    as much, and intervals contain that.
    """
    rough = _largest_roughness(c, points, cfg)
    lower = [s for s in points if c.fit.cost - s.cost >= max(cfg.min_cost_fall * s.overdispersion, rough)]
    return min(lower, key=lambda s: s.cost, default=None)


def _next_distances(
    base: FittedModel, c: FittedCandidate, points: Sequence[ProfilePoint], cfg: ProfileLikelihoodCfg
) -> list[tuple[int, float]]:
    """Return the points to evaluate next: parameter of the candidate, and signed distance [standard deviations].

    Both sides of each parameter at first; then farther on the sides where the cost has not risen enough, at once so far
    that a quadratic cost with the roughness would have.
    """
    rungs = [cfg.first_step * cfg.step_growth**k for k in range(1 + cfg.max_extensions)]
    prediction = base.prediction(c.effect)
    std = np.sqrt(np.diag(covariance(c.sums, base.blocks, base.cfg.least_squares.prior)))
    found = []
    for k in range(prediction.owned, len(prediction.parameters)):
        p, value = prediction.parameters[k], c.fit.values[k]
        rough = _roughness(c, points, k, cfg)
        needed = max(cfg.min_rise_over_roughness * rough, cfg.min_rise)
        for side in (-1.0, 1.0):
            farthest = _farthest(points, k, side)
            if farthest is not None and farthest.cost - c.fit.cost >= needed:
                continue
            reached = 0.0 if farthest is None else abs(farthest.distance)
            curvature = np.inf if farthest is None else farthest.expected_rise / farthest.distance**2
            within = [
                d
                for d in rungs
                if d > reached and np.isfinite(value) and p.low <= value + side * d * std[k] * p.scale <= p.high
            ]
            if within:
                found.append((k, side * next((d for d in within if curvature * d**2 + rough >= needed), within[-1])))
    return found


def _farthest(points: Sequence[ProfilePoint], parameter: int, side: float) -> ProfilePoint | None:
    """Return the farthest point on one side of a parameter, None where there is none."""
    on_side = [s for s in points if s.parameter == parameter and s.distance * side > 0]
    return max(on_side, key=lambda s: abs(s.distance), default=None)


def _line_search(base: FittedModel, c: FittedCandidate, best: ProfilePoint, cfg: ProfileLikelihoodCfg) -> ProfilePoint:
    """Return the point with the lowest cost as the distance is doubled for as long as the cost falls."""
    for _ in range(cfg.max_step_doublings):
        further = profile_point(base, c, best.parameter, 2 * best.distance, cfg)
        if further.cost > best.cost:
            break
        best = further
    return best


def _restarted(base: FittedModel, c: FittedCandidate, point: ProfilePoint) -> FittedCandidate:
    """Return the better of a fit and its refit from a point of the profile."""
    solver = candidate_solver(base, c.effect)
    found = fitted_candidate(base, c.effect, solver, solver.fit(point.values, point.offsets, point.starts))
    return found if found.fit.cost < c.fit.cost else c


def _with_spread(
    base: FittedModel, c: FittedCandidate, points: Sequence[ProfilePoint], cfg: ProfileLikelihoodCfg
) -> FittedCandidate:
    """Return a candidate with the standard deviations and the roughness that its profile gives."""
    rough = _largest_roughness(c, points, cfg)
    return replace(c, std=_standard_deviations(base, c, points, cfg), cost_roughness=rough)


def _largest_roughness(c: FittedCandidate, points: Sequence[ProfilePoint], cfg: ProfileLikelihoodCfg) -> float:
    """Return the largest roughness of any parameter, see `_roughness`."""
    return max((_roughness(c, points, k, cfg) for k in {s.parameter for s in points}), default=0.0)


def _roughness(c: FittedCandidate, points: Sequence[ProfilePoint], parameter: int, cfg: ProfileLikelihoodCfg) -> float:
    """Return the mean rise of the cost beyond its quadratic form at the first points of a parameter, at least 0."""
    near = [s for s in points if s.parameter == parameter and abs(s.distance) == cfg.first_step]
    return max(float(np.mean([s.cost - c.fit.cost - s.expected_rise for s in near])), 0.0) if near else 0.0


def _standard_deviations(
    base: FittedModel, c: FittedCandidate, points: Sequence[ProfilePoint], cfg: ProfileLikelihoodCfg
) -> np.ndarray:
    """Return the standard deviations of a candidate's parameters, in units of their scale, shape (P,).

    Those of the linear fit, increased by the flatter curvature of the profile, by the offset of its minimum and by its
    roughness.
    """
    std = np.sqrt(np.diag(covariance(c.sums, base.blocks, base.cfg.least_squares.prior)))
    for k in {s.parameter for s in points}:
        rough = _roughness(c, points, k, cfg)
        ends = [s for side in (-1, 1) if (s := _farthest(points, k, side)) is not None]
        distance = np.array([s.distance for s in ends])
        slope, curvature = _parabola(distance, np.array([s.cost - c.fit.cost - rough for s in ends]))
        if curvature <= 0:
            std[k] *= cfg.max_widening
            continue
        flatter = float(np.mean([s.expected_rise / s.distance**2 for s in ends])) / curvature
        offset = min(abs(slope) / (2 * curvature), float(np.abs(distance).max()))
        variance = max(flatter, 1.0) + offset**2 + cfg.roughness_variance * rough / curvature
        std[k] *= min(np.sqrt(variance), cfg.max_widening)
    return std


def _parabola(x: np.ndarray, rise: np.ndarray) -> tuple[float, float]:
    """Return b and c of the parabola b x + c x^2 through one or two points; b is zero for one."""
    two = len(x) > 1
    columns = np.column_stack([x, x**2] if two else [x**2])
    found = np.linalg.lstsq(columns, rise, rcond=None)[0]
    return (float(found[0]), float(found[1])) if two else (0.0, float(found[0]))
