from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.search.profile_likelihood import (
    ASTRAY,
    FARTHER,
    NEAR,
    WIDEST,
    _look,
    _parabola,
    _roughness,
    _solver_of,
    _spreads,
    _ways,
    settled,
)
from concent_warp.diagnosis.search.steps import fit_candidate, judged, node, screen
from concent_warp.effects.effect import Parameter
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.intervals import LAW_ERROR, covariance, law_errors
from tests.scenes.swinging import DAMPING, drawing, swung, windows_of


@pytest.fixture(scope="module")
def base():
    recording = swung()
    windows = windows_of(recording)
    return node(drawing(recording), windows, cut_blocks(windows), "mujoco")


@pytest.fixture(scope="module")
def found(base):
    return fit_candidate(base, screen(base, effect_class("joint_damping")("hinge")))


def one_after_another(work, tasks):
    return [work(*task) for task in tasks]


def linear(base, candidate):
    return np.sqrt(np.diag(covariance(candidate.sums, base.blocks)))


def test_a_smooth_minimum_keeps_its_value_and_its_spread(base, found):
    after = settled(base, found, one_after_another)
    assert after.fit.values == pytest.approx(found.fit.values, rel=0.02)
    assert after.spread == pytest.approx(linear(base, after), rel=0.2)


def test_a_fit_that_ended_beside_the_minimum_is_taken_up_again(base, found):
    solver = _solver_of(base, found)
    beside = found.fit.values * 1.2
    offsets, starts = solver.refine_starts(beside, found.fit.offsets)
    pieces = solver.linearise(beside, offsets)
    cost = solver.cost([piece.residual for piece in pieces], offsets, beside)
    fit = replace(found.fit, values=beside, offsets=tuple(offsets), starts=starts, linear=pieces, cost=cost)
    stuck = judged(base, found.effect, solver, fit)
    after = settled(base, stuck, one_after_another)
    assert after.fit.cost < cost - 1
    assert after.fit.values[0] == pytest.approx(DAMPING, rel=0.03)


def test_a_look_tells_what_the_cost_is_some_deviations_away(base, found):
    assert _ways(base, found) == [(0, -NEAR), (0, NEAR)]
    near, far = _look(base, found, 0, NEAR), _look(base, found, 0, 3 * NEAR)
    assert far.values[0] > near.values[0] > found.fit.values[0]
    assert far.expected == pytest.approx(9 * near.expected)
    assert far.cost - found.fit.cost == pytest.approx(far.expected, rel=0.3)


def test_looks_go_farther_where_the_valley_does_not_show(base, found):
    clear = [_look(base, found, 0, reach) for reach in (-NEAR, NEAR)]
    flat = [replace(s, cost=found.fit.cost + 0.1) for s in clear]
    rough = [replace(s, cost=s.cost + 50.0) for s in clear]
    assert _ways(base, found, clear) == []
    farther = [(0, -FARTHER * NEAR), (0, FARTHER * NEAR)]
    assert _ways(base, found, flat) == farther
    assert _ways(base, found, rough) == farther


def test_a_valley_that_is_flatter_than_derivatives_say_widens_the_interval(base, found):
    seen = [_look(base, found, 0, reach) for reach in (-6.0, 6.0)]
    flat = [replace(s, cost=found.fit.cost + s.expected / 9) for s in seen]
    level = [replace(s, cost=found.fit.cost) for s in seen]
    aside = [replace(s, cost=found.fit.cost + s.expected * (1 + 0.5 * np.sign(s.reach))) for s in seen]
    spread = linear(base, found)[0]
    assert _spreads(base, found, flat)[0] == pytest.approx(3 * spread)
    assert _spreads(base, found, level)[0] == pytest.approx(WIDEST * spread)
    assert _spreads(base, found, aside)[0] == pytest.approx(np.hypot(1, 1.5) * spread)


def test_roughness_widens_the_interval_by_how_far_it_may_lead_astray(base, found):
    near = [replace(_look(base, found, 0, reach), expected=2.0, cost=found.fit.cost + 102.0) for reach in (-NEAR, NEAR)]
    far = [replace(s, reach=9 * s.reach, expected=162.0, cost=found.fit.cost + 100.0 + 162.0) for s in near]
    assert _roughness(found, near, 0) == pytest.approx(100.0)
    wider = np.sqrt(1 + ASTRAY * 100.0 / 0.5)  # the valley rises by 0.5 t^2
    assert _spreads(base, found, [*near, *far])[0] == pytest.approx(wider * linear(base, found)[0])


def test_a_parabola_goes_through_its_points():
    at = np.array([-6.0, 2.0])
    assert _parabola(at, 0.3 * at + 0.5 * at**2) == pytest.approx((0.3, 0.5))
    assert _parabola(at[1:], 0.5 * at[1:] ** 2) == pytest.approx((0.0, 0.5))


def test_the_error_of_a_law_is_a_share_of_the_effects_size():
    gain = Parameter("gain", "-", 1.0, 0.0, 9.0, 0.3)
    limit = Parameter("limit", "N", np.inf, 0.0, 9.0, 1.0)
    x, y = (Parameter(n, "m", 0.0, -1.0, 1.0, 0.01) for n in "xy")
    assert law_errors([gain], np.array([0.4])) == pytest.approx([0.6 * LAW_ERROR])
    assert law_errors([limit], np.array([3.0])) == pytest.approx([3.0 * LAW_ERROR])
    assert law_errors([limit], np.array([np.inf])) == pytest.approx([0.0])
    assert law_errors([x, y], np.array([0.02, 0.0])) == pytest.approx([0.02 * LAW_ERROR] * 2)
