import numpy as np
import pytest

from concent_warp.comparison.contact_names import ContactPartners, _box_of, _subtree
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import replay

XML = """
<mujoco>
  <option timestep="0.002"/>
  <custom><text name="concent_objects" data="block box"/></custom>
  <worldbody>
    <geom name="table" type="plane" size="1 1 .1"/>
    <body name="box" pos="0 0 .05">
      <geom type="box" size=".05 .05 .045" pos="0 0 -.005"/>
      <geom name="box_rim" type="box" size=".01 .05 .005" pos=".04 0 .045"/>
    </body>
    <body name="block" pos=".04 0 {height}"><freejoint/><geom type="box" size=".005 .03 .02" mass=".1"/></body>
    <body name="arm" pos="1 0 1"><joint name="hinge"/><geom size=".05"/>
      <body name="hand" pos=".2 0 0"><geom size=".05"/></body></body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""


def partners(height=0.12, spheres=False):
    scene = Scene(XML.format(height=height))
    model = Model(scene, ContactGeometryCfg(count=64, radius=0.005).build(scene) if spheres else None)
    engine = MujocoEngine(model)
    m, time = scene.model, np.array([0, 0.4])
    demonstration = Demonstration("d", qpos=m.qpos0, qvel=np.zeros(m.nv), action={"motor": Channel(time, np.zeros(2))})
    return ContactPartners.of_replay(
        model, engine.compiled, replay(model, demonstration, engine, contacts="all").numpy()
    )


@pytest.fixture(scope="module")
def on_the_rim():
    return partners()


def test_a_named_geom_and_its_side_are_reported(on_the_rim):
    touching = on_the_rim.of("block", 0.1, 0.3)
    assert touching.names == ("box's rim (+z side)",)
    assert touching.point == pytest.approx((0, 0, -0.02), abs=1e-3)


def test_the_other_side_of_a_contact_is_reported_too(on_the_rim):
    assert on_the_rim.of("box", 0.1, 0.3).names[0].startswith("block (-z")


def test_spheres_of_a_contact_geometry_are_identified_by_their_body():
    assert partners(spheres=True).of("block", 0.1, 0.3).names[0].startswith("box (")


def test_a_free_fall_has_no_contact_and_a_short_contact_is_not_reported():
    falling = partners(height=0.5)
    assert falling.of("block", 0.0, 0.2) is None
    assert falling.of("block", 0.0, 0.3) is None
    assert falling.of("nobody", 0.0, 0.2) is None


def test_a_body_carries_its_children_and_its_box_holds_all_its_geoms():
    m = Scene(XML.format(height=0.12)).model
    arm, hand = m.body("arm").id, m.body("hand").id
    assert _subtree(m, arm) == [arm, hand]
    low, high = _box_of(m, m.body("box").id)
    assert low == pytest.approx([-0.05, -0.05, -0.05])
    assert high == pytest.approx([0.05, 0.05, 0.05])
