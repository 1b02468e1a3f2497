"""Contacts of bodies on joints: which can touch, and what their compliance changes."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from concent_warp.effects.library.contact import ContactCompliance, SlidingFriction, TorsionalFriction
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.touchable import touchable_pairs

DOOR = """
<mujoco><worldbody>{world}
  <body name="finger"><joint type="slide" axis="0 1 0"/><geom name="tip" size="0.01" solref="0.03 0.8"/></body>
  <body name="door" pos="0.1 0.1 0"><joint axis="0 0 1"/>
    <geom name="panel" type="box" size="0.1 0.01 0.1" solref="0.01 1.2" {panel}/>
    <body name="handle" pos="0 0.03 0"><joint axis="1 0 0"/><geom name="handle" size="0.01" {handle}/></body></body>
  {more}</worldbody><contact>{contact}</contact></mujoco>"""
FLOOR = '<geom name="floor" type="plane" size="1 1 0.1"/>'
NO_MASKS = 'contype="0" conaffinity="0"'


def compiled(**parts: str) -> mujoco.MjModel:
    """Return the finger and the door, with the given parts."""
    return mujoco.MjModel.from_xml_string(DOOR.format(**{k: parts.get(k, "") for k in
                                                        ("world", "panel", "handle", "more", "contact")}))  # fmt: skip


def test_geoms_touch_unless_a_mask_a_joint_between_them_or_an_exclusion_forbids_it():
    def touching(m: mujoco.MjModel) -> set[str]:
        pairs = np.argwhere(np.triu(touchable_pairs(m)))
        return {f"{m.geom(int(a)).name} {m.geom(int(b)).name}" for a, b in pairs}

    assert touching(compiled()) == {"tip panel", "tip handle"}  # the door carries its handle
    assert touching(compiled(panel=NO_MASKS)) == {"tip handle"}
    assert touching(compiled(contact='<exclude body1="door" body2="finger"/>')) == {"tip handle"}
    assert touching(compiled(world=FLOOR)) >= {"floor tip", "floor panel", "floor handle"}
    every = DOOR.replace("<worldbody>", '<option><flag filterparent="disable"/></option><worldbody>', 1)
    m = mujoco.MjModel.from_xml_string(every.format(world="", panel="", handle="", more="", contact=""))
    assert touching(m) == {"tip panel", "tip handle", "panel handle"}


def test_bodies_on_joints_that_can_touch_the_same_are_one_selection():
    targets = ContactCompliance.targets
    assert targets(compiled()) == (("finger", "door", "handle"),)
    assert targets(compiled(handle=NO_MASKS)) == (("finger", "door"),)
    assert targets(compiled(handle=NO_MASKS, panel=NO_MASKS)) == ()
    apart = compiled(
        handle=NO_MASKS,
        more='<body name="a"><joint/><geom size="0.1" contype="2" conaffinity="2"/></body>'
        '<body name="b"><joint/><geom size="0.1" contype="2" conaffinity="2"/></body>',
    )
    assert targets(apart) == (("finger", "door"), ("a", "b"))
    assert SlidingFriction.targets(compiled()) == targets(compiled())
    assert TorsionalFriction.targets(compiled()) == ()


def test_a_free_body_has_the_contacts_of_the_scene_to_itself():
    m = compiled(more='<body name="ball"><freejoint/><geom size="0.1"/></body>')
    assert ContactCompliance.targets(m) == (("ball",),)


def test_compliance_of_two_bodies_is_the_mean_of_their_geoms_and_scales_both():
    m, effect = compiled(handle=NO_MASKS), ContactCompliance("finger", "door")
    assert [p.null for p in effect.parameters(m)] == pytest.approx([0.02, 1.0])
    effect.write(m, np.array([0.04, 0.5]))
    np.testing.assert_allclose(m.geom("tip").solref, [0.06, 0.4])
    np.testing.assert_allclose(m.geom("panel").solref, [0.02, 0.6])


def test_a_ball_on_a_slide_bounces_from_the_floor_as_a_free_one_does():
    ball = """<mujoco><option timestep="0.001"/><worldbody>{floor}
      <body name="ball" pos="0 0 0.3">{joint}<geom size="0.05" mass="0.1" solref="0.02 0.2"/></body>
    </worldbody></mujoco>"""
    found = []
    for joint in ("<freejoint/>", '<joint type="slide" axis="0 0 1"/>'):
        model = Model(Scene(ball.format(floor=FLOOR, joint=joint))).add(ContactCompliance("ball"), [0.03, 0.1])
        m = model.compile()
        assert ContactCompliance.targets(m) == (("ball",),)
        d = mujoco.MjData(m)
        mujoco.mj_step(m, d, 500)
        found.append(d.body("ball").xpos[2])
    assert found[0] == pytest.approx(found[1], abs=1e-9)
