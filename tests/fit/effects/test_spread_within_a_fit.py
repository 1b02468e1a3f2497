"""Steps of a fit that better the channel that is farthest off, and raise the spread of all residuals."""

from typing import Any

import numpy as np
import pytest

from concent_warp.fit.effects.least_squares import Solver
from concent_warp.fit.effects.robust import huber_limit
from tests.fit.effects.synthetic import SyntheticPrediction

QUIET = np.linspace(-2.0, 2.0, 120)
"""Residuals of a channel that the parameter does not change, in units of the noise."""


def residuals(value: float) -> np.ndarray:
    """Return residuals of the quiet channel, and of one that is off by 30 x noise in the lesser part of its samples."""
    return np.concatenate([QUIET, np.full(70, -0.2 - 6.0 * value), np.full(60, 30.0 - 6.0 * value)])


def test_a_step_that_lowers_the_errors_is_taken_though_it_raises_their_median():
    prediction: Any = SyntheticPrediction(np.zeros((1, 2)), start=(0.0,), low=(-10.0,), high=(10.0,))
    prediction.observed = lambda _window, _reader, values: residuals(values[0])
    prediction.readers = lambda trials: [None] * len(trials)
    prediction.residuals = lambda trials: [residuals(t.values[0]) for t in trials]
    solver = Solver(prediction)
    starts = (np.zeros((len(residuals(0.0)), 2)),)
    limit, offsets = huber_limit([residuals(0.0)]), [np.zeros(2)]
    assert huber_limit([residuals(0.3)]) > 2 * limit
    cost = solver.cost([residuals(0.0)], offsets, np.zeros(1))
    assert solver.cost([residuals(0.3)], offsets, np.array([0.3])) > 1.5 * cost
    fit = solver.fit(np.zeros(1), offsets, starts, refits=0)
    # There 70 residuals within the first limit pull as much as 60 beyond it.
    assert -0.2 - 6.0 * fit.values[0] == pytest.approx(-60 * limit / 70, rel=0.01)
    # Fits are compared by the limit of their own residuals.
    assert fit.cost == solver.cost([fit.linear[0].residual], fit.offsets, fit.values)
