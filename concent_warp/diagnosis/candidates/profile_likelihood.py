"""Profile likelihood of an accepted effect's parameters: better values nearby, and their standard deviations.

Contacts make the cost rough, so that derivatives at a point neither lead to its minimum nor give its width. The cost is
therefore evaluated some standard deviations away along the profile of each parameter: the other parameters at their
conditional optimum to first order, the initial states fitted again (Bates and Watts, Nonlinear Regression Analysis and
Its Applications, 1988, chapter 6). A point with a lower cost restarts the fit. Where the cost rises by less than its
roughness, points farther away follow. In the end a parabola through the farthest points gives the width, the offset of
the minimum, and the variance that the roughness adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel
from concent_warp.diagnosis.candidates.fit_candidate import candidate_solver, fitted_candidate
from concent_warp.diagnosis.cfg import ProfileLikelihoodCfg
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.fit.effects.intervals import covariance


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


def refine_by_profile(
    base: FittedModel, c: FittedCandidate, runner: TaskRunner, cfg: ProfileLikelihoodCfg | None = None
) -> FittedCandidate:
    """Return a candidate at a minimum of its profile likelihood, with standard deviations and roughness.

    Args:
        base: The baseline that it was added to.
        c: The candidate.
        runner: Runs the evaluations.
        cfg: Settings.
    """
    cfg = cfg or ProfileLikelihoodCfg()
    for _ in range(cfg.max_restarts):
        points = _profile(base, c, runner, cfg, cfg.min_cost_fall)
        best = min(points, key=lambda s: s.cost, default=None)
        if best is None or best.cost > c.fit.cost - cfg.min_cost_fall:
            return _with_spread(base, c, points, cfg)
        c = _restarted(base, c, _line_search(base, c, best, cfg))
    return _with_spread(base, c, _profile(base, c, runner, cfg, float("inf")), cfg)


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
    base: FittedModel, c: FittedCandidate, runner: TaskRunner, cfg: ProfileLikelihoodCfg, min_cost_fall: float
) -> list[ProfilePoint]:
    """Return points on the profile of each parameter, farther away where needed, until one has a lower cost."""
    points: list[ProfilePoint] = []
    for _ in range(1 + cfg.max_extensions):
        distances = _next_distances(base, c, points, cfg)
        if not distances:
            break
        tasks = [(base, c, *each, cfg) for each in distances]
        points += runner.run(profile_point, tasks, "profile likelihood")
        if min(s.cost for s in points) < c.fit.cost - min_cost_fall:
            break
    return points


def _next_distances(
    base: FittedModel, c: FittedCandidate, points: Sequence[ProfilePoint], cfg: ProfileLikelihoodCfg
) -> list[tuple[int, float]]:
    """Return the points to evaluate next: parameter of the candidate, and signed distance [standard deviations].

    Both sides of each parameter at first; then farther on the sides where the cost has not risen enough.
    """
    prediction = base.prediction(c.effect)
    std = np.sqrt(np.diag(covariance(c.sums, base.blocks, base.cfg.least_squares.prior)))
    found = []
    for k in range(prediction.owned, len(prediction.parameters)):
        p, value = prediction.parameters[k], c.fit.values[k]
        needed = max(cfg.min_rise_over_roughness * _roughness(c, points, k, cfg), cfg.min_rise)
        for side in (-1.0, 1.0):
            farthest = _farthest(points, k, side)
            if farthest is not None and farthest.cost - c.fit.cost >= needed:
                continue
            distance = side * cfg.first_step if farthest is None else cfg.step_growth * farthest.distance
            if np.isfinite(value) and p.low <= value + distance * std[k] * p.scale <= p.high:
                found.append((k, distance))
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
    rough = max((_roughness(c, points, s.parameter, cfg) for s in points), default=0.0)
    return replace(c, std=_standard_deviations(base, c, points, cfg), cost_roughness=rough)


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
