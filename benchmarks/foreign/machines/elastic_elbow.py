"""An exoskeleton's elbow with a spring between motor and forearm, an encoder at the drum and a torque sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, stribeck
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, chirp, clock, reach, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="elastic elbow">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <default>
    <geom type="capsule" contype="0" conaffinity="0"/>
    <joint type="hinge" axis="0 -1 0"/>
  </default>
  <worldbody>
    <body name="drum" pos="0 0 1.1">
      <inertial pos="0 0 0" mass="0.3" diaginertia="0.0003 0.0004 0.0003"/>
      <joint name="motor" armature="0.08" damping="0.9" frictionloss="0.5"/>
      <geom fromto="0 -0.02 0 0 0.02 0" size="0.04"/>
      <body name="forearm">
        <inertial pos="0.12 0 0" mass="0.9" diaginertia="0.0008 0.006 0.006"/>
        <joint name="spring" stiffness="50" damping="0.15"/>
        <geom fromto="0.03 0 0 0.25 0 0" size="0.03"/>
        <site name="cell"/>
        <body name="hand" pos="0.28 0 0">
          <inertial pos="0.04 0 0" mass="0.4" diaginertia="0.0003 0.0004 0.0004"/>
          <geom fromto="0 0 0 0.08 0 0" size="0.03"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="motor" kp="120" kv="6"/></actuator>
  <sensor>
    <jointpos name="drum_angle" joint="motor"/>
    <torque name="cell" site="cell"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the elbow."""

    forearm: float = 0.9
    forearm_centre: float = 0.12
    forearm_inertia: float = 0.006
    hand: float = 0.4
    hand_centre: float = 0.32
    hand_inertia: float = 0.0004
    rotor: float = 0.0804
    """Inertia of rotor, gears and drum at the drum [kg m^2]."""
    damping: float = 0.9
    friction: float = 0.5
    stiffness: float = 50.0
    spring_damping: float = 0.15
    kp: float = 120.0
    kv: float = 6.0
    clutch: float = 1e3
    """Torque at which the clutch between motor and drum slips [N m]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law; the state is angle of the drum, turn of the spring, their rates, and how far the clutch slipped.

    The motor turns by y[0] + y[4]. While the clutch slips, at a torque that stays, its servo carries that torque.
    """
    inertia = p.forearm_inertia + p.forearm * p.forearm_centre**2 + p.hand_inertia + p.hand * p.hand_centre**2
    weight = 9.81 * (p.forearm * p.forearm_centre + p.hand * p.hand_centre) * np.cos(y[0] + y[1])
    spring = p.stiffness * y[1] + p.spring_damping * y[3]
    servo = p.kp * (u[0] - y[0] - y[4]) - p.kv * y[2]
    carried = min(max(servo, -p.clutch), p.clutch)
    dy[0] = y[2]
    dy[1] = y[3]
    dy[2] = (carried - p.damping * y[2] - stribeck(y[2], p.friction, 0.01, 0.05) + spring) / p.rotor
    dy[3] = (-spring - weight) / inertia - dy[2]
    dy[4] = (servo - carried) / p.kv


def cell(y: np.ndarray, p: Values) -> np.ndarray:
    """Return the torque that the drum has from the forearm about x, y and z of the forearm [N m]."""
    about = p.stiffness * y[:, 1] + p.spring_damping * y[:, 3]
    return np.stack([np.zeros(len(y)), about, np.zeros(len(y))], axis=1)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return lifts of the forearm, steps, and a chirp."""
    t = clock(5.0, 200)
    high = rng.uniform(0.7, 0.8)
    lifts = reach(t, [(0, -1.2), (0.4, high), (2.2, -0.7), (3.5, 0.3)], 0.9)
    jumps = steps(t, [(0, -0.5), (0.4, -0.2), (1.4, 0.3), (2.4, 0.0), (3.2, -0.6), (4.2, -0.4)])
    swing = -0.6 + chirp(t, 0.3, 0.3, rng.uniform(2.8, 3.2))
    return [Motion(5.0, {"drive": Held(t, np.round(c, 5))}) for c in (lifts, jumps, swing)]


MACHINE = Machine(
    name="elastic_elbow",
    model=MODEL,
    nominal=Values(),
    lengths=("forearm_centre", "hand_centre"),
    loose=("damping", "friction", "spring_damping"),
    exact=("clutch",),
    derivative=derivative,
    rest=lambda p, u: np.array([u[0], 0, 0, 0, 0]),  # noqa: ARG005
    actuators=("drive",),
    sensors=(
        Sensor("drum_angle", ("angle",), 500, 4e-4, lambda y, p: y[:, :1], 8e-4),  # noqa: ARG005
        Sensor("cell", ("x", "y", "z"), 500, 0.02, cell),
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case(
        "stiff_spring", "single", (("joint_stiffness",),), Hidden(factors={"stiffness": 1.2}), Habits(stated=True)
    ),
    MACHINE.case(
        "weight_in_hand", "single", (("mass",),), Hidden(factors={"hand": 1.6, "hand_inertia": 1.6}), Habits(lost=0.01)
    ),
    MACHINE.case("slow_drive", "single", (("actuator_lag",),), Hidden(lag={"drive": 0.015})),
    MACHINE.case(
        "weight_and_grease",
        "pair",
        (("mass",), ("joint_damping",)),
        Hidden(factors={"hand": 1.6, "hand_inertia": 1.6}, added={"damping": 1.2}),
        Habits(stated=True),
    ),
    MACHINE.case("slipping_clutch", "outside", (), Hidden(factors={"clutch": 7e-3}), Habits(stated=True)),
)
