"""A ball is thrown from several heights: it flies and bounces on a soft mat."""

from __future__ import annotations

import numpy as np

from concent_warp.reality.rigs.rig import Rig, RigTrial, WorldPhysics
from concent_warp.scene.scene import Scene

HEIGHTS = (1.0, 0.5, 1.4, 0.75)
"""Of the four throws [m]."""
RADIUS = 0.04
XML = f"""
<mujoco model="drop">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="3"/>
  <worldbody>
    <light pos="0 -0.4 3"/>
    <geom name="mat" type="plane" size="4 4 0.1" friction="0.5 0.005 0.0001" solref="0.04 0.4" solimp="0.0001 0.95 0.02"
      priority="1"/>
    <body name="ball" pos="0 0 0.5">
      <freejoint name="ball_joint"/>
      <geom name="ball" type="sphere" size="{RADIUS}" mass="0.4" friction="0.5 0.005 0.0001" solref="0.04 0.4"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="ball_position" objtype="xbody" objname="ball"/>
    <framequat name="ball_orientation" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>
"""


def _plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Throw the ball, hardly spinning; it bounces once or twice."""
    height = HEIGHTS[k % 4] * rng.uniform(0.95, 1.05)
    heading = rng.uniform(-np.pi, np.pi)
    speed = rng.uniform(1.0, 3.0)
    fall = np.sqrt(2 * (height - RADIUS) / 9.81)
    return RigTrial(
        fall + 0.6,
        qpos={"ball_joint": [-0.3 * np.cos(heading), -0.3 * np.sin(heading), height, 1, 0, 0, 0]},
        qvel={
            "ball_joint": [
                speed * np.cos(heading),
                speed * np.sin(heading),
                rng.uniform(-0.2, 0.3),
                *rng.normal(0, 0.5, 3),
            ]
        },
    )


DROP = Rig(
    "drop",
    Scene(XML, "drop rig"),
    _plan,
    WorldPhysics(timestep=0.001),
    throws=4,
    start="flying",
    body="ball",
    surface="mat",
)
