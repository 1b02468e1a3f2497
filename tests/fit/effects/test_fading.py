import numpy as np
import pytest

from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.fading import FadingCfg, ReferenceSimulation, _has_faded, is_long, residuals_near
from concent_warp.fit.effects.initial_states import InitialStateCfg, InitialStateSearch
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import swing_scene, swung, windows_of

AFTER, FADED = FadingCfg.time, FadingCfg.max_share
STRONG = 0.1
"""Damping at which a swing is over within a moment [N m s/rad]."""
WEAK = 0.002
"""Damping at which it goes on [N m s/rad]."""


@pytest.fixture(scope="module")
def windows():
    return windows_of(swung(seconds=4.0))


def prediction_of(windows, damping):
    return Prediction(Model(Scene(swing_scene(damping))), (), windows)


def near(prediction, *, hoped=True):
    """Return residuals from a slightly different start, and whether the difference has faded."""
    none, offset = np.zeros(0), 0.3 * prediction.windows[0].spread
    (residual,) = prediction.residuals([SimulationRequest(0, none)])
    found, faded = residuals_near(
        prediction,
        {0: ReferenceSimulation(SimulationRequest(0, none), residual)},
        [SimulationRequest(0, none, offset)],
        [hoped],
    )
    return found[0], faded[0], residual, SimulationRequest(0, none, offset)


def test_where_an_error_of_the_start_fades_only_a_moment_is_simulated(windows):
    prediction = prediction_of(windows, STRONG)
    found, faded, plain, trial = near(prediction)
    assert faded
    assert prediction.simulated == pytest.approx(windows[0].end - windows[0].start + 2 * AFTER, abs=0.05)
    (whole,) = prediction.residuals([trial])
    np.testing.assert_allclose(found, whole, atol=5 * FADED)
    assert np.abs(whole - plain).max() > 0.5
    late = windows[0].clock > AFTER
    np.testing.assert_array_equal(found[late], plain[late])


def test_where_it_does_not_all_is_simulated(windows):
    prediction = prediction_of(windows, WEAK)
    found, faded, _, trial = near(prediction)
    assert not faded
    np.testing.assert_array_equal(found, prediction.residuals([trial])[0])


def test_what_may_not_fade_is_not_tested(windows):
    prediction = prediction_of(windows, STRONG)
    _, faded, _, _ = near(prediction, hoped=False)
    assert not faded
    assert prediction.simulated == pytest.approx(2 * (windows[0].end - windows[0].start), abs=0.05)


def test_a_simulation_that_diverged_has_not_faded(windows):
    prediction = prediction_of(windows, STRONG)
    (course,) = prediction.courses([SimulationRequest(0, np.zeros(0))], AFTER)
    course.qvel[-1] = np.nan
    trial = SimulationRequest(0, np.zeros(0), windows[0].spread)
    assert not _has_faded(prediction, trial, SimulationRequest(0, np.zeros(0)), course, course)


def test_short_windows_are_simulated_to_their_end():
    short = windows_of(swung(seconds=4.0), 0.5)
    prediction = prediction_of(short, STRONG)
    assert not any(is_long(prediction, w) for w in range(len(short)))


def test_initial_states_are_found_as_without_it(windows):
    found = []
    for min_window in (FadingCfg.min_window, np.inf):
        cfg = InitialStateCfg(fading=FadingCfg(min_window=min_window))
        prediction = Prediction(Model(Scene(swing_scene(STRONG))), (effect_class("armature")("hinge"),), windows)
        offsets, starts, _ = InitialStateSearch(prediction, cfg).refined(np.array([1e-5]), [np.ones(2)], [0], 4)
        found.append((offsets[0], starts[0], prediction.simulated))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=2e-2)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=0.05)
    assert found[0][2] < 0.6 * found[1][2]
