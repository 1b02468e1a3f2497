from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.fit_candidate import candidate_solver, fit_candidate, fitted_candidate
from concent_warp.diagnosis.candidates.profile_likelihood import (
    _next_distances,
    _parabola,
    _roughness,
    _standard_deviations,
    profile_point,
    refine_by_profile,
)
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import ProfileLikelihoodCfg
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.effects.effect import Parameter
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.intervals import covariance, discretisation_errors
from tests.scenes.swinging import DAMPING, drawing, swung, windows_of

CFG = ProfileLikelihoodCfg()


@pytest.fixture(scope="module")
def base():
    recording = swung()
    windows = windows_of(recording)
    return fit_baseline(drawing(recording), windows, cut_blocks(windows), "mujoco")


@pytest.fixture(scope="module")
def found(base):
    return fit_candidate(base, screen(base, effect_class("joint_damping")("hinge")))


def linear(base, candidate):
    return np.sqrt(np.diag(covariance(candidate.sums, base.blocks)))


def test_a_smooth_minimum_keeps_its_value_and_its_spread(base, found):
    after = refine_by_profile(base, found, TaskRunner())
    assert after.fit.values == pytest.approx(found.fit.values, rel=0.02)
    assert after.std == pytest.approx(linear(base, after), rel=0.2)


def test_a_fit_that_ended_beside_the_minimum_is_restarted(base, found):
    solver = candidate_solver(base, found.effect)
    beside = found.fit.values * 1.2
    offsets, starts = solver.fit_initial_states(beside, found.fit.offsets)
    pieces = solver.linearise(beside, offsets)
    cost = solver.cost([piece.residual for piece in pieces], offsets, beside)
    fit = replace(found.fit, values=beside, offsets=tuple(offsets), starts=starts, linear=pieces, cost=cost)
    stuck = fitted_candidate(base, found.effect, solver, fit)
    after = refine_by_profile(base, stuck, TaskRunner())
    assert after.fit.cost < cost - 1
    assert after.fit.values[0] == pytest.approx(DAMPING, rel=0.03)


def test_a_profile_point_has_the_cost_some_standard_deviations_away(base, found):
    assert _next_distances(base, found, [], CFG) == [(0, -CFG.first_step), (0, CFG.first_step)]
    near, far = (
        profile_point(base, found, 0, CFG.first_step, CFG),
        profile_point(base, found, 0, 3 * CFG.first_step, CFG),
    )
    assert far.values[0] > near.values[0] > found.fit.values[0]
    assert far.expected_rise == pytest.approx(9 * near.expected_rise)
    assert far.cost - found.fit.cost == pytest.approx(far.expected_rise, rel=0.3)


def test_points_farther_away_follow_where_the_cost_does_not_rise(base, found):
    clear = [profile_point(base, found, 0, distance, CFG) for distance in (-CFG.first_step, CFG.first_step)]
    flat = [replace(s, cost=found.fit.cost + 0.1) for s in clear]
    rough = [replace(s, cost=s.cost + 50.0) for s in clear]
    assert _next_distances(base, found, clear, CFG) == []
    farther = [(0, -CFG.step_growth * CFG.first_step), (0, CFG.step_growth * CFG.first_step)]
    assert _next_distances(base, found, flat, CFG) == farther
    # A rise of four times the roughness takes 3 x 50 beside it: 0.5 t^2 is that from 17.3 standard deviations on.
    assert [s.expected_rise for s in rough] == pytest.approx([2.0, 2.0], rel=0.2)
    assert _next_distances(base, found, rough, CFG) == [(k, CFG.step_growth * t) for k, t in farther]


def test_a_profile_flatter_than_its_derivatives_widens_the_interval(base, found):
    seen = [profile_point(base, found, 0, distance, CFG) for distance in (-6.0, 6.0)]
    flat = [replace(s, cost=found.fit.cost + s.expected_rise / 9) for s in seen]
    level = [replace(s, cost=found.fit.cost) for s in seen]
    aside = [replace(s, cost=found.fit.cost + s.expected_rise * (1 + 0.5 * np.sign(s.distance))) for s in seen]
    spread = linear(base, found)[0]
    assert _standard_deviations(base, found, flat, CFG)[0] == pytest.approx(3 * spread)
    assert _standard_deviations(base, found, level, CFG)[0] == pytest.approx(CFG.max_widening * spread)
    assert _standard_deviations(base, found, aside, CFG)[0] == pytest.approx(np.hypot(1, 1.5) * spread)


def test_roughness_widens_the_interval(base, found):
    near = [
        replace(profile_point(base, found, 0, distance, CFG), expected_rise=2.0, cost=found.fit.cost + 102.0)
        for distance in (-CFG.first_step, CFG.first_step)
    ]
    far = [replace(s, distance=9 * s.distance, expected_rise=162.0, cost=found.fit.cost + 100.0 + 162.0) for s in near]
    assert _roughness(found, near, 0, CFG) == pytest.approx(100.0)
    wider = np.sqrt(1 + CFG.roughness_variance * 100.0 / 0.5)  # the valley rises by 0.5 t^2
    assert _standard_deviations(base, found, [*near, *far], CFG)[0] == pytest.approx(wider * linear(base, found)[0])


def test_a_parabola_goes_through_its_points():
    at = np.array([-6.0, 2.0])
    assert _parabola(at, 0.3 * at + 0.5 * at**2) == pytest.approx((0.3, 0.5))
    assert _parabola(at[1:], 0.5 * at[1:] ** 2) == pytest.approx((0.0, 0.5))


def test_the_error_of_a_law_is_a_share_of_the_effects_size():
    gain = Parameter("gain", "-", 1.0, 0.0, 9.0, 0.3)
    limit = Parameter("limit", "N", np.inf, 0.0, 9.0, 1.0)
    x, y = (Parameter(n, "m", 0.0, -1.0, 1.0, 0.01) for n in "xy")
    assert discretisation_errors([gain], np.array([0.4]), 0.005) == pytest.approx([0.6 * 0.005])
    assert discretisation_errors([limit], np.array([3.0]), 0.005) == pytest.approx([3.0 * 0.005])
    assert discretisation_errors([limit], np.array([np.inf]), 0.005) == pytest.approx([0.0])
    assert discretisation_errors([x, y], np.array([0.02, 0.0]), 0.005) == pytest.approx([0.02 * 0.005] * 2)
