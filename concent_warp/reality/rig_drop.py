"""A ball and a box are thrown from several heights, side by side: they fly, spin and bounce on a soft mat."""

from __future__ import annotations

import numpy as np

from concent_warp.reality.rig import Rig, Trial, WorldPhysics
from concent_warp.scene.scene import Scene

HEIGHTS = (1.0, 0.5, 1.4, 0.75)
"""Of the four throws [m]."""
XML = """
<mujoco model="drop">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="3"/>
  <worldbody>
    <light pos="0 -0.4 3"/>
    <geom name="mat" type="plane" size="4 4 0.1" priority="1" friction="0.5 0.005 0.0001" solref="0.04 0.4"/>
    <body name="ball" pos="0 0.3 0.5">
      <freejoint name="ball_joint"/>
      <geom name="ball" type="sphere" size="0.04" mass="0.05" friction="0.5 0.005 0.0001" solref="0.04 0.4"/>
    </body>
    <body name="box" pos="0 -0.3 0.5">
      <freejoint name="box_joint"/>
      <geom name="box" type="box" size="0.06 0.045 0.03" mass="0.2" friction="0.5 0.005 0.0001" solref="0.04 0.4"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="ball_position" objtype="xbody" objname="ball"/>
    <framequat name="ball_orientation" objtype="xbody" objname="ball"/>
    <framepos name="box_position" objtype="xbody" objname="box"/>
    <framequat name="box_orientation" objtype="xbody" objname="box"/>
  </sensor>
</mujoco>
"""


def plan(rng: np.random.Generator, k: int) -> Trial:
    """Throw both, the box so that it meets the mat at an angle and early in the recording."""
    height = HEIGHTS[k % 4] * rng.uniform(0.95, 1.05)
    along, across = rng.uniform(0.8, 2.5), rng.uniform(-0.5, 0.5)
    axis = rng.normal(0, 1, 4)
    fall = np.sqrt(2 * (height - 0.04) / 9.81)
    return Trial(
        min(fall + 0.45, 0.95),
        qpos={
            "ball_joint": [-0.5, 0.3, height, 1, 0, 0, 0],
            "box_joint": [-0.5, -0.3, height + 0.1, *(axis / np.linalg.norm(axis))],
        },
        qvel={
            "ball_joint": [along, across, rng.uniform(-0.2, 0.3), *rng.normal(0, 4, 3)],
            "box_joint": [0.7 * along, -across, rng.uniform(0.2, 0.5), *rng.normal(0, 4, 3)],
        },
    )


DROP = Rig("drop", Scene(XML, "drop rig"), plan, WorldPhysics(timestep=0.001), throws=4, start="flying")
