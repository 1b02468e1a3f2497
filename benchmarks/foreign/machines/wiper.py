"""An arm that turns about an upright axis presses a pad on a spring on a table and wipes; a force cell at the wrist.

Names that count: the spring's travel is read, so that a weak spring is not taken for a soft pad or table; the motor of
the yaw has play to the arm, whose encoder is at the arm; the cell reads all forces too large, in proportion.
The table slopes along the way of the pad, a length that no shape of the pad, which is round, stands for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="wiper">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default>
    <geom contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1" contype="1" conaffinity="1" friction="0.45"/>
    <body name="arm" pos="0 0 0.2">
      <inertial pos="0.12 0 0" mass="1.4" diaginertia="0.002 0.016 0.016"/>
      <joint name="yaw" type="hinge" axis="0 0 1" range="-1.2 1.2" armature="0.05" damping="0.3" frictionloss="0.25"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.025"/>
      <body name="ram" pos="0.32 0 -0.05">
        <inertial pos="0 0 0" mass="0.6" diaginertia="0.0005 0.0005 0.0003"/>
        <joint name="press" type="slide" axis="0 0 -1" range="-0.01 0.06" armature="1.5" damping="60" frictionloss="4"/>
        <geom type="cylinder" size="0.02 0.06"/>
        <body name="holder" pos="0 0 -0.07">
          <inertial pos="0 0 0" mass="0.18" diaginertia="0.00008 0.00008 0.00008"/>
          <geom type="cylinder" size="0.02 0.01"/>
          <site name="cell"/>
          <body name="pad" pos="0 0 -0.06">
            <inertial pos="0 0 0" mass="0.12" diaginertia="0.00003 0.00003 0.00003"/>
            <joint name="spring" type="slide" axis="0 0 -1" stiffness="900" damping="12"/>
            <geom name="pad" type="sphere" size="0.014" contype="1" conaffinity="1" friction="0.45" solref="0.01 1"
              solimp="0.01 0.95 0.0003"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="yaw_drive" joint="yaw" kp="260" kv="10" ctrlrange="-1.2 1.2"/>
    <position name="press_drive" joint="press" kp="22000" kv="450" ctrlrange="-0.01 0.06"/>
  </actuator>
  <sensor>
    <jointpos name="yaw_encoder" joint="yaw"/>
    <jointpos name="press_encoder" joint="press"/>
    <jointpos name="spring_travel" joint="spring"/>
    <force name="cell" site="cell"/>
  </sensor>
</mujoco>
"""

REACH = 0.32
"""From the arm's axis to the pad [m]."""
GAP = 0.006
"""From the pad to the table where the ram reads 0 and the spring is free [m]."""
CURRENT_LOOP = 2e-4
"""Time constant of the force of the ram's motor [s]."""


class Values(NamedTuple):
    """Values of the wiper; the pad moves down against the ram where the spring is stretched."""

    arm: float = 0.016 + 1.4 * 0.12**2 + 0.0003 + 0.00008 + 0.00003
    """Moment of the arm about its axis, with those of what it carries about their own [kg m^2]."""
    rotor: float = 0.05
    ram: float = 0.6
    screw: float = 1.5
    """Inertia of the ram's motor and screw, as a mass [kg]."""
    holder: float = 0.18
    pad: float = 0.12
    damping1: float = 0.3
    damping2: float = 60.0
    friction1: float = 0.25
    friction2: float = 4.0
    kp1: float = 260.0
    kv1: float = 10.0
    kp2: float = 22000.0
    kv2: float = 450.0
    spring: float = 900.0
    spring_damping: float = 12.0
    table: float = 4.0e4
    """Stiffness of the pad on the table [N/m]."""
    loss: float = 4.0
    """Damping of the contact by Hunt and Crossley [s/m]."""
    mu: float = 0.45
    gear: float = 2.5e4
    """Stiffness of the yaw's gear [N m/rad]."""
    gear_damping: float = 6.0
    play: float = 0.0
    """Play of the yaw's gear, from end to end [rad]."""
    slope: float = 0.0
    """Slope of the table along y, across the arm where it reads 0."""


@njit(cache=True)
def gear_torque(twist: float, rate: float, p: Values) -> float:
    """Return the torque of the gear on the arm [N m]; one with play pushes at the ends of it alone."""
    if p.play == 0.0:
        return p.gear * twist + p.gear_damping * rate
    if twist > 0.5 * p.play:
        return max(0.0, p.gear * (twist - 0.5 * p.play) + p.gear_damping * rate)
    if twist < -0.5 * p.play:
        return min(0.0, p.gear * (twist + 0.5 * p.play) + p.gear_damping * rate)
    return 0.0


@njit(cache=True)
def contact(y: np.ndarray, p: Values) -> tuple[float, float]:
    """Return the table's forces on the pad, up and along the way of the arm [N]."""
    angle, speed = y[0], y[4]
    rise = p.slope * REACH * np.sin(angle)
    steep = p.slope * np.cos(angle)
    depth = y[2] + y[3] - GAP + rise
    if depth <= 0.0:
        return 0.0, 0.0
    closing = y[6] + y[7] + steep * REACH * speed
    normal = max(0.0, p.table * depth * (1.0 + p.loss * closing))
    return normal, -p.mu * normal * np.tanh(REACH * speed / 2e-3) - steep * normal


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law; the state is arm, yaw's motor, ram, spring, their speeds, and the force of the ram's motor."""
    normal, along = contact(y, p)
    torque = gear_torque(y[1] - y[0], y[5] - y[4], p)
    moment = p.arm + (p.ram + p.holder + p.pad) * REACH**2
    dy[0], dy[1], dy[2], dy[3] = y[4], y[5], y[6], y[7]
    dy[4] = (torque + along * REACH) / moment
    motor = p.kp1 * (u[0] - y[1]) - (p.kv1 + p.damping1) * y[5] - coulomb(y[5], p.friction1)
    dy[5] = (motor - torque) / p.rotor
    held = p.spring * y[3] + p.spring_damping * y[7]
    weight = 9.81 * (p.ram + p.holder)
    push = y[8] - p.damping2 * y[6] - coulomb(y[6], p.friction2)
    dy[6] = (push + held + weight) / (p.ram + p.screw + p.holder)
    dy[7] = 9.81 - (held + normal) / p.pad - dy[6]
    dy[8] = (p.kp2 * (u[1] - y[2]) - p.kv2 * y[6] - y[8]) / CURRENT_LOOP


@njit(cache=True)
def _cell(states: np.ndarray, p: Values, out: np.ndarray) -> None:
    """Write the forces of the ram on the holder, outward, along the arm's way and up [N], shape (times, 3)."""
    dy, still = np.zeros(states.shape[1]), np.zeros(2)
    mass = p.holder + p.pad
    for k in range(len(states)):
        y = states[k]
        _, along = contact(y, p)
        derivative(0.0, y, still, p, dy)
        out[k, 0] = -mass * REACH * y[4] ** 2
        out[k, 1] = mass * REACH * dy[4] - along
        out[k, 2] = p.spring * y[3] + p.spring_damping * y[7] + p.holder * (9.81 - dy[6])


def cell(states: np.ndarray, p: Values) -> np.ndarray:
    """Return true readings of the force cell [N], shape (times, 3)."""
    out = np.zeros((len(states), 3))
    _cell(states, p, out)
    return out


DURATION = 4.0


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return slow wipes at three pressures, fast ones while the pressure sways, and dabs at some places."""
    t = clock(DURATION, 250)
    slow = {
        "yaw_drive": sines(t, (0.55, rng.uniform(0.48, 0.52), 0)),
        "press_drive": reach(t, [(0, 0.0), (0.2, 0.018), (1.4, 0.034), (2.7, 0.012)], 0.4),
    }
    fast = {
        "yaw_drive": sines(t, (0.4, rng.uniform(1.15, 1.25), 0.5), (0.12, 2.7, 0)),
        "press_drive": reach(t, [(0, 0.0), (0.2, 0.022)], 0.4) + 0.01 * sines(t, (1.0, rng.uniform(0.55, 0.6), 0)),
    }
    dabs = {
        "yaw_drive": reach(t, [(0, -0.6), (0.9, -0.2), (1.6, 0.3), (2.3, 0.65), (3.0, 0.0), (3.5, 0.25)], 0.45),
        "press_drive": reach(t, [(0, 0.0), (0.3, 0.028), (1.3, 0.002), (1.9, 0.036), (2.8, 0.02)], 0.3),
    }
    runs = (slow, fast, dabs)
    return [Motion(DURATION, {name: Held(t, np.round(c, 6)) for name, c in m.items()}) for m in runs]


def rest(p: Values, u: np.ndarray) -> np.ndarray:
    """Return the arm as commanded, with the pad in the air."""
    return np.array([u[0], u[0], u[1], 9.81 * p.pad / p.spring, 0.0, 0.0, 0.0, 0.0, 0.0])


MACHINE = Machine(
    name="wiper",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("damping1", "damping2", "friction1", "friction2", "spring_damping", "table", "loss", "gear", "gear_damping"),
    exact=("play", "slope"),
    derivative=derivative,
    rest=rest,
    actuators=("yaw_drive", "press_drive"),
    sensors=(
        Sensor("yaw_encoder", ("rad",), 500, 1e-4, lambda y, p: y[:, 0:1], 2 * np.pi / 32768),  # noqa: ARG005
        Sensor("press_encoder", ("m",), 500, 8e-6, lambda y, p: y[:, 2:3], 1e-5),  # noqa: ARG005
        Sensor("spring_travel", ("m",), 250, 6e-5, lambda y, p: y[:, 3:4]),  # noqa: ARG005
        Sensor("cell", ("x", "y", "z"), 250, 0.08, cell, 0.02),
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null"),
    MACHINE.case("damp_table", "single", (("sliding_friction",),), Hidden(factors={"mu": 0.75}), Habits(stated=True)),
    MACHINE.case("gear_play", "single", (("backlash",),), Hidden(added={"play": 0.006}), Habits(lost=0.01)),
    MACHINE.case("tired_spring", "single", (("joint_stiffness",),), Hidden(factors={"spring": 0.85})),
    MACHINE.case("cell_scale", "single", (("sensor_gain",),), Hidden(gain={"cell": 1.1}), Habits(stated=True)),
    MACHINE.case("sloping_table", "outside", (), Hidden(added={"slope": 0.012}), Habits(stated=True)),
)
