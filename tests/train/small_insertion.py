"""The smallest insertion: a Cartesian gripper holds a block over a box with a hole, each of few spheres."""

from dataclasses import replace

import numpy as np

from concent_warp.events.extract import extract
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.train.cfg import ALL, ActionCfg, CollisionCfg, EdgeCfg, EnvironmentCfg, RandomisationCfg
from concent_warp.train.observation_cfg import ObservationCfg, SensorErrorsCfg
from concent_warp.train.reset_cfg import ResetCfg
from concent_warp.train.task.task import Task

HOLE = 0.12
OPEN, SHUT = 0.02, -0.004
LOW, HIGH = 0.02, 0.08
"""Heights of the tool around the block on the table, and above the box [m]."""

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" impratio="10" iterations="20"/>
  <custom><text name="concent_objects" data="block box"/></custom>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="block" pos="0 0 0.02">
      <freejoint/>
      <geom type="box" size="0.02 0.02 0.02" mass="0.08"/>
    </body>
    <body name="box" pos="0.12 0 0">
      <geom type="box" size="0.035 0.035 0.0015" pos="0 0 0.0015"/>
      <geom type="box" size="0.00675 0.035 0.0125" pos="0.02825 0 0.0125"/>
      <geom type="box" size="0.00675 0.035 0.0125" pos="-0.02825 0 0.0125"/>
      <geom type="box" size="0.035 0.00675 0.0125" pos="0 0.02825 0.0125"/>
      <geom type="box" size="0.035 0.00675 0.0125" pos="0 -0.02825 0.0125"/>
    </body>
    <body name="rail">
      <joint name="x" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="palm" gravcomp="1">
        <joint name="y" type="slide" axis="0 1 0"/>
        <joint name="z" type="slide" axis="0 0 1"/>
        <site name="tcp"/>
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
    <position name="grip" joint="left" kp="3000" kv="60" ctrllimited="true" ctrlrange="-0.01 0.03"/>
  </actuator>
</mujoco>
"""

WAYPOINTS = (
    # duration [s], x, y, z of the tool [m], opening of a finger [m]
    (0.0, 0, 0, HIGH, OPEN),
    (0.4, 0, 0, LOW, OPEN),
    (0.4, 0, 0, LOW, SHUT),
    (0.4, 0, 0, HIGH, SHUT),
    (0.5, HOLE - 0.008, 0.003, HIGH, SHUT),
    (0.4, HOLE - 0.008, 0.003, LOW + 0.0235, SHUT),
    (0.5, HOLE + 0.001, -0.001, LOW + 0.0225, SHUT),
    (0.4, HOLE, 0, LOW + 0.003, SHUT),
    (0.4, HOLE, 0, LOW + 0.003, SHUT),
)

EXACT_STATE = ObservationCfg(sensors=SensorErrorsCfg(exact=True))
"""Observation of the true state."""
NOTHING_VARIES = RandomisationCfg(
    friction=(1.0, 1.0), grip=(1.0, 1.0), stiffness=(1.0, 1.0), mass=(1.0, 1.0), perturbation=(0.0, 0.0)
)
"""The model's own physics in all worlds, without random force perturbations."""

SETTINGS = EnvironmentCfg(
    worlds=32,
    engine="mujoco",
    episode=1.5,
    action=ActionCfg(gripper_actuators=("grip",), gripper=0.0005),
    # A Cartesian gripper cannot turn what has turned in it.
    reset=ResetCfg(states=200, turn=0.0, position=0.008, grasp_turn=0.0),
    # Few and large spheres follow the hole's edges loosely: most of what they penetrate by is no collision, and true
    # surfaces get farther into one another than a tight fit allows.
    virtual=CollisionCfg(depth=10.0, points=0),
    observation=EXACT_STATE,
    randomisation=NOTHING_VARIES,
    stride=1,
    edges=EdgeCfg(count=0),
)


def make_model() -> Model:
    """Return the scene with its spheres."""
    scene = Scene(XML)
    return Model(scene, ContactGeometryCfg(counts={"block": 80, "box": 200}, radius="auto").build(scene))


def make_demonstration(model: Model) -> Demonstration:
    """Return the demonstration: pick, set down beside the hole, slide, and lower."""
    corners = np.array(WAYPOINTS)
    corners[:, 0] = np.cumsum(corners[:, 0])
    time = np.arange(0, corners[-1, 0] + 0.005, 0.01)
    action = {
        name: Channel(time, np.interp(time, corners[:, 0], corners[:, i]))
        for i, name in enumerate(("x", "y", "z", "grip"), start=1)
    }
    qpos = model.scene.model.qpos0.copy()
    qpos[[9, 10, 11]] = HIGH, OPEN, OPEN
    return Demonstration("demo_0", action=action, qpos=qpos)


def make_events(model: Model, demonstration: Demonstration) -> ContactEventSequence:
    """Return the contact events of the demonstration."""
    return extract(model, demonstration, MujocoEngine(model, threads=1))


def make_task(cfg: EnvironmentCfg = SETTINGS) -> Task:
    """Return the task of inserting."""
    model = make_model()
    return Task.build(model, make_demonstration(model), cfg)


CHAIN = replace(
    SETTINGS,
    stage=ALL,
    episode=5.0,
    # A Cartesian robot cannot turn.
    reset=replace(SETTINGS.reset, place=(0.02, 0.015), heading=(0.0, 0.0)),
    action=replace(SETTINGS.action, gripper=0.002),
)
"""The same with all stages chained."""
