"""Joints that only place a body lack no effects of bearings."""

import mujoco
import pytest

import concent_warp as cw
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.effects.select import placing_joints, unguided_bodies
from concent_warp.scene.scene import Scene

PLANE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="arm" pos="0 0 1"><joint name="hinge"/><geom size="0.1"/></body>
    <body name="roller" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="turn" axis="0 1 0" OF_TURN/>
      <geom size="0.1"/>
    </body>
  </worldbody>
  MORE
  <sensor><framepos name="position" objtype="xbody" objname="roller"/></sensor>
</mujoco>
"""
DRIVE = '<actuator><motor joint="x"/></actuator>'
BELT = '<tendon><fixed><joint joint="z" coef="1"/></fixed></tendon>'

COUPLING = '<equality><joint joint1="x" joint2="hinge"/></equality>'


def plane(of_turn: str = "", more: str = "") -> str:
    """Return a scene with a roller in a plane and an arm."""
    return PLANE.replace("OF_TURN", of_turn).replace("MORE", more)


def test_joints_of_a_body_in_a_plane_only_place_it() -> None:
    model = cw.Model(Scene(plane()))
    m = model.compile()
    assert [m.joint(j).name for j in placing_joints(m)] == ["x", "z", "turn"]
    assert [m.body(b).name for b in unguided_bodies(m)] == ["roller"]
    friction = [e.target for e in candidates(model, ["position"]) if e.name == "joint_friction"]
    assert friction == [("hinge",)]
    asked = [e.target for e in candidates(model, ["position"], ["joint_friction"])]
    assert any("x" in target for target in asked)
    found = {(e.name, e.target) for e in candidates(model, ["position"])}
    expected = ("sliding_friction", "rolling_friction", "adhesion", "air_drag", "size", "mass")
    assert {(name, ("roller",)) for name in expected} <= found
    assert not any(name == "wind" for name, _ in found)


@pytest.mark.parametrize(
    ("of_turn", "more"),
    [
        ('damping="0.1"', ""),
        ('frictionloss="0.1"', ""),
        ('stiffness="1"', ""),
        ('limited="true" range="-1 1"', ""),
        ("", DRIVE),
        ("", BELT),
        ("", COUPLING),
        ('armature="0.1"', ""),
    ],
)
def test_joints_with_a_drive_or_a_resistance_are_bearings(of_turn: str, more: str) -> None:
    m = mujoco.MjModel.from_xml_string(plane(of_turn, more))
    assert placing_joints(m) == unguided_bodies(m) == []
