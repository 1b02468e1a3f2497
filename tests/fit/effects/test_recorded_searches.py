"""Searches on synthetic residuals take the same path as was written down: values, costs, and number of simulations.

The rules of a search (which steps are tried, when it gives up) show in its path. Where a rule is changed on purpose,
``python -m tests.fit.effects.test_recorded_searches`` writes the paths anew.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from concent_warp.fit.effects.initial_states import InitialStateCfg, InitialStateSearch
from concent_warp.fit.effects.least_squares import Fit, LeastSquaresCfg, Solver
from tests.fit.effects.synthetic import TRUTH, SyntheticPrediction

WRITTEN = Path(__file__).with_name("recorded_searches.json")
Search = Callable[[], dict[str, Any]]


def given(windows: int, seed: int = 0, **options: Any) -> Any:
    """Return a prediction whose initial states are off by about one spread."""
    return SyntheticPrediction(np.random.default_rng(seed).normal(size=(windows, 2)), **options)


def begun(solver: Solver, values: np.ndarray) -> Fit:
    """Return a fit at some values, with the initial states as they were measured."""
    offsets = [np.zeros(2) for _ in solver.p.windows]
    offsets, starts = solver.fit_initial_states(values, offsets, iterations=1)
    linear = solver.linearise(values, offsets)
    cost = solver.cost([piece.residual for piece in linear], offsets, values)
    return Fit(values, tuple(offsets), cost, linear, starts, False, 0.0)


def told(fit: Fit, solver: Solver) -> dict[str, Any]:
    """Return what is written down of a fit."""
    prediction: Any = solver.p
    return {
        "values": fit.values.tolist(),
        "cost": fit.cost,
        "offsets": np.concatenate(fit.offsets).tolist(),
        "starts": [float(np.abs(a).sum()) for a in fit.starts],
        "linear": [float(np.abs(piece.jacobian).sum()) for piece in fit.linear],
        "converged": fit.converged,
        "simulations": len(prediction.requests),
        "steps": solver.step.tolist(),
    }


def fit(windows: int, cfg: LeastSquaresCfg | None = None, **options: Any) -> Search:
    def search() -> dict[str, Any]:
        solver = Solver(given(windows, **options), cfg)
        return told(solver.fit(), solver)

    return search


def polish(
    windows: int,
    off: float,
    cfg: LeastSquaresCfg | None = None,
    *,
    thorough: bool = False,
    stuck: bool = False,
    **options: Any,
) -> Search:
    def search() -> dict[str, Any]:
        solver = Solver(given(windows, **options), cfg)
        start = begun(solver, solver.inside(TRUTH[: len(solver.low)] + off))
        return told(solver.polish(start, thorough=thorough, stuck=stuck), solver)

    return search


def at_states_of(off: float, true: bool) -> Search:
    def search() -> dict[str, Any]:
        solver = Solver(given(4))
        good = solver.fit()
        stuck = begun(solver, TRUTH + off)
        good = good if true else replace(good, offsets=tuple(o + 0.5 for o in good.offsets))
        return told(solver.fit_at_states_of(good, stuck), solver)

    return search


def parts(off: float) -> Search:
    """Steps of a polish one by one."""

    def search() -> dict[str, Any]:
        solver = Solver(given(6, outlier=25.0))
        start = begun(solver, TRUTH + off)
        values = TRUTH + 0.2 * off
        first = solver._promising_windows(start, values)
        there = solver._fit_at(start, values, first, 1.0)
        back = solver._fit_at(there, start.values, first, 1.0)
        moved = np.array([0.5, -0.2, 0.1])
        return told(there, solver) | {
            "first": first,
            "back": back is there,
            "first order": np.concatenate(solver.first_order_offsets(start, moved)).tolist(),
            "improved": solver.improve_initial_states(start, [[np.full(2, 1.5)] * 6], 1.0, [1, 4]).cost,
        }

    return search


def initial_states(
    windows: int,
    cfg: InitialStateCfg | None = None,
    *,
    iterations: int = 12,
    bounds: dict[int, float] | None = None,
    only: list[int] | None = None,
    **options: Any,
) -> Search:
    def search() -> dict[str, Any]:
        prediction = given(windows, **options)
        found = InitialStateSearch(prediction, cfg)
        offsets, starts, residuals = found.refined(
            TRUTH, [np.zeros(2)] * windows, only or range(windows), iterations, bounds
        )
        return {
            "offsets": np.concatenate(offsets).tolist(),
            "starts": {str(w): float(np.abs(a).sum()) for w, a in starts.items()},
            "residuals": [float(np.abs(r).sum()) for r in residuals],
            "simulations": len(prediction.requests),
            "steps": np.concatenate(found.steps).tolist(),
        }

    return search


SEARCHES: dict[str, Search] = {
    "fit": fit(3),
    "fit with outliers": fit(3, outlier=40.0, seed=1),
    "fit to a bound": fit(3, low=(0.5, 0.0, -1.0), high=(5.0, 1.45, 1.0), start=(0.6, 1.3, 0.0)),
    "fit from infinity": fit(3, start=(np.inf, 1.3, 0.0)),
    "fit of nothing": fit(3, start=()),
    "fit across impacts": fit(4, impact=60.0, seed=2),
    "fit across impacts without refits": fit(4, LeastSquaresCfg(refits=0), impact=60.0, seed=2),
    "fit from far": fit(3, start=(3.0, 0.3, 0.9), seed=3),
    "fit of few steps": fit(3, LeastSquaresCfg(iterations=2, refits=1), start=(3.0, 0.3, 0.9), seed=3),
    "polish": polish(4, 0.3),
    "polish of outliers": polish(4, 0.3, outlier=40.0),
    "polish of what is stuck": polish(4, 0.3, stuck=True),
    "polish in the noise": polish(4, 0.002),
    "thorough polish": polish(4, 0.002, thorough=True),
    "thorough polish from far": polish(4, 0.4, thorough=True, stuck=True, seed=5),
    "polish across impacts": polish(5, 0.3, impact=60.0, seed=6),
    "polish of two steps": polish(4, 0.5, LeastSquaresCfg(polish_steps=2), stuck=True),
    "polish of nothing": polish(4, 0.0, start=()),
    "polish by a sample": polish(20, 0.2, count=12),
    "polish by a sample in the noise": polish(20, 0.0, count=12, stuck=True),
    "thorough polish by a sample": polish(20, 0.01, count=12, thorough=True, stuck=True),
    "polish by another sample": polish(9, 0.3, LeastSquaresCfg(max_polished_windows=8, polish_sample=3), count=12),
    "parts of a polish": parts(0.2),
    "at the states of another fit": at_states_of(0.3, true=True),
    "at the wrong states of another fit": at_states_of(0.3, true=False),
    "initial states": initial_states(5),
    "initial states of some": initial_states(5, only=[1, 3]),
    "initial states once": initial_states(5, iterations=1),
    "initial states with outliers": initial_states(4, outlier=50.0, seed=7),
    "initial states across impacts": initial_states(6, impact=80.0, seed=8),
    "initial states far off": initial_states(6, impact=80.0, seed=9, count=10),
    "without restarts": initial_states(6, InitialStateCfg(restart_samples=0), impact=80.0, seed=8),
    "without samples": initial_states(6, InitialStateCfg(sample_spreads=(), restart_samples=0), impact=80.0, seed=8),
    "below a bound": initial_states(4, bounds={0: 1.0, 1: 12.0, 2: 1e3}),
    "below a bound across impacts": initial_states(6, impact=80.0, seed=8, bounds={0: 5.0, 1: 5.0, 3: 1e5}),
}


def same(found: Any, written: Any) -> bool:
    """Return whether two results agree but for rounding."""
    if isinstance(found, dict):
        return set(found) == set(written) and all(same(found[key], written[key]) for key in found)
    if isinstance(found, bool | str | int) or found is None:
        return found == written
    return np.shape(found) == np.shape(written) and np.allclose(found, written, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_takes_the_path_that_is_written_down(name):
    assert same(SEARCHES[name](), json.loads(WRITTEN.read_text())[name])


if __name__ == "__main__":
    WRITTEN.write_text(json.dumps({name: search() for name, search in SEARCHES.items()}, indent=1) + "\n")
