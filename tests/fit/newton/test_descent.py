"""The descent on a loss that is written down, without a simulation; and stretches cut to its horizon."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from concent_warp.errors import ModelError
from concent_warp.estimation.object_tracks import whole_demonstration
from concent_warp.fit.newton.descent import (
    Descent,
    GradientCfg,
    Metric,
    chosen_iterates,
    descend,
    descent_identity,
    start_descent,
)
from concent_warp.fit.newton.horizon import _tilt, shortened
from tests.fit.conftest import HALF, corner_spheres

GEOMETRY = corner_spheres(HALF)
EVERY = np.ones(len(GEOMETRY), dtype=bool)
GOAL = np.tile([1e-3, 0.0, -2e-3], (len(GEOMETRY), 1))
CFG = GradientCfg(iterations=30, prior=0.0, plateau_iterations=30)


def metric(swelling=0.0) -> Metric:
    growth = np.sign(GEOMETRY.position)
    return Metric(GEOMETRY, EVERY, growth, 1e-4, swelling, 1e-4)


def quadratic(parameters) -> Any:
    """Return the distance to the goal, summed in squares, and its gradient."""
    away = parameters.position - GEOMETRY.position - GOAL
    return SimpleNamespace(loss=(away**2).sum(axis=(1, 2)), by={"position": 2 * away})


QUADRATIC: Any = quadratic


def run(state, loss: Any = quadratic, cfg=CFG) -> Descent:
    while not state.finished:
        descend(state, loss, GEOMETRY.position, metric(), cfg, lambda values: values)
    return state


def started(count=1) -> Descent:
    return start_descent(np.zeros((count, *GEOMETRY.position.shape)), 1e-3)


def test_a_descent_finds_the_minimum_of_a_smooth_loss():
    state = run(started(2))
    np.testing.assert_allclose(state.best, np.stack([GOAL, GOAL]), atol=5e-5)
    assert len(state.losses) == len(state.lows) <= CFG.iterations
    assert state.lows == sorted(state.lows, reverse=True)


def test_steps_grow_while_the_loss_falls_and_are_halved_where_it_does_not():
    state = started()
    descend(state, QUADRATIC, GEOMETRY.position, metric(), CFG, lambda values: values)
    assert state.step[0] == pytest.approx(1e-3)
    assert np.linalg.norm(state.now[0], axis=1).max() == pytest.approx(1e-3)
    descend(state, QUADRATIC, GEOMETRY.position, metric(), CFG, lambda values: values)
    assert state.step[0] == pytest.approx(1.2e-3)
    best = state.best.copy()
    state.now = state.best + 1.0
    descend(state, QUADRATIC, GEOMETRY.position, metric(), CFG, lambda values: values)
    assert state.step[0] == pytest.approx(0.6e-3)
    np.testing.assert_array_equal(state.best, best)


def test_a_loss_that_is_not_finite_counts_as_no_progress():
    def broken(parameters) -> Any:
        found = quadratic(parameters)
        found.loss[0] = np.nan
        return found

    state = started(2)
    descend(state, cast(Any, broken), GEOMETRY.position, metric(), CFG, lambda values: values)
    assert state.losses == [[np.inf, pytest.approx((GOAL**2).sum())]]
    assert state.kept_start == [1]
    assert np.isinf(state.lowest[0])
    assert np.isfinite(state.now).all()


def test_the_descent_ends_where_nothing_gets_better_by_three_percent_in_some_steps():
    def level(slope):
        values = iter(1.0 - slope * np.arange(100))
        return lambda p: SimpleNamespace(loss=np.full(1, next(values)), by={"position": np.ones_like(p.position)})

    cfg = replace(CFG, iterations=20, plateau_iterations=4)
    assert len(run(started(), level(0.001), cfg).losses) == 5
    assert len(run(started(), level(0.02), cfg).losses) == 20


def test_the_prior_holds_back_what_moves():
    held = run(started(), cfg=replace(CFG, prior=len(GEOMETRY) * 1.0))
    np.testing.assert_allclose(held.best[0], GOAL / 2, atol=5e-5)


def test_a_direction_leads_downhill_with_a_longest_row_of_one_and_none_for_nan():
    gradient = np.zeros((2, *GEOMETRY.position.shape))
    gradient[0, 3] = [0.0, 4.0, 0.0]
    gradient[1, 2] = np.nan
    found = metric().direction(gradient)
    expected = np.zeros_like(GEOMETRY.position)
    expected[3] = [0.0, -1.0, 0.0]
    np.testing.assert_allclose(found[0], expected, atol=1e-9)
    np.testing.assert_array_equal(found[1], 0.0)
    swollen = metric(swelling=2.0).direction(gradient[:1])[0, 3]
    sign = np.sign(GEOMETRY.position[3])
    wanted = -np.array([0.0, 4.0, 0.0]) - 4.0 * 4.0 * sign[1] * sign
    np.testing.assert_allclose(swollen, wanted / np.linalg.norm(wanted), atol=1e-9)


def test_iterates_to_score_again_are_the_last_and_some_before_it():
    state = started(2)
    state.kept = [np.full_like(GEOMETRY.position, k) for k in range(7)]
    state.kept_start = [0, 1, 0, 0, 0, 0, 1]
    assert chosen_iterates(state, 2)[:, 0, 0].tolist() == [2, 5, 1, 6]
    assert chosen_iterates(state, 9)[:, 0, 0].tolist() == [2, 3, 4, 5, 1, 6]
    assert len(chosen_iterates(started(), 3)) == 0


def test_a_saved_state_is_read_for_the_same_descent_alone(tmp_path):
    state, path = run(started(2)), tmp_path / "descent.npz"
    mine = descent_identity(CFG, 0, GEOMETRY.position, ["a"])
    state.save(path, mine)
    again = Descent.load(path, mine)
    for name in ("now", "best", "direction", "lowest", "step", "kept"):
        np.testing.assert_array_equal(getattr(again, name), getattr(state, name))
    for name in ("kept_start", "lows", "losses", "finished"):
        assert getattr(again, name) == getattr(state, name)
    for other in (
        descent_identity(CFG, 1, GEOMETRY.position, ["a"]),
        descent_identity(CFG, 0, GEOMETRY.position + 1e-9, ["a"]),
        descent_identity(CFG, 0, GEOMETRY.position, ["b"]),
        descent_identity(replace(CFG, starts=3), 0, GEOMETRY.position, ["a"]),
    ):
        with pytest.raises(ModelError, match="other settings"):
            Descent.load(path, other)
    with pytest.raises(ModelError, match="not a state"):
        Descent.load(tmp_path / "missing.npz", mine)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ModelError, match="not a state"):
        Descent.load(path, mine)


def test_a_shortened_stretch_is_its_beginning(drop, swollen):
    segment = whole_demonstration(swollen.scene, drop[0], ("block",))
    short = shortened(swollen.scene.model, segment, 0.2)
    (target,), (before,) = short.targets, segment.targets
    assert len(short.ctrl) == 50
    inside = before.time <= 0.2
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(target.time, before.time[inside])
    np.testing.assert_array_equal(target.points, before.points[inside])


def test_the_tilt_is_the_largest_change_of_the_angle_to_the_vertical(drop, swollen):
    (target,) = whole_demonstration(swollen.scene, drop[0], ("block",)).targets
    assert _tilt(target) == pytest.approx(0.0, abs=1e-6)
    turned = target.points.copy()
    angle = 0.4
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned[10] = turned[10] @ rotation.T
    assert _tilt(replace(target, points=turned)) == pytest.approx(angle, abs=1e-5)
    assert _tilt(replace(target, points=np.full_like(turned, np.nan))) == 0.0
