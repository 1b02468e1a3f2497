"""A Cartesian gripper, a block and a box with a hole, all of spheres: the task of the paper in its smallest form."""

from dataclasses import dataclass

import numpy as np

from concent_warp.events.extract import extract
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.mujoco_engine import MujocoEngine

HOLE = (0.15, 0.0)
OPEN, SHUT = 0.02, -0.004
LOW, HIGH = 0.02, 0.09
"""Heights of the gripper around the block on the table, and above the box [m]."""

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <custom><text name="concent_objects" data="block box"/></custom>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="block" pos="0 0 0.02">
      <freejoint/>
      <geom type="box" size="0.02 0.02 0.02" mass="0.08"/>
    </body>
    <body name="box" pos="0.15 0 0" quat="{w} {x} {y} {z}"><frame quat="{w} -{x} -{y} -{z}">
      <geom type="box" size="0.035 0.035 0.0015" pos="0 0 0.0015"/>
      <geom type="box" size="0.00675 0.035 0.0125" pos="0.02825 0 0.0125"/>
      <geom type="box" size="0.00675 0.035 0.0125" pos="-0.02825 0 0.0125"/>
      <geom type="box" size="0.035 0.00675 0.0125" pos="0 0.02825 0.0125"/>
      <geom type="box" size="0.035 0.00675 0.0125" pos="0 -0.02825 0.0125"/>
    </frame></body>
    <body name="rail" pos="0 0 0">
      <joint name="x" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="palm" gravcomp="1">
        <joint name="y" type="slide" axis="0 1 0"/>
        <joint name="z" type="slide" axis="0 0 1"/>
        <geom type="box" size="0.01 0.05 0.01" pos="0 0 0.076" mass="0.5"/>
        <body name="left_finger" gravcomp="1">
          <joint name="left" type="slide" axis="0 1 0" range="-0.01 0.03"/>
          <geom type="box" size="0.008 0.004 0.03" pos="0 0.024 0.036" mass="0.05" friction="1" condim="4"/>
        </body>
        <body name="right_finger" gravcomp="1">
          <joint name="right" type="slide" axis="0 -1 0" range="-0.01 0.03"/>
          <geom type="box" size="0.008 0.004 0.03" pos="0 -0.024 0.036" mass="0.05" friction="1" condim="4"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="right" joint2="left" solref="0.005 1"/></equality>
  <actuator>
    <position name="x" joint="x" kp="3000" dampratio="1"/>
    <position name="y" joint="y" kp="3000" dampratio="1"/>
    <position name="z" joint="z" kp="3000" dampratio="1"/>
    <position name="grip" joint="left" kp="3000" kv="60"/>
  </actuator>
</mujoco>
"""

Waypoint = tuple[float, float, float, float, float]
"""Duration [s], x, y, z of the gripper [m] and opening of a finger [m]."""


@dataclass(frozen=True)
class Task:
    """The scene with its spheres, and demonstrations in it."""

    model: Model
    engine: MujocoEngine

    def perform(self, *waypoints: Waypoint) -> Demonstration:
        """Return a demonstration that goes from waypoint to waypoint in straight lines."""
        corners = np.array([(0, 0, 0, HIGH, OPEN), *waypoints])
        corners[:, 0] = np.cumsum(corners[:, 0])
        time = np.arange(0, corners[-1, 0] + 0.005, 0.01)
        action = {
            name: Channel(time, np.interp(time, corners[:, 0], corners[:, i]))
            for i, name in enumerate(("x", "y", "z", "grip"), start=1)
        }
        qpos = self.model.scene.model.qpos0.copy()
        qpos[[9, 10, 11]] = HIGH, OPEN, OPEN
        return Demonstration("show", action=action, qpos=qpos)

    def events(self, *waypoints: Waypoint) -> ContactEventSequence:
        """Return the events of a performance."""
        return extract(self.model, self.perform(*waypoints), self.engine)


PICK: list[Waypoint] = [(0.4, 0, 0, LOW, OPEN), (0.4, 0, 0, LOW, SHUT), (0.4, 0, 0, HIGH, SHUT)]


def insert_from(x: float, y: float) -> list[Waypoint]:
    """Return the waypoints that pick, press at (x, y) [m] beside the hole, slide in, let go and withdraw."""
    beside = HOLE[0] + x, HOLE[1] + y
    beyond = HOLE[0] - 0.4 * x, HOLE[1] - 0.4 * y
    return [
        *PICK,
        (0.5, *beside, HIGH, SHUT),
        (0.4, *beside, LOW + 0.02, SHUT),
        (0.5, *beyond, LOW + 0.02, SHUT),
        (0.4, *beyond, LOW, SHUT),
        (0.2, *HOLE, LOW, SHUT),
        (0.2, *HOLE, LOW, OPEN),
        (0.4, *HOLE, HIGH, OPEN),
    ]


def make_task(turn: tuple[float, float, float, float] = (1, 0, 0, 0)) -> Task:
    """Return the task with the axes of the box's frame, and not the box, turned by a quaternion wxyz >= 0."""
    scene = Scene(XML.format(**dict(zip("wxyz", turn, strict=True))))
    model = Model(scene, ContactGeometryCfg(count=400).build(scene))
    return Task(model, MujocoEngine(model, threads=1))
