"""A small industrial arm of six axes with stiff position servos, which moves a tool slowly through poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines
from benchmarks.foreign.log import Case
from benchmarks.foreign.newton_euler import accelerations

MODEL = """
<mujoco model="industrial arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <geom type="capsule" size="0.04" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body name="link1" pos="0 0 0.2">
      <inertial pos="0 0 0.08" mass="6" diaginertia="0.03 0.03 0.02"/>
      <joint name="j1" axis="0 0 1" armature="1" damping="8" frictionloss="4"/>
      <geom fromto="0 0 0 0.03 0 0.12"/>
      <body name="link2" pos="0.03 0 0.14">
        <inertial pos="0 0.02 0.15" mass="5" diaginertia="0.06 0.055 0.015"/>
        <joint name="j2" axis="0 1 0" armature="1.2" damping="10" frictionloss="5"/>
        <geom fromto="0 0 0 0 0 0.3"/>
        <body name="link3" pos="0 0 0.3">
          <inertial pos="0.03 0 0.03" mass="3.2" diaginertia="0.012 0.014 0.01"/>
          <joint name="j3" axis="0 1 0" armature="0.6" damping="6" frictionloss="3"/>
          <geom fromto="0 0 0 0.1 0 0.05"/>
          <body name="link4" pos="0.12 0 0.05">
            <inertial pos="0.08 0 0" mass="1.8" diaginertia="0.003 0.006 0.006"/>
            <joint name="j4" axis="1 0 0" armature="0.15" damping="1.2" frictionloss="0.7"/>
            <geom fromto="0 0 0 0.18 0 0"/>
            <body name="link5" pos="0.2 0 0">
              <inertial pos="0.02 0 0" mass="0.8" diaginertia="0.001 0.0012 0.0012"/>
              <joint name="j5" axis="0 1 0" armature="0.12" damping="1" frictionloss="0.6"/>
              <geom fromto="0 0 0 0.05 0 0"/>
              <body name="flange" pos="0.08 0 0">
                <inertial pos="0 0 0" mass="0.15" diaginertia="0.0001 0.0001 0.0001"/>
                <joint name="j6" axis="1 0 0" armature="0.06" damping="0.5" frictionloss="0.3"/>
                <geom fromto="0 0 0 0.01 0 0"/>
                <body name="tool" pos="0.02 0 0">
                  <inertial pos="0.05 0 0.03" mass="0.9" diaginertia="0.0015 0.0015 0.0015"/>
                  <geom fromto="0 0 0 0.08 0 0.03"/>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="j1" joint="j1" kp="4000" kv="180"/>
    <position name="j2" joint="j2" kp="5000" kv="240"/>
    <position name="j3" joint="j3" kp="2500" kv="90"/>
    <position name="j4" joint="j4" kp="500" kv="18"/>
    <position name="j5" joint="j5" kp="400" kv="14"/>
    <position name="j6" joint="j6" kp="200" kv="7"/>
  </actuator>
  <sensor>
    <jointpos name="j1" joint="j1"/>
    <jointpos name="j2" joint="j2"/>
    <jointpos name="j3" joint="j3"/>
    <jointpos name="j4" joint="j4"/>
    <jointpos name="j5" joint="j5"/>
    <jointpos name="j6" joint="j6"/>
  </sensor>
</mujoco>
"""
JOINTS = ("j1", "j2", "j3", "j4", "j5", "j6")

AXES = np.array([[0.0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]])
PLACES = np.array([[0.0, 0, 0.2], [0.03, 0, 0.14], [0, 0, 0.3], [0.12, 0, 0.05], [0.2, 0, 0], [0.08, 0, 0]])
"""A maker's drawing has them, so that they are exact."""
CENTRES = np.array([[0.0, 0, 0.08], [0, 0.02, 0.15], [0.03, 0, 0.03], [0.08, 0, 0], [0.02, 0, 0]])
INERTIAS = np.array(
    [[0.03, 0.03, 0.02], [0.06, 0.055, 0.015], [0.012, 0.014, 0.01], [0.003, 0.006, 0.006], [0.001, 0.0012, 0.0012]]
)
TOOL = np.array([0.07, 0.0, 0.03])
"""Centre of mass of the tool in the frame of the flange, whose own lies at its hinge [m]."""


class Values(NamedTuple):
    """Values of the arm, by joint."""

    mass1: float = 6.0
    mass2: float = 5.0
    mass3: float = 3.2
    mass4: float = 1.8
    mass5: float = 0.8
    flange: float = 0.15
    tool: float = 0.9
    tool_inertia: float = 0.0015
    spread: float = 1.0
    """Factor of the links' inertias about their centres of mass."""
    centre: float = 1.0
    """Factor of the distances of the links' centres of mass."""
    rotor1: float = 1.0
    rotor2: float = 1.2
    rotor3: float = 0.6
    rotor4: float = 0.15
    rotor5: float = 0.12
    rotor6: float = 0.06
    damping1: float = 8.0
    damping2: float = 10.0
    damping3: float = 6.0
    damping4: float = 1.2
    damping5: float = 1.0
    damping6: float = 0.5
    friction1: float = 4.0
    friction2: float = 5.0
    friction3: float = 3.0
    friction4: float = 0.7
    friction5: float = 0.6
    friction6: float = 0.3
    kp1: float = 4000.0
    kp2: float = 5000.0
    kp3: float = 2500.0
    kp4: float = 500.0
    kp5: float = 400.0
    kp6: float = 200.0
    kv1: float = 180.0
    kv2: float = 240.0
    kv3: float = 90.0
    kv4: float = 18.0
    kv5: float = 14.0
    kv6: float = 7.0
    wrist: float = 0.0
    """By how much the last motor turns with joint 5, whose gears its shaft runs through, and which is not undone."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Recursive Newton-Euler; the state is angles and speeds."""
    q, v = y[:6], y[6:]
    rotors = np.array((p.rotor1, p.rotor2, p.rotor3, p.rotor4, p.rotor5, p.rotor6))
    damping = np.array((p.damping1, p.damping2, p.damping3, p.damping4, p.damping5, p.damping6))
    friction = np.array((p.friction1, p.friction2, p.friction3, p.friction4, p.friction5, p.friction6))
    kp = np.array((p.kp1, p.kp2, p.kp3, p.kp4, p.kp5, p.kp6))
    kv = np.array((p.kv1, p.kv2, p.kv3, p.kv4, p.kv5, p.kv6))
    masses = np.array((p.mass1, p.mass2, p.mass3, p.mass4, p.mass5, p.flange + p.tool))
    centres, inertias = np.empty((6, 3)), np.zeros((6, 3, 3))
    centres[:5] = p.centre * CENTRES
    centres[5] = TOOL * p.tool / masses[5]
    between = p.tool * p.flange / masses[5]
    square = TOOL[0] ** 2 + TOOL[1] ** 2 + TOOL[2] ** 2
    for i in range(3):
        for k in range(5):
            inertias[k, i, i] = p.spread * INERTIAS[k, i]
        for j in range(3):
            inertias[5, i, j] = -between * TOOL[i] * TOOL[j]
        inertias[5, i, i] += p.tool_inertia + 0.0001 + between * square
    driven = np.empty(6)
    for k in range(6):
        driven[k] = kp[k] * (u[k] - q[k]) - (kv[k] + damping[k]) * v[k] - coulomb(v[k], friction[k])
    twist = -p.wrist * (p.kp6 * q[4] + p.kv6 * v[4])
    driven[5] += twist
    driven[4] += p.wrist * (p.kp6 * (u[5] - q[5]) - p.kv6 * v[5] + twist)
    dy[:6] = v
    dy[6:] = accelerations(AXES, PLACES, masses, centres, inertias, 9.81, rotors, q, v, driven)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a motion through poses of a program, and slow sines of all joints at once."""
    t = clock(8.0, 125)
    side = rng.uniform(0.7, 0.9)
    poses = {
        "j1": [(0, 0), (0.6, side), (3.0, -0.5), (5.4, 0.2)],
        "j2": [(0, 0.2), (0.6, 0.7), (2.0, 0.4), (3.2, 0.8), (5.4, 0.1)],
        "j3": [(0, 0.1), (0.8, -0.4), (2.0, 0.3), (3.4, -0.2), (5.4, 0.3)],
        "j4": [(0, 0), (0.6, 0.9), (3.0, -0.8), (5.6, 0.3)],
        "j5": [(0, 0.6), (0.6, -0.5), (2.2, 0.9), (4.2, -0.2), (5.8, 0.7)],
        "j6": [(0, 0), (0.8, 1.2), (3.0, -1.0), (5.4, 0.6)],
    }
    first = {name: reach(t, points, 1.4) for name, points in poses.items()}
    slow = {
        "j1": sines(t, (0.5, 0.21, 0), (0.1, 0.7, 0)),
        "j2": 0.4 + sines(t, (0.3, 0.27, 0), (0.06, rng.uniform(0.8, 1.0), 0)),
        "j3": sines(t, (0.35, 0.33, 1.0), (0.06, 1.1, 0)),
        "j4": sines(t, (0.7, 0.24, 0), (0.15, 0.9, 0)),
        "j5": 0.2 + sines(t, (0.6, rng.uniform(0.3, 0.34), 0), (0.15, 1.2, 0)),
        "j6": sines(t, (0.8, 0.29, 0), (0.2, 1.0, 0)),
    }
    return [Motion(8.0, {name: Held(t, np.round(c, 6)) for name, c in m.items()}) for m in (first, slow)]


def encoder(joint: int) -> Sensor:
    """Return the encoder of a joint."""
    return Sensor(JOINTS[joint], ("position",), 125, 2e-4, lambda y, p: y[:, joint : joint + 1], 2e-4)  # noqa: ARG005


MACHINE = Machine(
    name="six_axis",
    model=MODEL,
    nominal=Values(),
    lengths=("centre",),
    loose=tuple(f"{what}{k}" for what in ("damping", "friction") for k in range(1, 7)),
    exact=("wrist", *(f"{what}{k}" for what in ("kp", "kv") for k in range(1, 7))),
    derivative=derivative,
    rest=lambda p, u: np.concatenate([u, np.zeros(6)]),  # noqa: ARG005
    actuators=JOINTS,
    sensors=tuple(encoder(joint) for joint in range(6)),
    motions=motions,
    settle=1.0,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case(
        "other_tool",
        "single",
        (("mass",),),
        Hidden(factors={"tool": 2.8, "tool_inertia": 2.8}),
        Habits(stated=True),
    ),
    MACHINE.case("cold_grease", "single", (("joint_damping",),), Hidden(added={"damping2": 35.0})),
    MACHINE.case(
        "weak_elbow", "single", (("actuator_gain",),), Hidden(factors={"kp3": 0.65, "kv3": 0.65}), Habits(lost=0.01)
    ),
    MACHINE.case(
        "tool_and_dry_base",
        "pair",
        (("mass",), ("joint_friction",)),
        Hidden(factors={"tool": 2.8, "tool_inertia": 2.8}, added={"friction1": 7.0}),
        Habits(stated=True),
    ),
    MACHINE.case("wrist_gears", "outside", (), Hidden(added={"wrist": 0.02}), Habits(stated=True)),
)
