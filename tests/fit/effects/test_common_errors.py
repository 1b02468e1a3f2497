"""Errors that all samples of a channel have in common, such as a depth camera's offset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.fit.effects.fit import fit_effects
from concent_warp.fit.effects.observation import first_part
from concent_warp.fit.effects.observe import channel_noises, observe
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from tests.fit.effects.test_missing_components import DENSITY, recording
from tests.fit.effects.test_scatter import falling

OWN, COMMON = 1e-3, 1e-2
"""Standard deviations of what samples have for themselves and in common [m]."""


def seen(thrown: Recording, *, common: bool) -> Recording:
    """Return a recording whose positions are off by one offset, stated as part of the covariances or in common."""
    (d,) = thrown.demonstrations
    measured = {}
    for name, channel in d.measured.items():
        count, k = channel.value.shape
        shared = np.tile(COMMON * np.eye(k), (count, 1, 1))
        covariance = OWN**2 * np.eye(k) + shared @ np.swapaxes(shared, 1, 2)
        value = channel.value + np.sqrt(OWN**2 - 2e-4**2) * np.random.default_rng(1).normal(size=(count, k))
        value += COMMON * np.array([1.0, -0.5, 0.7])[:k]
        measured[name] = replace(channel, value=value, covariance=covariance, common=shared if common else None)
        measured[name] = replace(measured[name], noise_std=None)
    return replace(thrown, demonstrations=(replace(d, measured=measured),))


def residual_of(model: Model, windows) -> np.ndarray:
    prediction = Prediction(model, (), windows)
    return np.concatenate(prediction.residuals([SimulationRequest(k, prediction.start) for k in range(len(windows))]))


def test_an_offset_in_common_hides_no_effect_and_is_no_discrepancy():
    found = {}
    for common in (False, True):
        measured = seen(recording(), common=common)
        found[common] = fit_effects(Model.from_recording(measured).add_effect("air_drag"), measured)
    assert found[True].after == pytest.approx(1.0, abs=0.15)
    (low, high), (lower, higher) = (found[k].model.effects[0].intervals[0] for k in (True, False))
    assert low < DENSITY < high
    assert high - low < 0.3 * (higher - lower)


def test_residuals_are_whitened_by_the_covariance_of_all_samples_together():
    measured = seen(recording(), common=True)
    model = Model.from_recording(measured).add_effect("air_drag", values={"density": DENSITY})
    (window,) = observe(model, measured, length=10.0)
    (plain,) = observe(model, seen(recording(), common=False), length=10.0)
    (reading,) = plain.readings
    assert reading.whitening is not None
    off = residual_of(model, [plain]) * reading.std
    off = np.linalg.solve(reading.whitening, off.reshape(-1, 3, 1)).ravel()
    covariance = OWN**2 * np.eye(180) + COMMON**2 * np.tile(np.eye(3), (60, 60))
    expected = np.sqrt(off @ np.linalg.solve(covariance, off))
    assert np.linalg.norm(residual_of(model, [window])) == pytest.approx(expected, rel=1e-6)


def test_a_window_with_numerical_scatter_and_its_first_part_keep_what_is_in_common():
    model, thrown = falling(0.5)
    (window,) = observe(model, seen(thrown, common=True), length=10.0)
    assert window.common is not None
    assert window.scatter is not None
    width = window.common.shape[1]
    np.testing.assert_array_equal(window.scatter.deviations[:, -width:], window.common)
    assert window.scatter.deviations.shape[1] > width
    part = first_part(window, 0.2)
    assert part.common is not None
    assert part.common.shape == (part.count, width)


@pytest.mark.parametrize("common", [False, True])
def test_noise_that_is_raised_raises_that_of_all_samples(common):
    measured = seen(recording(), common=common)
    model = Model.from_recording(measured).add_effect("air_drag", values={"density": DENSITY})
    noise = channel_noises(model, measured)
    usual, raised = (
        residual_of(model, observe(model, measured, length=10.0, noise={c: factor * s for c, s in noise.items()}))
        for factor in (1.0, 4.0)
    )
    np.testing.assert_allclose(raised, usual / 4.0, rtol=1e-3, atol=1e-6)
