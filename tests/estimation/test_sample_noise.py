from dataclasses import replace

import numpy as np
import pytest

from concent_warp.comparison.compare import compare
from concent_warp.estimation.noise import channel_noise
from concent_warp.estimation.sample_noise import MIN_STD_SHARE, covariance_std, relative_whitening, whitened
from concent_warp.fit.effects.fit import fit_effects
from concent_warp.recording.recording import Channel
from tests.fit.effects.test_fit_effects import model_with
from tests.scenes.swinging import DAMPING, NOISE, drawing, swung

POOR = 300.0
"""Noise of every second stretch over that of the others."""


def seen_by_turns(seed: int = 0, *, covariance: bool = True):
    """Return a swing of which every second stretch of 0.2 s is measured far less exactly."""
    recording = swung(seed=seed)
    (d,) = recording.demonstrations
    angle = d.measured["angle"]
    poor = (angle.time // 0.2).astype(int) % 2 == 1
    std = np.where(poor, POOR * NOISE, NOISE)
    more = np.random.default_rng(seed + 100).normal(0, np.sqrt(std**2 - NOISE**2))
    pooled = float(np.sqrt(np.mean(std**2)))
    own = (std**2)[:, None, None] if covariance else None
    channel = Channel(angle.time, angle.value + more[:, None], pooled, None, own)
    return replace(recording, demonstrations=(replace(d, measured={"angle": channel}),))


def random_covariances(count: int, rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(count, 3, 3)) * rng.uniform(0.5, 2.0, (count, 1, 1))
    return root @ np.swapaxes(root, 1, 2)


def test_whitened_noise_has_the_channels_standard_deviation_in_every_direction():
    rng = np.random.default_rng(0)
    covariance = random_covariances(4000, rng)
    noise = np.einsum("tij,tj->ti", np.linalg.cholesky(covariance), rng.normal(size=(4000, 3)))
    channel = Channel(np.arange(4000.0), noise, None, None, covariance)
    std = covariance_std(channel)
    assert std == pytest.approx(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 3))
    matrices = relative_whitening(channel)
    assert matrices is not None
    assert std is not None
    found = np.cov(whitened(noise, matrices).T)
    np.testing.assert_allclose(np.diag(found), std**2, rtol=0.15)  # less along axes that are at the floor
    np.testing.assert_allclose(found - np.diag(np.diag(found)), 0, atol=0.1 * std**2)


def test_a_sample_that_claims_to_be_exact_counts_no_more_than_the_floor_lets_it():
    covariance = np.stack([np.zeros((3, 3)), *[np.eye(3)] * 9])
    channel = Channel(np.arange(10.0), np.zeros((10, 3)), None, None, covariance)
    matrices = relative_whitening(channel)
    assert matrices is not None
    np.testing.assert_allclose(matrices[0], np.eye(3) * covariance_std(channel) / MIN_STD_SHARE)


def test_missing_samples_and_components_stay_as_they_are():
    covariance = np.stack([4 * np.eye(2), np.full((2, 2), np.nan)])
    value = np.array([[1.0, np.nan], [np.nan, np.nan]])
    matrices = relative_whitening(Channel(np.arange(2.0), value, None, None, covariance))
    np.testing.assert_array_equal(whitened(value, matrices), value)


def test_a_channel_without_stated_noise_takes_it_from_its_covariances():
    channel = Channel(np.arange(50.0), np.zeros((50, 2)), None, None, np.repeat(9 * np.eye(2)[None], 50, axis=0))
    noise = channel_noise(channel, "position")
    assert (noise.std, noise.source) == (pytest.approx(3.0), "stated")


def test_what_is_measured_exactly_decides_a_fit_where_covariances_say_so():
    found = {}
    for covariance in (False, True):
        recording = seen_by_turns(covariance=covariance)
        ((found[covariance],),) = fit_effects(model_with(recording, "joint_damping"), recording).parameters
    assert found[True].low < DAMPING < found[True].high
    assert found[True].high - found[True].low < 0.6 * (found[False].high - found[False].low)
    assert abs(found[True].value - DAMPING) < 0.3 * abs(found[False].value - DAMPING)


def test_compare_and_fit_measure_an_error_by_the_noise_of_its_own_samples():
    recording = seen_by_turns()
    before = drawing(recording)
    fitted = fit_effects(model_with(recording, "joint_damping"), recording)
    assert fitted.after == pytest.approx(1.0, abs=0.1)
    result = compare({"before": before, "after": fitted.model}, recording)
    ratios = [result.summarise(model, "angle").ratio for model in ("before", "after")]
    assert ratios[1] == pytest.approx(1.0, abs=0.1)
    assert ratios[0] == pytest.approx(fitted.before, rel=0.1)
    # By one standard deviation for all, the poor half would hide most of the error.
    alone = seen_by_turns(covariance=False)
    assert compare({"before": before}, alone).summarise("before", "angle").ratio < 0.5 * ratios[0]
