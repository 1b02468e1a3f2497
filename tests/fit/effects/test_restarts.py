"""Restarts of a window from random initial states: none where its cost hardly depends on the initial state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from concent_warp.fit.effects.initial_states import InitialStateCfg, InitialStateSearch
from tests.fit.effects.synthetic import TRUTH, SyntheticPrediction

OFFSETS = np.random.default_rng(2).normal(size=(2, 2))
CFG = InitialStateCfg(sample_spreads=(), restart_samples=48)


def lacking(missing: float) -> tuple[Any, InitialStateSearch]:
    """Return a prediction with contacts whose first window lacks an effect of a size in units of noise, its search."""
    prediction: Any = SyntheticPrediction(OFFSETS, impact=1e-9)
    clock = prediction.windows[0].clock
    prediction.windows[0].measured[:] += 0.01 * missing * np.sin(40 * clock)
    return prediction, InitialStateSearch(prediction, CFG)


def samples_of(search: InitialStateSearch, monkeypatch: pytest.MonkeyPatch) -> list[dict[int, int]]:
    """Return a list to which a search adds how many states of each window it samples at a time."""
    counts: list[dict[int, int]] = []
    sample = search._residuals_of

    def counted(samples: Mapping[int, np.ndarray], values: np.ndarray) -> dict[int, list[np.ndarray]]:
        counts.append({w: len(of) for w, of in samples.items()})
        return sample(samples, values)

    monkeypatch.setattr(search, "_residuals_of", counted)
    return counts


@pytest.mark.parametrize(("missing", "restarted"), [(3000.0, False), (6.0, True)])
def test_a_window_is_restarted_only_where_its_state_matters_beside_what_it_lacks(monkeypatch, missing, restarted):
    _, search = lacking(missing)
    counts = samples_of(search, monkeypatch)
    found, _, residuals = search.refined(TRUTH, [np.zeros(2)] * 2, range(2), CFG.iterations)
    assert np.sqrt(np.mean(residuals[0] ** 2)) > CFG.restart_ratio
    assert counts == [{0: CFG.restart_trials}, {0: CFG.restart_samples - CFG.restart_trials} if restarted else {}]
    np.testing.assert_allclose(found[1], OFFSETS[1], atol=0.5)


def test_samples_that_differ_in_their_cost_restart_a_window_that_is_stuck():
    prediction, search = lacking(0.0)
    stuck = [OFFSETS[0] + [14.0, -30.0], OFFSETS[1]]
    residuals = prediction.residuals(search.trials(TRUTH, stuck))
    begin, there, chosen = search._restarts(TRUTH, stuck, residuals, [0], np.inf, np.random.default_rng(0))
    assert chosen == [0]
    np.testing.assert_array_equal(begin[1], stuck[1])
    assert np.mean(there[0] ** 2) < 0.1 * np.mean(residuals[0] ** 2)


def test_fewer_samples_than_trials_are_all_tried():
    prediction: Any = SyntheticPrediction(OFFSETS, impact=1e-9)
    search = InitialStateSearch(prediction, InitialStateCfg(restart_samples=3))
    stuck = [OFFSETS[0] + [14.0, -30.0], OFFSETS[1]]
    residuals = prediction.residuals(search.trials(TRUTH, stuck))
    begun = len(prediction.requests)
    begin, there, chosen = search._restarts(TRUTH, stuck, residuals, [0], np.inf, np.random.default_rng(0))
    assert chosen == [0]
    assert len(prediction.requests) - begun == 3
    np.testing.assert_array_equal(there[0], prediction.residuals(search.trials(TRUTH, begin))[0])
