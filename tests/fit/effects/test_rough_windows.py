"""What derivatives by an initial state foretell counts only where a step of it attains that."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.fit.effects.initial_states import start_step
from concent_warp.fit.effects.least_squares import Fit, LeastSquaresCfg, Linear, projected
from concent_warp.fit.effects.rough_windows import with_rough_windows

ROWS = 60
RNG = np.random.default_rng(3)
STARTS = [RNG.normal(size=(ROWS, 2)) for _ in range(3)]
SPREAD = np.array([0.1, 2.0])
OFF = np.array([-4.0, 5.0])


def made(attained: list[float]) -> tuple[Any, Fit]:
    """Return a solver and a fit whose windows' initial states are off; steps attain a share of what is foretold."""
    rng = np.random.default_rng(5)
    residuals = [a @ OFF + rng.normal(size=ROWS) for a in STARTS]
    linear = tuple(Linear(r, rng.normal(size=(ROWS, 1))) for r in residuals)
    fit = Fit(np.zeros(1), (np.zeros(2),) * 3, 1.0, linear, tuple(STARTS), converged=True, simulated=0.0)

    def simulated(trials: list[Any]) -> list[np.ndarray]:
        asked.extend(t.window for t in trials)
        return [residuals[t.window] + attained[t.window] * STARTS[t.window] @ (t.offset / SPREAD) for t in trials]

    asked: list[int] = []
    windows = [SimpleNamespace(smooth=False, spread=SPREAD)] * 2 + [SimpleNamespace(smooth=True, spread=SPREAD)]
    p = SimpleNamespace(windows=windows, residuals=simulated)
    return SimpleNamespace(p=p, cfg=LeastSquaresCfg(), asked=asked), fit


def test_a_window_is_rough_where_no_step_attains_what_is_foretold() -> None:
    solver, fit = made([1.0, 0.0, 0.0])
    found = with_rough_windows(solver, fit)
    assert found.rough == (1,)
    assert set(solver.asked) == {0, 1}  # nothing touches anything in the last one
    assert with_rough_windows(made([0.5] * 3)[0], replace(fit, rough=(0, 2))).rough == ()


def test_a_window_that_is_as_foretold_for_a_short_step_alone_is_not_rough() -> None:
    solver, fit = made([1.0, 1.0, 1.0])
    full = start_step(fit.linear[0].residual, STARTS[0], fit.offsets[0], np.inf, 0.0) * SPREAD
    simulated = solver.p.residuals

    def only_near(trials: list[Any]) -> list[np.ndarray]:
        near = [np.linalg.norm(t.offset / SPREAD) < 0.2 * np.linalg.norm(full / SPREAD) for t in trials]
        return [r if ok else fit.linear[0].residual for r, ok in zip(simulated(trials), near, strict=True)]

    solver.p.residuals = only_near
    assert with_rough_windows(solver, fit).rough == ()


def test_residuals_of_rough_windows_are_as_they_are() -> None:
    _, fit = made([1.0] * 3)
    smooth, rough = projected(fit), projected(replace(fit, rough=(1,)))
    for w in range(3):
        np.testing.assert_array_equal(smooth[w].jacobian, rough[w].jacobian)
        expected = fit.linear[w].residual if w == 1 else smooth[w].residual
        np.testing.assert_array_equal(rough[w].residual, expected)
        step = start_step(fit.linear[w].residual, STARTS[w], fit.offsets[w], np.inf, 0.0)
        assert step == pytest.approx(-OFF, abs=0.5)
        assert smooth[w].residual == pytest.approx(fit.linear[w].residual + STARTS[w] @ step)


def test_what_is_left_of_noise_is_not_doubted() -> None:
    solver, fit = made([0.0] * 3)
    quiet = tuple(replace(piece, residual=0.1 * piece.residual) for piece in fit.linear)
    assert with_rough_windows(solver, replace(fit, linear=quiet)).rough == ()
    assert not solver.asked
