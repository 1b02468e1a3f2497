from dataclasses import replace

import numpy as np
import pytest

from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.initial_states import InitialStateCfg, start_step
from concent_warp.fit.effects.least_squares import Fit, LeastSquaresCfg, Linear, Solver, projected
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.fit.effects.robust import RobustLossCfg, cauchy_weight
from tests.scenes.bouncing import SPREAD, bounced
from tests.scenes.swinging import DAMPING, NOISE, drawing, swung, windows_of


def solver_for(recording, *names, length=None):
    effects = [effect_class(name)("hinge") for name in names]
    return Solver(Prediction(drawing(recording), effects, windows_of(recording, length)))


def test_the_damping_that_was_left_out_is_found():
    solver = solver_for(swung(), "joint_damping")
    fit = solver.polish(solver.fit())
    assert fit.converged
    assert fit.values[0] == pytest.approx(DAMPING, rel=0.02)
    residual = np.concatenate([piece.residual for piece in fit.linear])
    assert np.std(residual) == pytest.approx(1.0, abs=0.15)


def test_an_effect_that_is_not_there_stays_near_its_null_value():
    fit = solver_for(swung(damping=0.0), "joint_damping").fit()
    assert abs(fit.values[0]) < 0.02 * DAMPING


def test_two_effects_at_once_are_distinguished():
    fit = solver_for(swung(), "joint_damping", "armature").fit()
    assert fit.values[0] == pytest.approx(DAMPING, rel=0.03)
    assert abs(fit.values[1]) < 5e-5


def test_a_wrong_initial_angle_is_found_along_with_the_damping():
    solver = solver_for(swung(told=0.006), "joint_damping")
    fit = solver.fit()
    start = fit.offsets[0] * solver.p.windows[0].spread
    assert start[0] == pytest.approx(-0.006, abs=1e-3)
    assert fit.values[0] == pytest.approx(DAMPING, rel=0.03)


def test_initial_states_alone_are_fitted_at_fixed_parameters():
    solver = solver_for(swung(told=0.006), "joint_damping", length=0.5)
    values = np.array([DAMPING])
    zero = [np.zeros(2) for _ in solver.p.windows]
    offsets, starts = solver.fit_initial_states(values, zero)
    before, after = (solver.p.residuals(solver.trials(values, o)) for o in (zero, offsets))
    assert solver.cost(after, offsets, values) < 0.5 * solver.cost(before, zero, values)
    assert offsets[0][0] * solver.p.windows[0].spread[0] == pytest.approx(-0.006, abs=1.5e-3)
    assert [a.shape for a in starts] == [(w.count, 2) for w in solver.p.windows]


def test_initial_states_that_cannot_get_below_a_rival_are_given_up():
    solver = solver_for(swung(told=0.006))
    zero, simulated = [np.zeros(2)], []
    for rival in (None, {0: -1e9}):
        before = solver.p.simulated
        solver.search.refined(np.zeros(0), zero, [0], 6, rival)
        simulated.append(solver.p.simulated - before)
    assert simulated[1] < simulated[0]


def test_outliers_hardly_move_the_estimate():
    recording = swung()
    channel = recording.demonstrations[0].measured["angle"]
    channel.value[20::40] += 0.3
    fit = solver_for(recording, "joint_damping").fit()
    assert fit.values[0] == pytest.approx(DAMPING, rel=0.06)


def test_a_fit_ends_no_worse_than_it_began_and_taking_it_up_again_no_worse_either():
    solver = solver_for(swung(), "joint_damping")
    offsets, starts = solver.fit_initial_states(solver.p.start, [np.zeros(2)])
    begun = solver.cost(solver.p.residuals(solver.trials(solver.p.start, offsets)), offsets, solver.p.start)
    fit = solver.fit(solver.p.start, offsets, starts)
    assert fit.cost < begun
    assert solver.polish(fit).cost <= fit.cost * (1 + 1e-9)


def test_of_many_windows_a_sample_leads_all_to_the_parameters():
    solver = solver_for(swung(told=0.006), "joint_damping", length=0.1)
    count = len(solver.p.windows)
    assert count > solver.cfg.max_polished_windows
    values, zero = np.array([3 * DAMPING]), tuple(np.zeros(2) for _ in range(count))
    offsets, starts = solver.fit_initial_states(values, zero)
    linear = solver.linearise(values, offsets)
    begun = Fit(
        values, tuple(offsets), solver.cost([x.residual for x in linear], offsets, values), linear, starts, True, 0.0
    )
    found = solver.polish(begun)
    assert found.values[0] == pytest.approx(DAMPING, rel=0.05)
    assert found.cost < begun.cost
    assert [len(x) for x in (found.offsets, found.linear, found.starts)] == [count] * 3


def test_where_a_sample_of_windows_gains_nothing_the_fit_stays():
    solver = solver_for(swung(), "joint_damping", length=0.1)
    fit = solver.fit()
    assert solver.polish(fit) is fit


def test_the_initial_state_of_another_fit_leads_a_stuck_one_to_the_parameters_that_go_with_it():
    solver = solver_for(swung(told=0.006), "joint_damping")
    good = solver.fit()
    values, zero = np.array([1.5 * DAMPING]), (np.zeros(2),)
    linear = solver.linearise(values, zero)
    stuck = Fit(values, zero, np.inf, linear, good.starts, True, 0.0)
    found = solver.fit_at_states_of(good, stuck)
    assert found.values[0] == pytest.approx(DAMPING, rel=0.1)
    assert found.offsets[0] == pytest.approx(good.offsets[0])
    assert found.cost == pytest.approx(good.cost, rel=0.05)


def test_values_stay_within_their_bounds_and_infinite_ones_stay_infinite():
    solver = solver_for(swung(), "joint_damping", "joint_friction")
    assert solver.inside(np.array([-1.0, np.inf])).tolist() == [solver.low[0], np.inf]
    assert solver.inside(np.array([1e9, 0.0])).tolist() == [solver.high[0], 0.0]
    gained = swung(damping=0.0)
    channel = gained.demonstrations[0].measured["angle"]
    channel.value[:] *= 1.05  # swings further than any damping allows
    fit = solver_for(gained, "joint_damping").fit()
    assert fit.values[0] == 0.0


def test_what_an_initial_state_can_take_up_is_projected_out():
    rng = np.random.default_rng(0)
    start = 1e3 * rng.normal(size=(30, 2))
    rest = rng.normal(size=(30, 1))
    rest -= start @ np.linalg.lstsq(start, rest, rcond=None)[0]
    piece = Linear(rest[:, 0] + start @ [0.3, -0.2], 2 * rest + start @ [[1.0], [2.0]])
    fit = Fit(np.zeros(1), (np.zeros(2),), 0.0, (piece,), (start,), True, 0.0)
    (found,) = projected(fit)
    np.testing.assert_allclose(found.residual, rest[:, 0], atol=1e-3)
    np.testing.assert_allclose(found.jacobian, 2 * rest, atol=1e-2)


@pytest.mark.parametrize(("size", "left"), [(1e-2, 0.0), (1.0, 2.0), (0.06, 0.12)])
def test_a_sensitivity_that_an_initial_state_takes_up_but_for_rounding_is_none(size, left):
    rng = np.random.default_rng(0)
    start, rest = rng.normal(size=(30, 2)), rng.normal(size=(30, 1))
    rest -= start @ np.linalg.lstsq(start, rest, rcond=None)[0]
    rest *= size / np.sqrt(np.mean(rest**2))
    whole = 100.0 * start[:, :1]
    piece = Linear(rest[:, 0], np.hstack([2 * rest + whole, rest]))
    fit = Fit(np.zeros(2), (np.zeros(2),), 0.0, (piece,), (1e3 * start,), True, 0.0)
    (found,) = projected(fit)
    # The second one is as small, and nothing but what no initial state explains.
    np.testing.assert_allclose(np.sqrt(np.mean(found.jacobian**2, axis=0)), [left, size], rtol=1e-2)


def test_the_step_of_an_initial_state_is_that_of_ridge_regression():
    rng = np.random.default_rng(1)
    a, r, o = rng.normal(size=(20, 2)), 0.1 * rng.normal(size=20), np.array([0.5, -4.0])
    step = start_step(r, a, o, RobustLossCfg().residual_limit, 0.0)
    root = np.sqrt(cauchy_weight(o))
    stacked = np.vstack([a, np.diag(root)])
    expected = -np.linalg.lstsq(stacked, np.concatenate([r, root * o]), rcond=None)[0]
    np.testing.assert_allclose(step, expected, atol=1e-10)


def test_better_initial_states_are_looked_for_in_the_windows_in_question_only():
    solver = solver_for(swung(told=0.006), "joint_damping", length=0.5)
    values, zero = np.array([DAMPING]), [np.zeros(2) for _ in solver.p.windows]
    linear = solver.linearise(values, zero)
    cost = solver.cost([piece.residual for piece in linear], zero, values)
    starts = tuple(np.zeros((w.count, 2)) for w in solver.p.windows)
    fit = Fit(values, tuple(zero), cost, linear, starts, False, 0.0)
    found = solver.improve_initial_states(fit, [], windows=[0])
    assert found.cost < cost
    assert np.abs(found.offsets[0]).max() > 0
    assert np.abs(found.starts[0]).max() > 0
    for w in range(1, len(zero)):
        assert not found.offsets[w].any()
        assert not found.starts[w].any()


def test_a_leap_that_fails_where_it_promises_most_is_not_gone_on_with():
    solver = solver_for(swung(), "joint_damping", length=0.5)
    right = solver.polish(solver.fit())
    assert solver._fit_at(right, right.values + 0.5 * DAMPING, [0], 1.0) is right
    off = solver.improve_initial_states(replace(right, values=np.zeros(1)), [])
    first = solver._promising_windows(off, right.values)
    assert 0 < len(first) < len(solver.p.windows)
    assert solver._fit_at(off, right.values, first, 1.0).cost == pytest.approx(right.cost, rel=0.02)


def bounced_ratio(cfg: LeastSquaresCfg | None = None, *, scatter: bool = False) -> np.ndarray:
    """Return residuals over those of the true initial states, falls told 3 spreads off; shape (falls,).

    Args:
        cfg: Settings.
        scatter: Whether the numerical scatter of predictions counts as noise.
    """
    recording, errors = bounced(12, off=3.0, seed=1)
    windows = windows_of(recording, length=10.0)
    assert all(w.scatter is not None for w in windows)
    if not scatter:
        windows = [replace(w, scatter=None) for w in windows]
    np.testing.assert_allclose(windows[0].spread, SPREAD)
    solver = Solver(Prediction(drawing(recording), (), windows, threads=1), cfg)
    values = np.zeros(0)
    offsets, _ = solver.fit_initial_states(values, [np.zeros(4) for _ in windows])
    found, true, told = (
        np.array([np.sqrt(np.mean(r**2)) for r in solver.p.residuals(solver.trials(values, o))])
        for o in (offsets, errors, [np.zeros(4) for _ in windows])
    )
    assert (told > (10 if scatter else 30) * true).all()
    return found / true


def test_initial_states_far_off_are_found_across_a_bounce():
    assert (bounced_ratio() < 1.2).sum() >= 11


def test_derivatives_alone_do_not_find_all_of_these():
    cfg = LeastSquaresCfg(initial_states=InitialStateCfg(sample_spreads=(), restart_samples=0))
    assert (bounced_ratio(cfg) < 1.2).sum() <= 9


def test_derivatives_alone_find_all_where_the_scatter_over_the_phase_of_the_time_grid_counts_as_noise():
    cfg = LeastSquaresCfg(initial_states=InitialStateCfg(sample_spreads=(), restart_samples=0))
    assert (bounced_ratio(cfg, scatter=True) < 1.1).all()


def test_sensitivities_are_those_of_finite_differences():
    solver = solver_for(swung(), "joint_damping", "armature")
    values = np.array([DAMPING, 1e-4])
    (linear,) = solver.linearise(values, [np.zeros(2)])
    moved = values + np.array([1e-4, 0.0]) * solver.scale
    (first,), (second,) = (solver.p.residuals(solver.trials(v, [np.zeros(2)])) for v in (values, moved))
    slope = (second - first) / 1e-4
    assert np.abs(linear.jacobian[:, 0] - slope).max() < 0.15 * np.abs(slope).max()
    assert NOISE * np.abs(slope).max() > 0
