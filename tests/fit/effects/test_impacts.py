"""Impacts as correlated noise: where they are found, how uncertain their outcome is, and what that changes."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from concent_warp.fit.effects.impacts import Impact, flying_bodies, impact_deviations, impacts
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

STEP, NOISE, PERIOD, GRAVITY, RADIUS = 0.001, 3e-4, 0.01, 9.81, 0.03
HEIGHT = 0.2
"""Height of the ball's lowest point at the start, at rest [m]."""
IMPACT = float(np.sqrt(2 * HEIGHT / GRAVITY))
"""Time at which it meets the floor [s]."""
SHIFT = 0.01
"""Distance of the ball's centre of mass from the origin of its frame [m]."""
SCENE = f"""
<mujoco>
  <option timestep="{STEP}" gravity="0 0 -{GRAVITY}"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1" solref="-40000 -10"/>
    <body name="ball" pos="0 0 {RADIUS}">
      <freejoint/>
      <inertial mass="0.1" pos="{{shift}} 0 0" diaginertia="3.6e-5 3.6e-5 3.6e-5"/>
      <geom type="sphere" size="{RADIUS}" friction="0.3" solref="-40000 -10"/>
    </body>
  </worldbody>
  <sensor><framepos name="place" objtype="body" objname="ball"/></sensor>
</mujoco>"""
CFG = ObservationCfg(scatter_samples=0, impact_error=0.005)


def prediction_of(seconds: float, height: float = HEIGHT, shift: float = 0.0, spin: float = 0.0) -> Prediction:
    """Return the prediction of one window in which the ball falls from a height, turning at a rate [rad/s]."""
    text = SCENE.format(shift=shift)
    scene = Scene(text)
    m = scene.model
    d = mujoco.MjData(m)
    d.qpos[2] += height
    d.qvel[4] = spin
    qpos, qvel = d.qpos.copy(), d.qvel.copy()
    rows = []
    for _ in range(round(seconds / STEP) + 1):
        rows.append(d.qpos[:3].copy())
        mujoco.mj_step(m, d)
    every = round(PERIOD / STEP)
    seen = {"place": Channel(STEP * every * np.arange(len(rows[::every])), np.array(rows[::every]), NOISE)}
    demonstration = Demonstration("demo_0", qpos=qpos, qvel=qvel, measured=seen)
    model = Model(scene)
    (window,) = observe(model, Recording(text, (demonstration,)), length=10.0, cfg=CFG)
    return Prediction(model, (), [replace(window, scatter=None)])


def impacts_of(prediction: Prediction, cfg: ObservationCfg = CFG) -> list[Impact]:
    """Return the impacts of the window's motion."""
    (course,) = prediction.courses([SimulationRequest(0, prediction.start)])
    return list(impacts(prediction.compiled, course, cfg))


def late(window: Window, after: float) -> np.ndarray:
    """Return which residuals belong to times beyond one [s], shape (count,) bool."""
    return window.clock > after


def test_an_impact_is_found_where_it_is_and_its_outcome_is_uncertain_by_a_share_of_the_change():
    prediction = prediction_of(0.3)
    (found,) = impacts_of(prediction)
    assert found.step * STEP == pytest.approx(IMPACT + CFG.impact_duration / 2, abs=CFG.impact_duration)
    # The ball rebounds with at most the speed that it had.
    speed = GRAVITY * IMPACT
    assert 1.0 * speed < found.std[0] / CFG.impact_error < 2.0 * speed
    np.testing.assert_allclose(found.std[:3], found.std[0])
    radius = np.sqrt(3.6e-5 / 0.1)
    np.testing.assert_allclose(found.std[3:], found.std[0] / radius, rtol=1e-3)


def test_a_ball_that_turns_about_a_centre_that_is_no_origin_flies_until_it_touches():
    # Its frame's origin accelerates by 40^2 x 0.01 m = 16 m/s^2 in flight.
    assert len(impacts_of(prediction_of(0.15, shift=SHIFT, spin=40.0))) == 0
    assert len(impacts_of(prediction_of(0.3, shift=SHIFT, spin=40.0))) == 1


def test_bodies_at_rest_in_flight_or_that_hop_a_little_have_none():
    assert impacts_of(prediction_of(0.3, height=0.0)) == []
    assert impacts_of(prediction_of(IMPACT - 0.01)) == []
    assert impacts_of(prediction_of(0.3, height=1e-4)) == []


@pytest.mark.parametrize("axis", ["0 0 1", "0 0 -1"])
def test_a_ball_on_slides_has_the_impacts_of_a_free_one_but_for_rotation(axis):
    slides = f'<joint name="side" type="slide" axis="1 0 0"/><joint name="height" type="slide" axis="{axis}"/>'
    text = SCENE.format(shift=0.0).replace("<freejoint/>", slides)
    m = mujoco.MjModel.from_xml_string(text)
    d, rows = mujoco.MjData(m), []
    d.qpos[1] = HEIGHT * float(axis.split()[2])
    for _ in range(300):
        rows.append((d.qpos.copy(), d.qvel.copy()))
        mujoco.mj_step(m, d)
    qpos, qvel = map(np.array, zip(*rows, strict=True))
    (free,) = impacts_of(prediction_of(0.3))
    (found,) = impacts(m, SimpleNamespace(qpos=qpos, qvel=qvel), CFG)  # pyright: ignore[reportArgumentType]
    assert (found.begin, found.step, found.dof, found.flies) == (free.begin, free.step, 0, free.flies)
    np.testing.assert_allclose(found.std, free.std[:2], rtol=1e-6)


def test_bodies_that_others_carry_or_that_turn_on_hinges_do_not_fly():
    m = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <body name="cart"><joint type="slide" axis="1 0 0"/><geom size="0.1"/>
        <body name="rider" pos="1 0 0"><joint type="slide" axis="1 0 0"/><geom size="0.1"/></body></body>
      <body name="door"><joint axis="0 0 1"/><geom size="0.1"/></body>
      <body name="screw"><joint type="slide"/><joint axis="0 0 1"/><geom size="0.1"/></body>
      <body name="ball" pos="0 0 1"><freejoint/><geom size="0.1"/></body>
    </worldbody></mujoco>""")
    assert [(m.body(f.body).name, f.turns, f.count) for f in flying_bodies(m)] == [
        ("cart", False, 1),
        ("ball", True, 6),
    ]


def test_what_follows_an_impact_is_uncertain_by_its_velocity_times_time_and_nothing_before_it():
    prediction = prediction_of(0.3)
    (window,), (impact,) = prediction.windows, impacts_of(prediction)
    found = impact_deviations(prediction, 0, replace(CFG, impact_duration_error=0.0))
    assert found.shape == (window.count, 6)
    begun = impact.step * STEP
    assert np.abs(found[~late(window, begun)]).max() == 0.0
    (place,) = window.readings
    since = np.maximum(place.time - begun, 0.0)
    for axis in range(3):  # a kick along an axis moves the ball along it
        moved = found[place.rows, axis].reshape(-1, 3)
        np.testing.assert_allclose(np.abs(moved[:, axis]), impact.std[axis] * since / NOISE, atol=0.02 * moved.max())
    # A ball that flies is where it is however it turns.
    assert np.abs(found[:, 3:]).max() < 1e-3 * np.abs(found[:, :3]).max()


def test_a_ball_may_have_left_its_impact_at_once_and_what_is_seen_meanwhile_says_little():
    prediction = prediction_of(0.3)
    (window,), (impact,) = prediction.windows, impacts_of(prediction)
    found = impact_deviations(prediction, 0, CFG)[:, 6:]
    begun, over = impact.begin * STEP, impact.step * STEP
    assert impact.flies
    assert begun == pytest.approx(IMPACT, abs=2 * STEP)
    assert np.abs(found[~late(window, begun)]).max() == 0.0
    (course,) = prediction.courses([SimulationRequest(0, prediction.start)])
    rebound = course.qvel[impact.step, 2]
    after = late(window, over)
    ahead = -found[after][2::3, 0] * NOISE  # residuals are what was measured less what is predicted
    # Without a duration the ball is ahead by its way in that time.
    speed = rebound - GRAVITY * (window.clock[after][2::3] - over)
    np.testing.assert_allclose(ahead, speed * (over - begun), rtol=0.1)
    # A reading in the impact is uncertain by itself.
    during = late(window, begun) & ~after
    assert found.shape[1] - 1 == during[2::3].sum() > 0
    for column in found[:, 1:].T:
        assert np.count_nonzero(column) == 1
        assert column[during].any()


def test_a_rebound_that_is_wrong_by_half_a_percent_is_no_more_than_noise_and_by_a_tenth_it_is():
    prediction = prediction_of(0.35)
    (window,), (impact,) = prediction.windows, impacts_of(prediction)
    (rough,) = observe(
        Model(Scene(SCENE.format(shift=0.0))),
        Recording(SCENE.format(shift=0.0), (window.demonstration,)),
        length=10.0,
        cfg=ObservationCfg(impact_error=CFG.impact_error),
    )
    assert rough.scatter is not None
    up = np.zeros(window.count)
    up[2::3] = np.maximum(window.clock[2::3] - impact.step * STEP, 0.0) * impact.std[2] / CFG.impact_error / NOISE
    little, much = rough.scatter.whitened(0.005 * up), rough.scatter.whitened(0.1 * up)
    assert np.linalg.norm(little) < 1.5  # one standard deviation of one direction
    assert np.linalg.norm(much) > 8.0


def test_no_error_gives_no_deviations():
    prediction = prediction_of(0.3)
    assert impact_deviations(prediction, 0, replace(CFG, impact_error=0.0)).shape == (prediction.windows[0].count, 0)
