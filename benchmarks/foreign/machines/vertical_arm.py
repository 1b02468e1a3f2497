"""A two-link arm in the vertical plane, with position servos, encoders on the motors and a marker at the gripper."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, lugre
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, chirp, clock, reach, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="two-link arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper_arm" pos="0 0 0.8">
      <inertial pos="0.14 0 0" mass="1.6" diaginertia="0.002 0.014 0.014"/>
      <joint name="shoulder" type="hinge" axis="0 -1 0" armature="0.06" damping="0.4" frictionloss="0.25"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" contype="0" conaffinity="0"/>
      <body name="forearm" pos="0.3 0 0">
        <inertial pos="0.11 0 0" mass="0.9" diaginertia="0.001 0.006 0.006"/>
        <joint name="elbow" type="hinge" axis="0 -1 0" armature="0.025" damping="0.2" frictionloss="0.12"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" contype="0" conaffinity="0"/>
        <body name="gripper" pos="0.25 0 0">
          <inertial pos="0.05 0 0" mass="0.3" diaginertia="0.0002 0.0004 0.0004"/>
          <geom type="box" size="0.04 0.03 0.02" pos="0.04 0 0" contype="0" conaffinity="0"/>
          <site name="marker" pos="0.08 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder_servo" joint="shoulder" kp="160" kv="12"/>
    <position name="elbow_servo" joint="elbow" kp="60" kv="3.5"/>
  </actuator>
  <sensor>
    <jointpos name="shoulder_angle" joint="shoulder"/>
    <jointpos name="elbow_angle" joint="elbow"/>
    <framepos name="marker" objtype="site" objname="marker"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the arm: 1 is the upper arm, 2 the forearm, 3 the gripper."""

    mass1: float = 1.6
    centre1: float = 0.14
    length1: float = 0.3
    inertia1: float = 0.014
    mass2: float = 0.9
    centre2: float = 0.11
    length2: float = 0.25
    inertia2: float = 0.006
    mass3: float = 0.3
    centre3: float = 0.05
    inertia3: float = 0.0004
    marker: float = 0.08
    rotor1: float = 0.06
    rotor2: float = 0.025
    damping1: float = 0.4
    damping2: float = 0.2
    friction1: float = 0.25
    friction2: float = 0.12
    kp1: float = 160.0
    kp2: float = 60.0
    kv1: float = 12.0
    kv2: float = 3.5
    compliance: float = 0.0
    """Of the shoulder's gear [rad/(N m)]; 0 where it is rigid."""
    offset: float = 0.0
    """Angle of the elbow where its encoder reads 0 [rad]."""
    hose: float = 0.0
    """A hose along the elbow, which stiffens as it is bent [N m/rad^3]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Lagrange's equations; the state is angles, speeds, bristles, angle and speed of the shoulder's rotor."""
    q1, q2, v1, v2 = y[0], y[1], y[2], y[3]
    drag1, dy[4] = lugre(y[4], v1, p.friction1, p.friction1 / 2e-4, 0.1)
    drag2, dy[5] = lugre(y[5], v2, p.friction2, p.friction2 / 2e-4, 0.05)
    far = p.length2 + p.centre3
    moment = p.mass2 * p.centre2 + p.mass3 * far
    a = p.inertia1 + p.mass1 * p.centre1**2 + (p.mass2 + p.mass3) * p.length1**2
    b = p.inertia2 + p.mass2 * p.centre2**2 + p.inertia3 + p.mass3 * far**2
    c, h = p.length1 * moment * np.cos(q2), p.length1 * moment * np.sin(q2)
    weight2 = 9.81 * moment * np.cos(q1 + q2)
    weight1 = 9.81 * (p.mass1 * p.centre1 + (p.mass2 + p.mass3) * p.length1) * np.cos(q1) + weight2
    m11, m12, m22 = a + b + 2 * c, b + c, b + p.rotor2
    if p.compliance > 0.0:
        drive1 = (y[6] - q1) / p.compliance + 0.3 * (y[7] - v1)
        dy[6] = y[7]
        dy[7] = (p.kp1 * (u[0] - y[6]) - p.kv1 * y[7] - drive1) / p.rotor1
    else:
        drive1 = p.kp1 * (u[0] - q1) - p.kv1 * v1
        m11 += p.rotor1
        dy[6] = 0.0
        dy[7] = 0.0
    drive2 = p.kp2 * (u[1] - (q2 - p.offset)) - p.kv2 * v2
    f1 = drive1 - p.damping1 * v1 - drag1 - weight1 + h * (2 * v1 * v2 + v2 * v2)
    f2 = drive2 - p.damping2 * v2 - drag2 - weight2 - h * v1 * v1 - p.hose * (q2 + 0.9) ** 3
    det = m11 * m22 - m12 * m12
    dy[0] = v1
    dy[1] = v2
    dy[2] = (m22 * f1 - m12 * f2) / det
    dy[3] = (m11 * f2 - m12 * f1) / det


def marker(y: np.ndarray, p: Values) -> np.ndarray:
    """Return positions of the marker in the world [m]."""
    q, far = y[:, 0] + y[:, 1], p.length2 + p.marker
    x = p.length1 * np.cos(y[:, 0]) + far * np.cos(q)
    return np.stack([x, np.zeros(len(y)), 0.8 + p.length1 * np.sin(y[:, 0]) + far * np.sin(q)], axis=1)


def shoulder(y: np.ndarray, p: Values) -> np.ndarray:
    """Return what the encoder on the shoulder's motor reads [rad]."""
    return y[:, 6:7] if p.compliance > 0 else y[:, :1]


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a motion with reaches and steps, and one with chirps."""
    t = clock(5.0, 100)
    high = rng.uniform(0.7, 0.9)
    first = {
        "shoulder_servo": Held(t, reach(t, [(0, 0.2), (0.4, high), (2.2, -0.2), (3.7, 0.5)], 1.0)),
        "elbow_servo": Held(t, steps(t, [(0, -0.8), (1.0, -1.2), (1.8, -0.5), (2.9, -1.1), (4.0, -0.7)])),
    }
    second = {
        "shoulder_servo": Held(t, 0.3 + chirp(t, 0.3, 0.3, 1.4)),
        "elbow_servo": Held(t, -0.9 + chirp(t, -0.35, 0.5, rng.uniform(1.8, 2.2))),
    }
    return [Motion(5.0, first), Motion(5.0, second)]


MACHINE = Machine(
    name="vertical_arm",
    model=MODEL,
    nominal=Values(),
    lengths=("length1", "length2", "marker"),
    loose=("damping1", "damping2", "friction1", "friction2"),
    exact=("compliance", "offset", "hose"),
    derivative=derivative,
    rest=lambda p, u: np.array([u[0], u[1] + p.offset, 0, 0, 0, 0, u[0], 0]),
    actuators=("shoulder_servo", "elbow_servo"),
    sensors=(
        Sensor("shoulder_angle", ("angle",), 200, 4e-4, shoulder, 3e-4),
        Sensor("elbow_angle", ("angle",), 200, 4e-4, lambda y, p: y[:, 1:2] - p.offset, 3e-4),
        Sensor("marker", ("x", "y", "z"), 100, 6e-4, marker),
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True, lost=0.01)),
    MACHINE.case("grasped_weight", "single", (("mass",),), Hidden(added={"mass3": 0.2})),
    MACHINE.case("elbow_zero", "single", (("joint_offset",),), Hidden(added={"offset": 0.02}), Habits(stated=True)),
    MACHINE.case("late_elbow", "single", (("actuator_delay",),), Hidden(delay={"elbow_servo": 0.008})),
    MACHINE.case("soft_gear", "single", (("joint_compliance",),), Hidden(added={"compliance": 1.6e-3})),
    MACHINE.case("hose", "outside", (), Hidden(added={"hose": 12.0}), Habits(stated=True)),
)
