"""A leg of a running robot on a stand: hip and knee by torque, coarse encoders, speeds that the drives estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, stribeck
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, sines, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="leg on a stand">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <default>
    <geom type="capsule" size="0.025" contype="0" conaffinity="0"/>
    <joint type="hinge" axis="0 -1 0"/>
  </default>
  <worldbody>
    <body name="thigh" pos="0 0 0.8">
      <inertial pos="0 0 -0.07" mass="1.6" diaginertia="0.009 0.009 0.0015"/>
      <joint name="hip" armature="0.03" damping="0.2" frictionloss="0.2"/>
      <geom fromto="0 0 0 0 0 -0.25"/>
      <body name="shank" pos="0 0 -0.25">
        <inertial pos="0 0 -0.11" mass="0.45" diaginertia="0.0024 0.0024 0.0002"/>
        <joint name="knee" armature="0.018" damping="0.08" frictionloss="0.09"/>
        <geom fromto="0 0 0 0 0 -0.24"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="hip_drive" joint="hip" gear="1.1" ctrlrange="-20 20"/>
    <motor name="knee_drive" joint="knee" gear="1.1" ctrlrange="-20 20"/>
  </actuator>
  <sensor>
    <jointpos name="hip_position" joint="hip"/>
    <jointpos name="knee_position" joint="knee"/>
    <jointvel name="hip_velocity" joint="hip"/>
    <jointvel name="knee_velocity" joint="knee"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the leg: 1 is the thigh and the hip, 2 the shank and the knee."""

    mass1: float = 1.6
    centre1: float = 0.07
    length1: float = 0.25
    inertia1: float = 0.009
    mass2: float = 0.45
    centre2: float = 0.11
    inertia2: float = 0.0024
    rotor1: float = 0.03
    rotor2: float = 0.018
    damping1: float = 0.2
    damping2: float = 0.08
    friction1: float = 0.2
    friction2: float = 0.09
    gain1: float = 1.1
    gain2: float = 1.1
    breakaway: float = 0.0
    """By how much the knee's friction is larger out of rest [N m]."""
    cables: float = 0.0
    """Stiffness of the cables along the knee, which rest at -0.5 rad [N m/rad]."""
    crosstalk: float = 0.0
    """Share of the knee's current that the hip's drive adds to its own."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Lagrange's equations; the state is angles and speeds, that of the knee against the thigh."""
    q1, q2, v1, v2 = y[0], y[1], y[2], y[3]
    moment = p.mass2 * p.centre2
    a = p.inertia1 + p.mass1 * p.centre1**2 + p.mass2 * p.length1**2
    b = p.inertia2 + moment * p.centre2
    c, h = p.length1 * moment * np.cos(q2), p.length1 * moment * np.sin(q2)
    weight2 = 9.81 * moment * np.sin(q1 + q2)
    weight1 = 9.81 * (p.mass1 * p.centre1 + p.mass2 * p.length1) * np.sin(q1) + weight2
    drive1 = p.gain1 * (u[0] + p.crosstalk * u[1])
    drive2 = p.gain2 * u[1] - p.cables * (q2 + 0.5)
    f1 = drive1 - p.damping1 * v1 - stribeck(v1, p.friction1, 0.004, 0.1) - weight1 + h * (2 * v1 * v2 + v2**2)
    f2 = drive2 - p.damping2 * v2 - stribeck(v2, p.friction2, p.breakaway, 0.4) - weight2 - h * v1**2
    m11, m12, m22 = a + b + 2 * c + p.rotor1, b + c, b + p.rotor2
    det = m11 * m22 - m12 * m12
    dy[0] = v1
    dy[1] = v2
    dy[2] = (m22 * f1 - m12 * f2) / det
    dy[3] = (m11 * f2 - m12 * f1) / det


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a swing by sines, one by steps of the torque, and one after the release of the lifted leg."""
    t = clock(3.5, 200)
    swing = {
        "hip_drive": sines(t, (0.7, rng.uniform(0.75, 0.85), 0), (0.5, 2.3, 0.4)),
        "knee_drive": -0.1 + sines(t, (0.3, rng.uniform(1.4, 1.6), 0.5), (0.2, 0.5, 0)),
    }
    jumps = {
        "hip_drive": steps(t, [(0, 0), (0.4, 1.1), (0.9, -0.6), (1.3, 0), (2.1, 0.9), (2.8, -1.0), (3.3, 0.4)]),
        "knee_drive": steps(t, [(0, 0), (0.7, -0.4), (1.5, 0.1), (2.0, -0.25), (2.6, -0.45), (3.2, 0)]),
    }
    free = {"hip_drive": np.zeros(len(t)), "knee_drive": np.zeros(len(t))}
    lifted = np.array([rng.uniform(1.0, 1.1), -1.3, 0.0, 0.0])
    starts = (None, None, lifted)
    return [
        Motion(3.5, {name: Held(t, np.round(c, 4)) for name, c in m.items()}, start)
        for m, start in zip((swing, jumps, free), starts, strict=True)
    ]


def drive(name: str, joint: int) -> tuple[Sensor, Sensor]:
    """Return what the drive of a joint reports: its angle, of 2048 counts a turn, and the speed that it estimates."""
    position = Sensor(f"{name}_position", ("rad",), 500, 3e-4, lambda y, p: y[:, joint : joint + 1], 2 * np.pi / 2048)  # noqa: ARG005
    speed = Sensor(f"{name}_velocity", ("rad_s",), 500, 0.04, lambda y, p: y[:, joint + 2 : joint + 3])  # noqa: ARG005
    return position, speed


MACHINE = Machine(
    name="leg",
    model=MODEL,
    nominal=Values(),
    lengths=("length1", "centre1", "centre2"),
    loose=("damping1", "damping2", "friction1", "friction2"),
    exact=("breakaway", "cables", "crosstalk"),
    derivative=derivative,
    rest=lambda p, u: np.zeros(4),  # noqa: ARG005
    actuators=("hip_drive", "knee_drive"),
    sensors=(*drive("hip", 0), *drive("knee", 1)),
    motions=motions,
    settle=4.0,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case("strong_hip", "single", (("actuator_gain",),), Hidden(factors={"gain1": 1.12}), Habits(stated=True)),
    MACHINE.case("sticky_knee", "single", (("stribeck_friction",),), Hidden(added={"breakaway": 0.12})),
    MACHINE.case("knee_cables", "single", (("joint_stiffness",),), Hidden(added={"cables": 0.1}), Habits(lost=0.01)),
    MACHINE.case(
        "knee_rotor_and_zero",
        "pair",
        (("armature",), ("sensor_bias", "joint_offset")),
        Hidden(added={"rotor2": 0.006}, bias={"knee_position": 0.03}),
        Habits(stated=True),
    ),
    MACHINE.case("crosstalk", "outside", (), Hidden(added={"crosstalk": 0.25}), Habits(stated=True)),
)
