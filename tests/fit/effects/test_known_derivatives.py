"""Derivatives by the initial states that are known from nearby take the place of finite differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from concent_warp.fit.effects.initial_states import InitialStateCfg
from concent_warp.fit.effects.least_squares import LeastSquaresCfg, Solver
from tests.fit.effects.synthetic import TRUTH, SyntheticPrediction

OFFSETS = np.random.default_rng(0).normal(size=(4, 2))
"""True errors of the initial states."""
MEASURED = [np.zeros(2)] * 4
CONTACTS, FREE = 1e-9, 0.0
"""Jumps of the prediction: so small that the problem is smooth all the same, though the windows are not marked so."""


def solver_of(impact: float, cfg: LeastSquaresCfg | None = None) -> Solver:
    """Return a solver of a problem with little noise."""
    prediction: Any = SyntheticPrediction(OFFSETS, noise=0.01, impact=impact)
    return Solver(prediction, cfg)


@pytest.fixture(scope="module")
def nearby() -> dict[int, np.ndarray]:
    """Return the derivatives at other parameters and other initial states."""
    _, starts, _ = solver_of(CONTACTS).search.refined(1.1 * TRUTH, list(OFFSETS + 0.3), range(4), 1)
    return starts


def refined(known: dict[int, np.ndarray], *, impact: float = CONTACTS) -> tuple[int, Any, Any]:
    """Return how many simulations a search from the measured states takes, the states and their derivatives."""
    solver = solver_of(impact)
    found, starts, residuals = solver.search.refined(TRUTH, MEASURED, range(4), 12, known=known)
    again = solver.p.residuals(solver.trials(TRUTH, found))
    np.testing.assert_array_equal(np.concatenate(residuals), np.concatenate(again))
    prediction: Any = solver.p
    return len(prediction.requests) - 4, found, starts


def test_with_derivatives_from_nearby_the_same_states_are_found_by_fewer_simulations(nearby):
    many, expected, fresh = refined({})
    few, found, starts = refined(nearby)
    assert few < 0.4 * many
    np.testing.assert_allclose(found, expected, atol=0.005)
    np.testing.assert_allclose(found, OFFSETS, atol=0.01)
    assert all(starts[w] is nearby[w] for w in range(4))
    assert not any(fresh[w] is nearby[w] for w in range(4))


def test_a_window_without_known_derivatives_is_searched_as_ever(nearby):
    many, expected, _ = refined({})
    some, found, starts = refined({w: nearby[w] for w in (0, 2)})
    assert refined(nearby)[0] < some < many
    np.testing.assert_allclose(found, expected, atol=0.005)
    assert [starts[w] is nearby[w] for w in range(4)] == [True, False, True, False]


def test_derivatives_that_mislead_are_computed_anew(nearby):
    _, expected, fresh = refined({})
    _, found, starts = refined({w: -a for w, a in nearby.items()})
    np.testing.assert_array_equal(found, expected)
    for w in range(4):
        np.testing.assert_array_equal(starts[w], fresh[w])


def test_states_that_are_found_already_take_no_simulation_but_that_of_each_window(nearby):
    _, found, _ = refined(nearby)
    solver = solver_of(CONTACTS)
    again, starts, _ = solver.search.refined(TRUTH, found, range(4), 12, known=nearby)
    prediction: Any = solver.p
    assert len(prediction.requests) == 4
    np.testing.assert_array_equal(again, found)
    assert all(starts[w] is nearby[w] for w in range(4))


def test_a_step_that_falls_short_of_its_prediction_ends_the_use_of_known_derivatives(nearby):
    # Derivatives twice too small lead twice too far, where the cost is no lower; a tenth off, they are kept.
    for factor, kept in ((0.45, False), (1.1, True)):
        _, found, starts = refined({w: factor * a for w, a in nearby.items()})
        np.testing.assert_allclose(found, OFFSETS, atol=0.02)
        assert all(np.array_equal(starts[w], factor * nearby[w]) == kept for w in range(4))


def test_only_windows_with_contacts_are_fitted_with_derivatives_of_the_fit(nearby):
    known = tuple(nearby[w] for w in range(4))
    for impact, fewer in ((CONTACTS, True), (FREE, False)):
        counts = []
        for given in ((), known):
            solver = solver_of(impact)
            found, starts = solver.fit_initial_states(TRUTH, MEASURED, known=given)
            prediction: Any = solver.p
            counts.append(len(prediction.requests))
            np.testing.assert_allclose(found, OFFSETS, atol=0.01)
            assert all((a is b) == (fewer and bool(given)) for a, b in zip(starts, known, strict=True))
        assert (counts[1] < 0.4 * counts[0]) if fewer else (counts[1] == counts[0])


def test_a_fit_is_improved_with_its_own_derivatives_where_that_is_asked_for():
    solver = solver_of(CONTACTS)
    fit = solver.fit()
    asked: list[Any] = []
    search = solver.search.refined

    def noted(values: Any, offsets: Any, windows: Any, iterations: int, bounds: Any = None, known: Any = None) -> Any:
        asked.append((list(windows), iterations, dict(known or {})))
        return search(values, offsets, windows, iterations, bounds, known)

    mocked: Any = solver.search
    mocked.refined = noted
    solver.improve_initial_states(fit, [])
    solver.improve_initial_states(fit, [], fresh=False)
    assert [a[:2] for a in asked] == [(list(range(4)), 1), (list(range(4)), solver.cfg.refit_iterations)]
    assert asked[0][2] == {}
    assert all(asked[1][2][w] is a for w, a in enumerate(fit.starts))


def test_other_states_are_not_tried_where_they_are_those_of_the_fit():
    cfg = LeastSquaresCfg(initial_states=InitialStateCfg(iterations=3))
    solver = solver_of(CONTACTS, cfg)
    fit = solver.fit()
    asked: list[Any] = []
    search = solver.search.refined

    def noted(values: Any, offsets: Any, windows: Any, *more: Any, **named: Any) -> Any:
        asked.append(list(windows))
        return search(values, offsets, windows, *more, **named)

    mocked: Any = solver.search
    mocked.refined = noted
    near = [o + 0.9 * cfg.same_state * np.array([1.0, -1.0]) for o in fit.offsets]
    far = [o + (1.5 if w in (1, 3) else 0.5) * cfg.same_state for w, o in enumerate(fit.offsets)]
    # None counts as found; after the search about the fit's own states these are a little off it.
    solver.improve_initial_states(fit, [near, far], noise=0.0)
    assert asked == [[0, 1, 2, 3], [1, 3]]
