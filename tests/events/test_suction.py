"""A suction cup grasps: it draws the object that it presses on, from one side."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.events.adhesion import adhesion_pull
from concent_warp.events.extract import extract
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.engine import ContactLog
from concent_warp.simulate.mujoco_engine import MujocoEngine

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="post" pos="0 0 0.07" gravcomp="1">
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.01 0.01 0.01" pos="0 0 0.02" mass="0.5"/>
      <body name="cup" gravcomp="1"><geom type="box" size="0.012 0.012 0.01" mass="0.05"/></body>
    </body>
    <body name="parcel" pos="0 0 0.025"><freejoint/><geom type="box" size="0.025 0.025 0.025" mass="0.1"/></body>
  </worldbody>
  <actuator>
    <position name="z" joint="z" kp="2000" dampratio="1"/>
    <adhesion name="suction" body="cup" gain="10" ctrlrange="0 1"/>
  </actuator>
</mujoco>
"""


def stages(suction: float) -> list[str]:
    scene = Scene(XML)
    model = Model(scene, ContactGeometryCfg(count=40).build(scene))
    time = np.array([0.0, 0.2, 0.3, 0.6, 1.0])
    down, up = -0.0115, 0.05
    demonstration = Demonstration(
        "demo_0",
        action={
            "z": Channel(time, np.array([0.0, down, down, up, up])),
            "suction": Channel(time, np.array([0.0, 0.0, suction, suction, suction])),
        },
    )
    return [stage.name for stage in extract(model, demonstration, MujocoEngine(model)).stages]


def test_what_a_suction_cup_lifts_is_picked():
    assert stages(1.0) == ["pick"]
    assert "pick" not in stages(0.0)


@pytest.mark.parametrize("limits", ["", 'forcerange="0 4"'])
def test_pull_is_spread_over_the_contacts_of_the_body_at_each_step(limits):
    m = mujoco.MjModel.from_xml_string(XML.replace('gain="10"', f'gain="10" {limits}'))
    cup, parcel = (int(m.body_geomadr[m.body(name).id]) for name in ("cup", "parcel"))
    log = ContactLog(
        variant=np.array([0, 0, 0, 1, 0, 0]),
        step=np.array([0, 0, 0, 0, 1, 2]),
        geom=np.array([[cup, parcel], [cup, parcel], [0, parcel], [cup, parcel], [0, cup], [cup, parcel]]),
        position=np.zeros((6, 3)),
        normal=np.zeros((6, 3)),
        distance=np.zeros(6),
        force=np.zeros((6, 3)),
    )
    ctrl = np.array([[0.0, 0.5], [0.0, 7.0], [0.0, 0.0]])
    most = 4.0 if limits else 10.0
    half = min(5.0, most)
    np.testing.assert_allclose(adhesion_pull(m, log, ctrl), [half / 2, half / 2, 0, half, most, 0])
    np.testing.assert_array_equal(adhesion_pull(m, replace(log, step=log.step + 9), ctrl), 0)
