"""A ball spins in place on a table, or rolls over it, until friction stops it."""

from __future__ import annotations

import numpy as np

from concent_warp.reality.rigs.rig import Rig, RigTrial
from concent_warp.scene.scene import Scene

RADIUS = 0.03
XML = f"""
<mujoco model="spin">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="3"/>
  <default>
    <geom solref="0.01 1" friction="0.4 0.001 0.0004" condim="6"/>
  </default>
  <worldbody>
    <light pos="0 -0.4 1.5"/>
    <geom name="table" type="plane" size="2 2 0.1" priority="1"/>
    <body name="ball" pos="0 0 {RADIUS}">
      <freejoint name="ball_joint"/>
      <geom name="ball" type="sphere" size="{RADIUS}" mass="0.12"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="ball_position" objtype="xbody" objname="ball"/>
    <framequat name="ball_orientation" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>
"""


def _plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Spin and roll by turns, at several speeds and headings."""
    start = [0.0, 0.0, RADIUS - 1e-4, 1, 0, 0, 0]
    if k % 2 == 0:
        spin = rng.choice([-1, 1]) * rng.uniform(10, 20)
        return RigTrial(1.4, qpos={"ball_joint": start}, qvel={"ball_joint": [0, 0, 0, 0, 0, spin]}, settling_time=0.2)
    speed, heading = rng.uniform(0.25, 0.6), rng.uniform(-np.pi, np.pi)
    x, y = speed * np.cos(heading), speed * np.sin(heading)
    rolling = [x, y, 0, -y / RADIUS, x / RADIUS, 0]
    return RigTrial(1.4, qpos={"ball_joint": start}, qvel={"ball_joint": rolling}, settling_time=0.2)


SPIN = Rig("spin", Scene(XML, "spin rig"), _plan, throws=4, start="resting", body="ball", surface="table")
