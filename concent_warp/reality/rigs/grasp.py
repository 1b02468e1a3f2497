"""A gripper on two slides grasps a block, lifts it, shakes it to the side and up and down, and puts it back."""

from __future__ import annotations

import numpy as np

from concent_warp.reality.rigs.rig import Rig, RigTrial, of_coarser_step
from concent_warp.reality.rigs.signals import COMMAND_RATE, chirp, hold, minimum_jerk_profile
from concent_warp.scene.scene import Scene

HALF_SIZE = 0.02
"""Half size of the block [m]."""
OPEN_WIDTH = 0.035
"""Commanded opening of each finger before the grasp [m]."""
CLOSED_WIDTH = 0.011
"""And in it: less than the block's half size, so that stiffness times the difference holds it."""
XML = f"""
<mujoco model="grasp">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="10" iterations="100" ls_iterations="50"/>
  <default>
    <geom solref="0.006 1" friction="0.6 0.005 0.0001" condim="4"/>
    <default class="finger">
      <joint type="slide" range="0 0.05" damping="10" armature="0.05"/>
      <geom type="box" size="0.012 0.006 0.015" mass="0.03"/>
    </default>
  </default>
  <worldbody>
    <light pos="0 -0.4 1.5"/>
    <geom name="table" type="plane" size="1 1 0.1" friction="0.5 0.005 0.0001" priority="1"/>
    <body name="carriage" pos="0 0 0.14" gravcomp="1">
      <joint name="slide_x" type="slide" axis="1 0 0"/>
      <geom name="carriage" type="box" pos="0 0 0.06" size="0.03 0.02 0.02" mass="0.5" contype="0" conaffinity="0"/>
      <body name="hand" gravcomp="1">
        <joint name="slide_z" type="slide" axis="0 0 1"/>
        <geom name="hand" type="box" size="0.02 0.05 0.015" mass="0.3" contype="0" conaffinity="0"/>
        <body name="left_finger" pos="0 0 -0.11" gravcomp="1">
          <joint name="left_finger_joint" axis="0 1 0" class="finger"/>
          <geom name="left_pad" class="finger" pos="0 0.006 0"/>
        </body>
        <body name="right_finger" pos="0 0 -0.11" gravcomp="1">
          <joint name="right_finger_joint" axis="0 -1 0" class="finger"/>
          <geom name="right_pad" class="finger" pos="0 -0.006 0"/>
        </body>
      </body>
    </body>
    <body name="block" pos="0 0 {HALF_SIZE}">
      <freejoint name="block_joint"/>
      <geom name="block" type="box" size="{HALF_SIZE} {HALF_SIZE} {HALF_SIZE}" mass="0.25" friction="0.5 0.005 0.0001"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="grip">
      <joint joint="left_finger_joint" coef="0.5"/>
      <joint joint="right_finger_joint" coef="0.5"/>
    </fixed>
  </tendon>
  <equality>
    <joint joint1="left_finger_joint" joint2="right_finger_joint" polycoef="0 1 0 0 0" solref="0.005 1"/>
  </equality>
  <actuator>
    <position name="drive_x" joint="slide_x" kp="2500" kv="110" forcerange="-60 60"/>
    <position name="drive_z" joint="slide_z" kp="2500" kv="110" forcerange="-60 60"/>
    <position name="gripper" tendon="grip" kp="1200" kv="30" forcerange="-20 20"/>
  </actuator>
  <sensor>
    <jointpos name="slide_x_position" joint="slide_x"/>
    <jointpos name="slide_z_position" joint="slide_z"/>
    <tendonpos name="gripper_opening" tendon="grip"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""
GRASP_HEIGHT = -0.008
"""Height of the hand in the grasp, relative to the nominal one [m]."""


def _plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Close slowly, lift, shake along x and along z with rising frequency, hold, set down gently, open."""
    del k
    lift = rng.uniform(0.07, 0.1)
    high = GRASP_HEIGHT + lift
    x = [hold(0.0, 0.3), hold(0.0, 0.7), hold(0.0, 0.3), hold(0.0, 0.7), hold(0.0, 0.2)]
    z = [
        hold(GRASP_HEIGHT, 0.3),
        hold(GRASP_HEIGHT, 0.7),
        hold(GRASP_HEIGHT, 0.3),
        minimum_jerk_profile(GRASP_HEIGHT, high, 0.7),
        hold(high, 0.2),
    ]
    x += [chirp(0.0, rng.uniform(0.018, 0.024), 0.6, 2.6, 2.2), hold(0.0, 0.2), hold(0.0, 2.2), hold(0.0, 0.2)]
    z += [hold(high, 2.4), chirp(high, rng.uniform(0.012, 0.016), 0.6, 2.6, 2.2), hold(high, 0.2)]
    x += [minimum_jerk_profile(0.0, 0.03, 0.5), hold(0.03, 2.0)]
    z += [hold(high, 0.5), minimum_jerk_profile(high, GRASP_HEIGHT + 0.0005, 1.0), hold(GRASP_HEIGHT + 0.0005, 1.0)]
    command = {"drive_x": np.concatenate(x), "drive_z": np.concatenate(z)}
    count = len(command["drive_x"])
    grip = [hold(OPEN_WIDTH, 0.3), minimum_jerk_profile(OPEN_WIDTH, CLOSED_WIDTH, 0.7)]
    closed = count - sum(map(len, grip)) - round(0.7 * COMMAND_RATE)
    grip += [
        hold(CLOSED_WIDTH, closed / COMMAND_RATE),
        minimum_jerk_profile(CLOSED_WIDTH, OPEN_WIDTH, 0.4),
        hold(OPEN_WIDTH, 0.3),
    ]
    command["gripper"] = np.concatenate(grip)
    time = np.arange(count) / COMMAND_RATE
    place = rng.uniform(-0.003, 0.003, 2)
    return RigTrial(
        count / COMMAND_RATE,
        {name: (time, value) for name, value in command.items()},
        qpos={
            "block_joint": [*place, HALF_SIZE - 1e-5, 1, 0, 0, 0],
            "left_finger_joint": [OPEN_WIDTH],
            "right_finger_joint": [OPEN_WIDTH],
            "slide_z": [GRASP_HEIGHT],
        },
        settling_time=0.3,
    )


SCENE = Scene(XML, "grasp rig")
GRASP = Rig(
    "grasp",
    SCENE,
    _plan,
    of_coarser_step(SCENE),
    start="resting",
    body="block",
    surface="table",
    grippers=("gripper",),
    pads=("left_pad", "right_pad"),
)
