"""Scenes in which nothing collides, or only some things do: no effect fails on them."""

import mujoco
import pytest

from concent_warp.effects.registry import effect_classes

SCENE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 0.1" {floor}/>
    <body name="ball" pos="0 0 1"><freejoint/><geom type="sphere" size="0.02" {ball}/></body>
    <body name="hand">
      <joint name="wrist" type="hinge"/><geom size="0.03"/>
      <body name="left"><joint name="left" type="slide" axis="0 1 0"/><geom size="0.01" {finger}/></body>
      <body name="right"><joint name="right" type="slide" axis="0 -1 0"/><geom size="0.01" {finger}/></body>
    </body>
  </worldbody>
  <actuator><position name="left" joint="left" kp="10"/><position name="right" joint="right" kp="10"/></actuator>
  <sensor><framepos name="ball" objtype="xbody" objname="ball"/></sensor>
</mujoco>
"""
OFF = 'contype="0" conaffinity="0"'


@pytest.mark.parametrize(
    "quiet", [(), ("ball",), ("floor",), ("floor", "ball"), ("finger",), ("floor", "ball", "finger")]
)
def test_every_effect_finds_its_targets_and_their_parameters(quiet):
    off = {key: OFF if key in quiet else "" for key in ("floor", "ball", "finger")}
    m = mujoco.MjModel.from_xml_string(SCENE.format(**off))
    kinds = effect_classes()
    found = {name: kind.targets(m) for name, kind in dict(kinds).items()}
    for name, targets in found.items():
        for target in targets:
            effect = kinds[name](*target)
            effect.check(m)
            assert effect.parameters(m)
    assert bool(found["sliding_friction"]) == ("ball" not in quiet)
