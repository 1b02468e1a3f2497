"""A box is thrown, spinning, and lands on a soft mat, where it tumbles once or twice."""

from __future__ import annotations

import numpy as np

from concent_warp.reality.rigs.rig import Rig, RigTrial, WorldPhysics
from concent_warp.scene.scene import Scene

HEIGHTS = (0.5, 0.3, 0.7, 0.4)
"""Of the four throws [m]."""
XML = """
<mujoco model="tumble">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="3"/>
  <worldbody>
    <light pos="0 -0.4 3"/>
    <geom name="mat" type="plane" size="4 4 0.1" friction="0.4 0.005 0.0001" solref="0.04 0.7" priority="1"/>
    <body name="box" pos="0 0 0.5">
      <freejoint name="box_joint"/>
      <geom name="box" type="box" size="0.06 0.045 0.03" mass="0.2" friction="0.4 0.005 0.0001" solref="0.04 0.7"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="box_position" objtype="xbody" objname="box"/>
    <framequat name="box_orientation" objtype="xbody" objname="box"/>
  </sensor>
</mujoco>
"""


def _plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Throw the box so that it spins and meets the mat at an angle; end soon after."""
    height = HEIGHTS[k % 4] * rng.uniform(0.95, 1.05)
    along, across = rng.uniform(0.3, 1.2), rng.uniform(-0.4, 0.4)
    turn = rng.normal(0, 1, 4)
    return RigTrial(
        np.sqrt(2 * height / 9.81) + 0.35,
        qpos={"box_joint": [-0.3, 0, height, *(turn / np.linalg.norm(turn))]},
        qvel={"box_joint": [along, across, rng.uniform(0.1, 0.4), *rng.normal(0, 4, 3)]},
    )


TUMBLE = Rig(
    "tumble",
    Scene(XML, "tumble rig"),
    _plan,
    WorldPhysics(timestep=0.001),
    throws=4,
    start="flying",
    body="box",
    surface="mat",
)
