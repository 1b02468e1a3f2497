"""A block is launched over a table at several speeds, turned by 0, 90 and 180 degrees, until friction stops it."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.reality.rigs.rig import Rig, RigTrial, WorldPhysics
from concent_warp.reality.sliding_friction import apply_sliding_friction, frictionless
from concent_warp.scene.scene import Scene
from concent_warp.scene.tabletop import yaw_quaternion

HALF_SIZES = (0.08, 0.06, 0.01)
"""Half sizes of the block [m]."""
FRICTION = 0.3
SPEEDS = (1.0, 0.7, 0.9, 0.6, 0.8, 0.5)
"""Of the six throws [m/s]."""
START_YAWS = (0.0, 0.0, np.pi / 2, np.pi / 2, np.pi, np.pi)
"""Of the block before each throw [rad]."""
XML = f"""
<mujoco model="slide">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="3"/>
  <worldbody>
    <light pos="0 -0.4 1.5"/>
    <geom name="table" type="plane" size="2 2 0.1" friction="{FRICTION} 0.005 0.0001" solref="0.006 1" priority="1"/>
    <body name="block" pos="0 0 {HALF_SIZES[2]}">
      <freejoint name="block_joint"/>
      <geom name="block" type="box" size="{" ".join(map(str, HALF_SIZES))}" mass="0.4"
            friction="{FRICTION} 0.005 0.0001" solref="0.006 1"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


def _plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Launch the block in some direction; every second throw with a turn about the vertical."""
    speed = SPEEDS[k % 6] * rng.uniform(0.9, 1.1)
    yaw = START_YAWS[k % 6] + rng.normal(0, 0.05)
    # Along the table's x, its y and between, so that a table with a grain tells.
    heading = (k % 3) * np.pi / 4 + rng.normal(0, 0.1)
    turning = 0.0 if k % 2 == 0 else rng.choice([-1, 1]) * rng.uniform(1.0, 2.5)
    start = [-0.5 * speed * np.cos(heading) / 3, -0.5 * speed * np.sin(heading) / 3, HALF_SIZES[2] - 1e-5]
    return RigTrial(
        speed / (FRICTION * 9.81) + 0.35,
        qpos={"block_joint": [*start, *yaw_quaternion(yaw)]},
        qvel={"block_joint": [speed * np.cos(heading), speed * np.sin(heading), 0, 0, 0, turning]},
        settling_time=0.2,
    )


def _glossy(spec: mujoco.MjSpec) -> None:
    """Leave friction to `rub`."""
    frictionless(spec, ("table", "block"))


def _coulomb(time: float, point: np.ndarray) -> np.ndarray:
    """Return the nominal coefficients, independent of time and position."""
    del time, point
    return np.array([FRICTION, FRICTION])


PHYSICS = WorldPhysics(edit=_glossy, force=apply_sliding_friction(_coulomb, "block", "table"))
SLIDE = Rig("slide", Scene(XML, "slide rig"), _plan, PHYSICS, throws=6, start="resting", body="block", surface="table")
