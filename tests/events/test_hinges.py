"""Objects that turn about their own origin: a lever that is pressed and springs back."""

import numpy as np

from concent_warp.events.extract import extract
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine

LEVER = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <custom><text name="concent_objects" data="lever"/></custom>
  <worldbody>
    <body name="finger" pos="0.06 0 0.05" gravcomp="1">
      <joint name="z" type="slide" axis="0 0 1" damping="10"/>
      <geom type="sphere" size="0.008" mass="0.2"/>
    </body>
    <body name="lever">
      <joint type="hinge" axis="0 1 0" range="0 0.8" stiffness="0.5" springref="-0.3" damping="0.02"/>
      <geom type="box" size="0.045 0.008 0.006" pos="0.045 0 0" mass="0.03"/>
    </body>
  </worldbody>
  <actuator><position name="z" joint="z" kp="2000" kv="40"/></actuator>
</mujoco>
"""


def stages_of(*heights: tuple[float, float]) -> list[str]:
    """Return the names of the stages when the finger goes through heights (time [s], displacement [m])."""
    time = np.arange(0.0, heights[-1][0], 0.01)
    command = np.interp(time, *np.array(heights).T)
    model = Model(Scene(LEVER), None)
    demonstration = Demonstration("demo_0", action={"z": Channel(time, command)})
    return [stage.name for stage in extract(model, demonstration, MujocoEngine(model, threads=1)).stages]


def test_a_lever_that_turns_about_its_origin_is_moved() -> None:
    assert stages_of((0, 0), (0.4, -0.07), (0.6, -0.07)) == ["contact robot-lever"]


def test_a_lever_that_springs_back_while_it_is_touched_has_been_moved() -> None:
    assert stages_of((0, 0), (0.4, -0.07), (0.8, -0.03), (1.0, -0.03)) == ["contact robot-lever"]


def test_a_lever_that_is_but_touched_opens_no_stage() -> None:
    assert stages_of((0, 0), (0.4, -0.038), (0.6, -0.038)) == []
