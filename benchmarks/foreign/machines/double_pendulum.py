"""A double pendulum that swings freely after its release, seen by a camera that follows two markers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="double pendulum">
  <option timestep="0.001" integrator="RK4"/>
  <worldbody>
    <body name="upper" pos="0 0 0.9">
      <inertial pos="0 0 -0.16" mass="0.5" diaginertia="0.0042 0.0042 0.0001"/>
      <joint name="top" type="hinge" axis="0 -1 0" damping="0.006"/>
      <geom type="box" size="0.02 0.005 0.16" pos="0 0 -0.15" contype="0" conaffinity="0"/>
      <site name="knee" pos="0 0 -0.3"/>
      <body name="lower" pos="0 0 -0.3">
        <inertial pos="0 0 -0.12" mass="0.3" diaginertia="0.002 0.002 0.00006"/>
        <joint name="middle" type="hinge" axis="0 -1 0" damping="0.003"/>
        <geom type="box" size="0.02 0.005 0.13" pos="0 0 -0.12" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 -0.26"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <framepos name="knee" objtype="site" objname="knee"/>
    <framepos name="tip" objtype="site" objname="tip"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the pendulum."""

    mass1: float = 0.5
    centre1: float = 0.16
    length1: float = 0.3
    inertia1: float = 0.0042
    mass2: float = 0.3
    centre2: float = 0.12
    inertia2: float = 0.002
    tip: float = 0.26
    damping1: float = 0.006
    damping2: float = 0.003
    friction1: float = 0.0
    friction2: float = 0.0
    tilt: float = 0.0
    """Turn of the stand about the world's y axis, by which gravity has a part along x [rad]."""
    warming: float = 0.0
    """Dry friction at the top that grows to this within 5 s [N m]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Lagrange's equations; the state is angles and speeds, the lower angle against the upper link."""
    q1, q2, v1, v2 = y[0], y[1], y[2], y[3]
    moment = p.mass2 * p.centre2
    a = p.inertia1 + p.mass1 * p.centre1**2 + p.mass2 * p.length1**2
    b = p.inertia2 + moment * p.centre2
    c, h = p.length1 * moment * np.cos(q2), p.length1 * moment * np.sin(q2)
    weight2 = 9.81 * moment * np.sin(q1 + q2 - p.tilt)
    weight1 = 9.81 * (p.mass1 * p.centre1 + p.mass2 * p.length1) * np.sin(q1 - p.tilt) + weight2
    level1 = p.friction1 + p.warming * min(max(t, 0.0) / 5.0, 1.0)
    f1 = -p.damping1 * v1 - coulomb(v1, level1) - weight1 + h * (2 * v1 * v2 + v2**2)
    f2 = -p.damping2 * v2 - coulomb(v2, p.friction2) - weight2 - h * v1**2
    m11, m12 = a + b + 2 * c, b + c
    det = m11 * b - m12 * m12
    dy[0] = v1
    dy[1] = v2
    dy[2] = (b * f1 - m12 * f2) / det
    dy[3] = (m11 * f2 - m12 * f1) / det


def knee(y: np.ndarray, p: Values) -> np.ndarray:
    """Return positions of the upper marker in the world [m]."""
    return np.stack([p.length1 * np.sin(y[:, 0]), np.zeros(len(y)), 0.9 - p.length1 * np.cos(y[:, 0])], axis=1)


def tip(y: np.ndarray, p: Values) -> np.ndarray:
    """Return positions of the lower marker in the world [m]."""
    q = y[:, 0] + y[:, 1]
    return knee(y, p) + p.tip * np.stack([np.sin(q), np.zeros(len(y)), -np.cos(q)], axis=1)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return three releases from rest."""
    starts = [(0.6, -0.5), (-0.45, 0.9), (0.35, 0.2)]
    return [
        Motion(4.0, {}, np.array([a + rng.uniform(-0.05, 0.05), b + rng.uniform(-0.05, 0.05), 0, 0])) for a, b in starts
    ]


MACHINE = Machine(
    name="double_pendulum",
    model=MODEL,
    nominal=Values(),
    lengths=("length1", "tip"),
    loose=("damping1", "damping2", "friction1", "friction2"),
    exact=("tilt", "warming"),
    derivative=derivative,
    rest=lambda p, u: np.zeros(4),  # noqa: ARG005
    actuators=(),
    sensors=(Sensor("knee", ("x", "y", "z"), 120, 8e-4, knee), Sensor("tip", ("x", "y", "z"), 120, 8e-4, tip)),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(lost=0.02)),
    MACHINE.case("dry_bearing", "single", (("joint_friction",),), Hidden(added={"friction1": 0.012})),
    MACHINE.case("thick_grease", "single", (("joint_damping",),), Hidden(added={"damping1": 0.009}), Habits(True)),
    MACHINE.case("leaning_stand", "single", (("gravity_tilt", "frame_offset"),), Hidden(added={"tilt": 0.02})),
    MACHINE.case(
        "camera_clock",
        "single",
        (("time_base", "gravity_compensation"),),
        Hidden(clock={"knee": 0.025, "tip": 0.025}),
        Habits(True),
    ),
    MACHINE.case("warming_bearing", "outside", (), Hidden(added={"warming": 0.025}), Habits(True)),
)
