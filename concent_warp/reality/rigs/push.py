"""A plate on two slides with position control pushes a block over a table, with stops, from two sides."""

from __future__ import annotations

import numpy as np

from concent_warp.reality.rigs.rig import Rig, RigTrial, of_coarser_step
from concent_warp.reality.rigs.signals import COMMAND_RATE, hold, minimum_jerk_profile
from concent_warp.scene.scene import Scene

HALF_SIZE = 0.04
"""Half size of the block [m]."""
CONTACT_DISTANCE = HALF_SIZE + 0.01
"""Middle of the pusher to the middle of the block in contact [m]."""
XML = f"""
<mujoco model="push">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="3"/>
  <default>
    <geom solref="0.006 1" friction="0.35 0.005 0.0001"/>
  </default>
  <worldbody>
    <light pos="0 -0.4 1.5"/>
    <geom name="table" type="plane" size="1 1 0.1" priority="1"/>
    <body name="carriage" pos="-0.15 0 0.03">
      <joint name="slide_x" type="slide" axis="1 0 0"/>
      <geom name="carriage" type="box" pos="0 0 0.15" size="0.02 0.02 0.02" mass="0.4" contype="0" conaffinity="0"/>
      <body name="pusher">
        <joint name="slide_y" type="slide" axis="0 1 0"/>
        <geom name="pusher" type="cylinder" size="0.01 0.02" mass="0.3"/>
        <geom name="bar" type="box" size="0.01 0.03 0.02" mass="0.1"/>
      </body>
    </body>
    <body name="block" pos="0 0 {HALF_SIZE}">
      <freejoint name="block_joint"/>
      <geom name="block" type="box" size="{HALF_SIZE} {HALF_SIZE} {HALF_SIZE}" mass="0.5"/>
    </body>
  </worldbody>
  <actuator>
    <position name="drive_x" joint="slide_x" kp="1500" kv="80" forcerange="-40 40"/>
    <position name="drive_y" joint="slide_y" kp="1500" kv="80" forcerange="-40 40"/>
  </actuator>
  <sensor>
    <jointpos name="slide_x_position" joint="slide_x"/>
    <jointpos name="slide_y_position" joint="slide_y"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


def _plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Push to +x fast, slowly and fast again with stops between; go around and push to -x off the middle."""
    del k
    place = rng.uniform(-0.004, 0.004, 2)
    off = rng.uniform(0.006, 0.012) * rng.choice([-1, 1])
    x, y = [hold(0.0, 0.3)], [hold(0.0, 0.3)]

    def go(dx: float, dy: float, duration: float) -> None:
        x.append(minimum_jerk_profile(x[-1][-1], dx, duration))
        y.append(minimum_jerk_profile(y[-1][-1], dy, duration))

    touch = 0.15 - CONTACT_DISTANCE + place[0]
    first, second = rng.uniform(0.09, 0.11), rng.uniform(0.05, 0.06)
    go(touch - 0.003, off, 0.6)
    go(touch + first, off, 1.0)
    go(touch + first, off, 0.4)
    go(touch + first + second, off, 2.0)
    go(touch + first + second, off, 0.3)
    go(touch + 2 * first + second, off, 0.6)
    go(touch + 2 * first + second, off, 0.3)
    far = touch + 2 * first + second
    go(far - 0.06, off, 0.4)
    go(far - 0.06, 0.13, 0.5)
    go(far + 2 * CONTACT_DISTANCE + 0.05, 0.13, 0.7)
    go(far + 2 * CONTACT_DISTANCE + 0.05, off, 0.5)
    go(far + 2 * CONTACT_DISTANCE - 0.08, off, 1.0)
    go(far + 2 * CONTACT_DISTANCE - 0.08, off, 0.4)
    column = {"drive_x": np.concatenate(x), "drive_y": np.concatenate(y)}
    time = np.arange(len(column["drive_x"])) / COMMAND_RATE
    return RigTrial(
        len(time) / COMMAND_RATE,
        {name: (time, value) for name, value in column.items()},
        qpos={"block_joint": [*place, HALF_SIZE - 3e-5, 1, 0, 0, 0]},
        settling_time=0.3,
    )


SCENE = Scene(XML, "push rig")
PUSH = Rig("push", SCENE, _plan, of_coarser_step(SCENE), start="resting", body="block", surface="table")
