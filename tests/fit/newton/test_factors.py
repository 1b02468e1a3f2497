"""Factors on friction, stiffness and mass by gradients through Newton, against what is known of the motion."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.errors import EngineError, ModelError, RecordingError
from concent_warp.fit.newton.scale_factors import FactorCfg, FactorDescent, factors
from concent_warp.model import ContactParameters, Model
from concent_warp.recording.recording import Demonstration, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

HALF, RADIUS, MODEL_FRICTION = 0.02, 0.002, 0.4
SLIDING = """
<mujoco>
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" friction="{friction}"/>
    <body name="block" pos="0 0 0.02">
      <freejoint/><geom type="box" size="0.02 0.02 0.02" mass="0.08" friction="{friction}"/>
    </body>
  </worldbody>
</mujoco>
"""


def slid(friction: float) -> Recording:
    """Points on a box that slides over a plane at 0.5 m/s, seen 60 times a second for 0.3 s."""
    m = mujoco.MjModel.from_xml_string(SLIDING.format(friction=friction))
    d = mujoco.MjData(m)
    d.qvel[0] = 0.5
    qpos, qvel = d.qpos.copy(), d.qvel.copy()
    local = np.random.default_rng(0).uniform(-HALF, HALF, (12, 3))
    times, points = np.arange(19) / 60, []
    while len(points) < len(times):
        mujoco.mj_forward(m, d)
        if d.time >= times[len(points)] - 1e-9:
            points.append(d.body("block").xpos + local @ d.body("block").xmat.reshape(3, 3).T)
        mujoco.mj_step(m, d)
    track = PointTrack(times, np.array(points), np.ones((len(times), 12), dtype=bool))
    scene = SLIDING.format(friction=MODEL_FRICTION)
    return Recording(scene, (Demonstration("demo_0", qpos=qpos, qvel=qvel, points={"block": track}),))


@pytest.fixture(scope="module")
def model() -> Model:
    """The block as spheres in its corners, friction 0.4."""
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * (HALF - RADIUS)
    spheres = ContactGeometry(
        ("block",), np.zeros(8, int), corners, np.full(8, RADIUS), np.full(8, 0.01), np.full(8, MODEL_FRICTION)
    )
    return Model(Scene(SLIDING.format(friction=MODEL_FRICTION)), spheres, ContactParameters(condim=3))


@pytest.fixture(scope="module")
def slippery(model):
    return factors(model, slid(0.2))


def test_the_way_on_which_a_block_slides_to_rest_determines_its_friction(slippery):
    assert slippery.friction * MODEL_FRICTION == pytest.approx(0.2, rel=0.1)
    assert slippery.after["friction"] < 0.2 * slippery.before
    assert slippery.before == pytest.approx(slippery.mujoco, rel=0.1)


def test_a_sliding_block_tells_nothing_of_its_mass(slippery):
    assert slippery.mass == {"block": 1.0}


def test_where_nothing_is_wrong_gradients_lead_nowhere(model):
    found = factors(model, slid(MODEL_FRICTION))
    assert found.friction == pytest.approx(1.0, abs=0.1)


def test_slopes_are_those_of_central_differences(model):
    descent = FactorDescent(model, slid(0.2))
    _, slope = descent.slopes(np.ones(3))
    up, down = (descent.slopes(np.exp(sign * 0.02 * np.ones(3)))[0] for sign in (1, -1))
    assert slope[0] == pytest.approx((up - down)[0] / 0.04, rel=0.05)


def test_friction_of_an_effect_that_the_model_has_counts(model):
    from concent_warp.effects.library.contact import SlidingFriction

    right = model.add(SlidingFriction("block"), [0.2])
    found = factors(right, slid(0.2))
    assert found.friction == pytest.approx(1.0, abs=0.1)
    assert found.before < 1e-3


def test_without_geometry_or_observed_objects_or_a_common_motion_it_is_reported(model):
    recording = slid(0.2)
    with pytest.raises(ModelError, match="contact geometry of spheres"):
        factors(replace(model, geometry=None), recording)
    blind = replace(recording, demonstrations=(replace(recording[0], points={}),))
    with pytest.raises(RecordingError, match="nothing to fit to"):
        factors(model, blind)
    with pytest.raises(EngineError, match="another motion"):
        factors(model, recording, FactorCfg(max_engine_ratio=0.5))
