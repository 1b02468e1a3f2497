"""Numerical scatter: whitening, and what the phase of the time grid changes in the motion of a bouncing ball."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from concent_warp.fit.effects.observation import NumericalScatter, Window, first_part
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.fit.effects.scatter import with_scatter
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

STEP, NOISE, PERIOD = 0.002, 2e-4, 0.005
HEIGHT, FALL = 0.3, -1.0
"""Height of the ball's lowest point [m] and velocity [m/s] at the start."""
RADIUS, GRAVITY = 0.03, 9.81
IMPACT = (FALL + np.sqrt(FALL**2 + 2 * GRAVITY * HEIGHT)) / GRAVITY
"""Time at which it meets the floor [s]."""
SCENE = f"""
<mujoco>
  <option timestep="{STEP}" gravity="0 0 -{GRAVITY}"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1" solref="-40000 -10"/>
    <body name="ball" pos="0 0 {RADIUS}">
      <joint name="along" type="slide" axis="1 0 0"/>
      <joint name="up" type="slide" axis="0 0 1"/>
      <geom type="sphere" size="{RADIUS}" mass="0.1" friction="0.3" solref="-40000 -10"/>
    </body>
  </worldbody>
  <sensor><jointpos name="along" joint="along"/><jointpos name="up" joint="up"/></sensor>
</mujoco>"""
STATE = np.array([0.0, HEIGHT]), np.array([0.2, FALL])
AT_GRID = ObservationCfg(scatter_offset=1e-6)
"""Scatter by shifts of the time grid alone."""


def simulated(qpos: np.ndarray, qvel: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s], (T,), and positions (T, 2) of a simulation step by step."""
    m = mujoco.MjModel.from_xml_string(SCENE)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = qpos, qvel
    rows = []
    for _ in range(round(seconds / STEP) + 1):
        rows.append(d.qpos.copy())
        mujoco.mj_step(m, d)
    return STEP * np.arange(len(rows)), np.array(rows)


def falling(seconds: float, scene: str = SCENE) -> tuple[Model, Recording]:
    """Return the model and the recording, without noise, of a ball that falls and rebounds."""
    time = PERIOD * np.arange(round(seconds / PERIOD) + 1)
    clock, place = simulated(*STATE, seconds + STEP)
    seen = {name: np.interp(time, clock, place[:, k])[:, None] for k, name in enumerate(("along", "up"))}
    measured = {name: Channel(time, value, NOISE) for name, value in seen.items()}
    demonstration = Demonstration("demo_0", qpos=STATE[0], qvel=STATE[1], measured=measured)
    return Model(Scene(scene)), Recording(scene, (demonstration,))


def window_of(seconds: float, cfg: ObservationCfg = AT_GRID) -> tuple[Model, Window]:
    """Return the model and the one window of such a recording."""
    model, recording = falling(seconds)
    (window,) = observe(model, recording, length=10.0, cfg=cfg)
    return model, window


def scatter_of(window: Window) -> NumericalScatter:
    assert window.scatter is not None
    return window.scatter


def test_whitening_is_the_inverse_root_of_the_covariance_of_noise_and_scatter():
    rng = np.random.default_rng(0)
    for shape in ((9, 3), (3, 9), (5, 1)):
        deviations = 3.0 * rng.normal(size=shape)
        covariance = np.eye(shape[0]) + deviations @ deviations.T
        variance, axes = np.linalg.eigh(covariance)
        found = NumericalScatter(deviations)
        residual = rng.normal(size=shape[0])
        np.testing.assert_allclose(found.whitened(residual), (axes / np.sqrt(variance)) @ axes.T @ residual)


def test_residuals_on_which_nothing_scatters_stay_as_they_are():
    deviations = np.zeros((6, 2))
    deviations[3:] = [[1.0, 2.0], [0.5, -1.0], [3.0, 0.0]]
    residual = np.arange(1.0, 7.0)
    found = NumericalScatter(deviations).whitened(residual)
    np.testing.assert_allclose(found[:3], residual[:3])
    assert np.linalg.norm(found[3:]) < np.linalg.norm(residual[3:])


def test_the_scatter_of_some_residuals_has_their_share_of_the_covariance():
    deviations = np.random.default_rng(1).normal(size=(8, 3))
    rows = np.array([6, 0, 3])
    part = NumericalScatter(deviations).rows(rows).deviations
    np.testing.assert_allclose(part @ part.T, (deviations @ deviations.T)[np.ix_(rows, rows)])


def test_a_rebound_scatters_and_the_fall_before_it_does_not():
    _, window = window_of(0.5)
    size = np.linalg.norm(scatter_of(window).deviations, axis=1)
    up = next(r.rows for r in window.readings if r.channel == "up")
    before, after = window.clock[up] < IMPACT - STEP, window.clock[up] > IMPACT + 0.05
    assert before.sum() > 20
    assert after.sum() > 20
    assert size[up][before].max() < 0.2
    assert size[up][after].max() > 5.0
    # What leaves the floor at another velocity is the farther off the later.
    late = size[up][after]
    assert late[-1] > 2 * late[0]


def test_a_window_that_ends_before_the_first_impact_has_no_scatter():
    model, recording = falling(0.5)
    windows = observe(model, recording, length=10.0, cfg=AT_GRID)
    assert [first_part(w, IMPACT - 2 * STEP).scatter is None for w in windows] == [False]
    early = [replace(first_part(w, IMPACT - 2 * STEP), scatter=None) for w in windows]
    assert [w.scatter for w in with_scatter(model, early, cfg=AT_GRID)] == [None]


@pytest.mark.parametrize("share", [0.17, 0.37, 0.81])
def test_the_scatter_covers_what_a_start_between_two_steps_changes(share):
    _, window = window_of(0.5)
    early = share * STEP
    (qpos, qvel), down = STATE, np.array([0.0, -GRAVITY])
    clock, place = simulated(qpos - early * qvel + early**2 / 2 * down, qvel - early * down, 0.5 + 2 * STEP)
    plain_clock, plain = simulated(qpos, qvel, 0.5 + 2 * STEP)
    change = np.empty(window.count)
    for k, name in enumerate(("along", "up")):
        reading = next(r for r in window.readings if r.channel == name)
        moved, still = (np.interp(reading.time, t, p[:, k]) for t, p in ((clock - early, place), (plain_clock, plain)))
        change[reading.rows] = (moved - still) / NOISE
    assert np.linalg.norm(change) > 10.0
    assert np.linalg.norm(scatter_of(window).whitened(change)) < 3.0
    # A change of the fall before the impact, as by another gravity, is no scatter.
    fall = np.where(window.clock < IMPACT - STEP, 100 * window.clock**2, 0.0)
    np.testing.assert_allclose(scatter_of(window).whitened(fall), fall, atol=0.02 * fall.max())


@pytest.mark.parametrize("own", [None, np.array([0.0, 2.0, 0.5, 1.0])])
def test_the_size_of_scatter_is_that_of_its_covariance(own):
    deviations = np.random.default_rng(3).normal(size=(4, 2))
    covariance = deviations @ deviations.T + np.diag(np.ones(4) if own is None else 1 + own**2)
    found = NumericalScatter(deviations, own)
    assert found.log_determinant == pytest.approx(np.linalg.slogdet(covariance).logabsdet)
    assert found.square == pytest.approx(np.trace(covariance) - 4)


def test_residuals_without_scatter_are_in_units_of_noise_alone():
    deviations, common = np.array([[3.0], [0.0], [4.0]]), np.array([[0.0], [2.0], [0.0]])
    residual = np.array([1.0, -2.0, 0.5])
    for scatter, shared, expected in (
        (None, None, residual),
        (deviations, None, residual),
        (np.hstack([deviations, common]), common, NumericalScatter(common).whitened(residual)),
    ):
        window: Any = SimpleNamespace(scatter=None if scatter is None else NumericalScatter(scatter), common=shared)
        seen = residual if scatter is None else NumericalScatter(scatter).whitened(residual)
        np.testing.assert_allclose(Window.without_scatter(window, seen), expected)


def test_predictions_of_a_window_with_scatter_are_whitened():
    model, window = window_of(0.5)
    plain = replace(window, scatter=None)
    prediction = Prediction(model, (), [window, plain])
    offset = np.array([0.0, 1e-3, 0.0, 0.02])
    whitened, raw = prediction.residuals([SimulationRequest(k, prediction.start, offset) for k in range(2)])
    assert np.abs(raw).max() > 5.0
    np.testing.assert_allclose(whitened, scatter_of(window).whitened(raw))
    assert np.abs(whitened - raw).max() > 2.0


def test_the_first_part_of_a_window_keeps_the_scatter_of_its_residuals():
    model, window = window_of(0.5)
    part = first_part(window, 0.35)
    assert [r.rows for r in part.readings] == [slice(0, 71), slice(71, 142)]
    rows = np.concatenate([r.rows.start + np.arange(71) for r in window.readings])
    np.testing.assert_array_equal(scatter_of(part).deviations, scatter_of(window).deviations[rows])
    (residual,) = Prediction(model, (), [part]).residuals([SimulationRequest(0, np.zeros(0))])
    assert residual.shape == (142,)


def test_a_window_in_which_nothing_touches_anything_keeps_none_and_none_are_made_of_no_samples():
    model, window = window_of(0.5)
    smooth, rough = replace(window, scatter=None, smooth=True), replace(window, scatter=None)
    found = with_scatter(model, [smooth, rough, smooth], cfg=AT_GRID)
    assert [w.scatter is None for w in found] == [True, False, True]
    np.testing.assert_allclose(scatter_of(found[1]).deviations, scatter_of(window).deviations)
    (unscattered,) = with_scatter(model, [rough], cfg=replace(AT_GRID, scatter_samples=0))
    assert unscattered is rough
    _, none = window_of(0.5, replace(AT_GRID, scatter_samples=0))
    assert none.scatter is None


def test_scatter_is_that_of_the_model_alone_and_not_of_an_earlier_one():
    model, window = window_of(0.5)
    (again,) = with_scatter(model, [window], cfg=AT_GRID)
    np.testing.assert_allclose(scatter_of(again).deviations, scatter_of(window).deviations)


def test_scatter_below_the_least_is_neglected():
    _, some = window_of(0.5, replace(AT_GRID, min_scatter=2.0))
    size = np.linalg.norm(scatter_of(some).deviations, axis=0)
    assert size.min() > 2.0
    _, none = window_of(0.5, replace(AT_GRID, min_scatter=1e3))
    assert none.scatter is None


def test_a_motion_that_a_model_does_not_follow_at_all_has_no_scatter():
    model, window = window_of(0.5)
    away = replace(window, qpos=window.qpos + np.array([1.0, 0.0]), scatter=None)  # 5000 times the noise
    (found,) = with_scatter(model, [away], cfg=AT_GRID)
    assert found.scatter is None


def test_before_an_impact_predictions_scatter_by_a_small_share_of_the_spread_of_the_initial_state():
    cfg = ObservationCfg(scatter_samples=500, scatter_offset=0.05, min_scatter=1e-6)
    _, window = window_of(0.5, cfg)
    along = next(r for r in window.readings if r.channel == "along")
    size = np.linalg.norm(scatter_of(window).deviations[along.rows], axis=1)
    place, speed = 0.05 * window.spread[[0, 2]] / NOISE
    before = along.time < IMPACT - STEP
    np.testing.assert_allclose(size[before], np.hypot(place, speed * along.time)[before], rtol=0.1)


def test_what_presses_an_overlap_at_the_start_apart_is_no_scatter():
    model, window = window_of(0.5)
    # Half a millimetre, twice as deep as at rest: the contact pushes upwards by about 10 m/s^2.
    sunk = replace(window, qpos=np.array([0.0, -5e-4]), qvel=np.zeros(2), scatter=None)
    readings = tuple(replace(r, value=0 * r.value) for r in sunk.readings)
    (found,) = with_scatter(model, [replace(sunk, readings=readings)], cfg=AT_GRID)
    assert np.abs(scatter_of(found).deviations).max() < 0.5  # several times as much with the acceleration


def test_whitening_by_scatter_can_be_undone():
    rng = np.random.default_rng(2)
    residual, deviations = rng.normal(size=9), 5 * rng.normal(size=(9, 3))
    for scatter in (NumericalScatter(deviations), NumericalScatter(deviations, np.abs(rng.normal(size=9)))):
        np.testing.assert_allclose(scatter.unwhitened(scatter.whitened(residual)), residual, rtol=1e-9)
