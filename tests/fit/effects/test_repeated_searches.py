"""Searches for initial states that would only repeat an earlier one are left out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from concent_warp.fit.effects.least_squares import Fit, LeastSquaresCfg, Solver, _State
from tests.fit.effects.synthetic import TRUTH, SyntheticPrediction

WINDOWS = 4


def solver_of(cfg: LeastSquaresCfg | None = None) -> Solver:
    """Return a solver of a problem with jumps, whose true initial states are not the measured ones."""
    prediction: Any = SyntheticPrediction(np.random.default_rng(0).normal(size=(WINDOWS, 2)), impact=0.5)
    return Solver(prediction, cfg)


def fit_at(solver: Solver, values: np.ndarray) -> Fit:
    """Return a fit of the initial states at some parameters."""
    offsets, starts = solver.fit_initial_states(values, [np.zeros(2)] * WINDOWS)
    linear = solver.linearise(values, offsets)
    cost = solver.cost([piece.residual for piece in linear], offsets, values)
    return Fit(values, tuple(offsets), cost, linear, starts, True, 0.0)


@pytest.mark.parametrize(("moved", "again"), [(None, 1), (0.1, 1), (0.0, 0)])
def test_a_polish_searches_from_the_measured_states_unless_one_has_at_the_same_parameters(moved, again):
    solver, begun = solver_of(), []
    start = fit_at(solver, 1.3 * TRUTH)
    start = replace(start, searched=None if moved is None else start.values + moved)
    plain, mocked = solver.improve_initial_states, solver
    patched: Any = mocked

    def improve_initial_states(fit: Fit, others: Any, *given: Any, **named: Any) -> Fit:
        begun.append(len(others))
        return plain(fit, others, *given, **named)

    patched.improve_initial_states = improve_initial_states
    solver.polish(start)
    assert begun[0] == again


@pytest.mark.parametrize(("room", "refitted"), [(0.0, False), (0.5, True)])
def test_where_no_parameter_moves_initial_states_are_not_fitted_anew(room, refitted):
    solver, calls = solver_of(), []
    mocked: Any = solver
    begun = fit_at(solver, 1.3 * TRUTH)
    solver.low, solver.high = begun.values - room, begun.values + room
    mocked.p.residuals = lambda trials: [np.full(25, 1e3) for _ in trials]  # each step raises the cost

    def fit_initial_states(_values: Any, offsets: Any, *_: Any) -> Any:
        calls.append(offsets)
        return list(offsets), begun.starts

    mocked.fit_initial_states = fit_initial_states
    state = _State(begun.values, list(begun.offsets), begun.cost, begun.starts, 2)
    assert solver._advance(state, begun.linear, 1e-3)[0].cost == begun.cost
    assert bool(calls) == refitted


def test_a_polish_tells_where_it_has_searched_from_the_measured_states():
    solver = solver_of(LeastSquaresCfg(polish_steps=0))
    start = fit_at(solver, 1.3 * TRUTH)
    assert not start.is_searched
    found = solver.polish(start)
    assert found.searched is start.values
    assert found.is_searched == np.array_equal(found.values, start.values)
    there = solver_of()._fit_at(start, TRUTH, range(WINDOWS), 0.0)
    assert there.cost < start.cost
    assert there.is_searched
