"""Steps of a profile likelihood, with costs that are made up."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates import profile_likelihood
from concent_warp.diagnosis.candidates.profile_likelihood import (
    ProfilePoint,
    _farthest,
    _line_search,
    _lower,
    _profile,
    _roughness,
    refine_by_profile,
)
from concent_warp.diagnosis.cfg import ProfileLikelihoodCfg
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.simulate.time_limit import TimeUpError
from tests.diagnosis.candidates.made_up_fit import made

ANY: Any = None


def point(distance: float, cost: float, rise: float = 0.0, parameter: int = 0) -> Any:
    """Return a point of a profile."""
    return ProfilePoint(parameter, distance, np.zeros(1), (), (), cost, rise)


def test_the_farthest_points_and_the_roughness_of_a_profile_are_those_of_its_parameter():
    points = [point(2.0, 1), point(-6.0, 2), point(6.0, 3), point(9.0, 4, parameter=1), point(-2.0, 5)]
    assert _farthest(points, 0, 1.0) is points[2]
    assert _farthest(points, 0, -1.0) is points[1]
    assert _farthest(points, 1, -1.0) is None
    cfg, c = ProfileLikelihoodCfg(), made("c", 0.5, 10.0)
    near = [point(2.0, 17.0, 2.0), point(-2.0, 13.0, 2.0), point(6.0, 99.0, 1.0), point(2.0, 99.0, 1.0, parameter=1)]
    assert _roughness(c, near, 0, cfg) == pytest.approx(3.0)
    assert _roughness(c, near[:1], 0, cfg) == pytest.approx(5.0)
    assert _roughness(c, [point(2.0, 11.0, 2.0)], 0, cfg) == 0.0
    assert _roughness(c, near[2:3], 0, cfg) == 0.0


def test_a_distance_is_doubled_as_long_as_the_cost_falls(monkeypatch):
    for costs, end, count in (([9, 8, 8.5, 7], 4.0 * 2, 3), ([9, 8, 7, 6, 5, 4], 2.0 * 16, 4), ([11], 2.0, 1)):
        left, asked = iter(costs), []

        def evaluate(_base, _c, parameter, distance, _cfg, left=left, asked=asked):
            asked.append(distance)
            return point(distance, next(left), parameter=parameter)

        monkeypatch.setattr(profile_likelihood, "profile_point", evaluate)
        found = _line_search(ANY, ANY, point(2.0, 10.0), ProfileLikelihoodCfg())
        assert found.distance == end
        assert asked == [2.0 * 2**k for k in range(1, count + 1)]


def test_a_lower_cost_counts_beyond_what_correlated_residuals_make_of_it():
    c, cfg = made("c", 0.5, 100.0), ProfileLikelihoodCfg()
    # Independent residuals: a rise of 2 at two standard deviations. Here 8, a variance four times as large.
    assert [point(2.0, 0.0, rise).overdispersion for rise in (0.0, 2.0, 8.0)] == [1.0, 1.0, 4.0]
    assert point(-6.0, 0.0, 72.0).overdispersion == 4.0
    assert _lower(c, [point(2.0, 96.5, 8.0)], cfg) is None
    lower = [point(2.0, 95.9, 8.0), point(-2.0, 98.9, 2.0)]
    assert _lower(c, lower, cfg) is lower[0]
    assert _lower(c, lower[1:], cfg) is lower[1]
    assert _lower(c, [], cfg) is None
    # Another parameter's profile is rough: 10 above the parabola.
    assert _lower(c, [*lower, point(2.0, 112.0, 2.0, parameter=1)], cfg) is None
    deep = point(-2.0, 89.9, 2.0)
    assert _lower(c, [deep, point(2.0, 112.0, 2.0, parameter=1)], cfg) is deep


def test_a_profile_that_the_time_does_not_suffice_for_is_that_of_the_points_there_are(monkeypatch):
    monkeypatch.setattr(profile_likelihood, "_with_spread", lambda _b, c, points, _cfg: (c.cost, len(points)))
    monkeypatch.setattr(profile_likelihood, "_line_search", lambda _b, _c, best, _cfg: best)
    monkeypatch.setattr(profile_likelihood, "_restarted", lambda _b, c, best: replace(c, cost=best.cost))
    rounds = [[(0, -2.0), (0, 2.0)], [(0, -6.0), (0, 6.0)]]

    def next_distances(_base, _c, points, _cfg):
        return rounds[len(points) // 2] if len(points) < 4 else []

    monkeypatch.setattr(profile_likelihood, "_next_distances", next_distances)
    for costs, found in (
        ([101.0, 101.0, 103.0, 103.0], (100.0, 4)),
        ([101.0, 101.0, 103.0, None], (100.0, 3)),  # what is there
        ([101.0, 90.0, None, None], (100.0, 2)),  # the restart was not evaluated: the profile before it
        ([101.0, None], None),
    ):
        left = iter(costs)

        def evaluate(_base, _c, parameter, distance, _cfg, left=left):
            if (cost := next(left)) is None:
                raise TimeUpError
            return point(distance, cost, 2.0, parameter)

        monkeypatch.setattr(profile_likelihood, "profile_point", evaluate)
        if found is None:
            with pytest.raises(TimeUpError):
                refine_by_profile(ANY, made("c", 0.5), TaskRunner())
        else:
            assert refine_by_profile(ANY, made("c", 0.5), TaskRunner()) == found


def test_a_profile_restarts_from_lower_costs_a_few_times(monkeypatch):
    cfg, seen = ProfileLikelihoodCfg(), []
    for falls, restarts in (([0.5], 0), ([2.0, 0.0], 1), ([2.0] * 9, 3)):
        left, done = iter(falls), []

        def profile(_base, c, _runner, _cfg, *, restarts, left=left, done=done):
            done.append(restarts)
            return [point(2.0, c.cost - (next(left) if restarts else 0.0))]

        monkeypatch.setattr(profile_likelihood, "_profile", profile)
        monkeypatch.setattr(profile_likelihood, "_line_search", lambda _b, _c, best, _cfg: best)
        monkeypatch.setattr(profile_likelihood, "_restarted", lambda _b, c, best: replace(c, cost=best.cost))
        monkeypatch.setattr(profile_likelihood, "_with_spread", lambda _b, c, points, _cfg: (c, len(points)))
        found: Any = refine_by_profile(ANY, made("c", 0.5), TaskRunner(), cfg)
        assert found[0].cost == 100.0 - 2.0 * restarts
        assert len(done) == restarts + 1
        assert done[-1] == (restarts < 3)
        seen.append(found[1])
    assert seen == [1, 1, 1]
    monkeypatch.setattr(profile_likelihood, "_profile", lambda *_, restarts: [point(2.0, 0.0)] * (not restarts))
    still: Any = refine_by_profile(ANY, made("c", 0.5), TaskRunner(), restarts=False)
    assert (still[0].cost, still[1]) == (100.0, 1)
    none: Any = refine_by_profile(ANY, made("c", 0.5), TaskRunner())
    assert none[1] == 0


def test_a_lower_cost_restarts_before_further_parameters_are_evaluated(monkeypatch):
    asked: list[tuple[int, float]] = []
    costs = {(0, -2.0): 101.0, (0, 2.0): 90.0, (1, -2.0): 101.0, (1, 2.0): 101.0}

    def evaluate(_base, _c, parameter, distance, _cfg):
        asked.append((parameter, distance))
        return point(distance, costs[parameter, distance], 2.0, parameter)

    monkeypatch.setattr(profile_likelihood, "_next_distances", lambda _b, _c, points, _cfg: [] if points else [*costs])
    monkeypatch.setattr(profile_likelihood, "profile_point", evaluate)
    cfg, c = ProfileLikelihoodCfg(), made("c", 0.5, 100.0)
    found = _profile(ANY, c, TaskRunner(), cfg, restarts=True)
    assert [s.cost for s in found] == [101.0, 90.0]
    assert asked == [(0, -2.0), (0, 2.0)]
    assert len(_profile(ANY, c, TaskRunner(), cfg, restarts=False)) == 4
    costs[0, 2.0] = 101.0
    assert len(_profile(ANY, c, TaskRunner(), cfg, restarts=True)) == 4
