"""A pendulum with a flywheel at its end, whose motor is driven by voltage; a coarse encoder and a tachometer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, chirp, clock, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="reaction wheel pendulum">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="rod" pos="0 0 0.4">
      <inertial pos="0 0 -0.13" mass="0.4" diaginertia="0.0022 0.0022 0.00005"/>
      <joint name="pivot" type="hinge" axis="0 -1 0" damping="0.003" frictionloss="0.004"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.008" contype="0" conaffinity="0"/>
      <body name="wheel" pos="0 0 -0.2">
        <inertial pos="0 0 0" mass="0.28" diaginertia="0.0002 0.0004 0.0002"/>
        <joint name="spin" type="hinge" axis="0 -1 0" armature="0.00002" damping="0.00005" frictionloss="0.003"/>
        <geom type="cylinder" fromto="0 -0.01 0 0 0.01 0" size="0.06" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="voltage" joint="spin" biastype="affine" gainprm="0.034" biasprm="0 0 -0.0012" ctrlrange="-12 12"/>
  </actuator>
  <sensor>
    <jointpos name="rod_angle" joint="pivot"/>
    <jointvel name="wheel_speed" joint="spin"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the rig."""

    rod: float = 0.4
    centre: float = 0.13
    inertia: float = 0.0022
    wheel: float = 0.28
    length: float = 0.2
    wheel_inertia: float = 0.0004
    rotor: float = 0.00002
    damping: float = 0.003
    friction: float = 0.004
    spin_damping: float = 0.00005
    spin_friction: float = 0.003
    torque_per_volt: float = 0.034
    back_emf: float = 0.0012
    """Torque that is lost per speed, as the turning motor generates a voltage [N m s/rad]."""
    limit: float = 1e3
    """Torque of the motor at the largest current of its amplifier [N m]."""
    shaking: float = 0.0
    """Acceleration of the bench along x, 1.7 times a second [m/s^2]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:
    """Lagrange's equations; the state is angle and speed of the rod, and speed of the wheel against it."""
    along = p.rod * p.centre + p.wheel * p.length
    motor = min(max(p.torque_per_volt * u[0] - p.back_emf * y[2], -p.limit), p.limit)
    f2 = motor - p.spin_damping * y[2] - coulomb(y[2], p.spin_friction)
    bench = p.shaking * np.sin(2 * np.pi * 1.7 * t)
    f1 = -along * (9.81 * np.sin(y[0]) + bench * np.cos(y[0])) - p.damping * y[1] - coulomb(y[1], p.friction)
    m11 = p.inertia + p.rod * p.centre**2 + p.wheel * p.length**2 + p.wheel_inertia
    m12, m22 = p.wheel_inertia, p.wheel_inertia + p.rotor
    det = m11 * m22 - m12 * m12
    dy[0] = y[1]
    dy[1] = (m22 * f1 - m12 * f2) / det
    dy[2] = (m11 * f2 - m12 * f1) / det


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return steps of the voltage, and a chirp through the pendulum's own frequency."""
    t = clock(8.0, 100)
    high = rng.uniform(8, 9)
    jumps = steps(t, [(0, 0), (0.5, high), (1.6, -9), (2.9, 4), (4.0, 11), (5.2, 0), (6.4, -6), (7.2, 3)])
    return [Motion(8.0, {"voltage": Held(t, np.round(c, 3))}) for c in (jumps, chirp(t, 5.0, 0.3, 2.5))]


MACHINE = Machine(
    name="reaction_wheel",
    model=MODEL,
    nominal=Values(),
    lengths=("length", "centre"),
    loose=("damping", "friction", "spin_damping", "spin_friction"),
    exact=("limit", "shaking"),
    derivative=derivative,
    rest=lambda p, u: np.zeros(3),  # noqa: ARG005
    actuators=("voltage",),
    sensors=(
        Sensor("rod_angle", ("angle",), 200, 5e-4, lambda y, p: y[:, :1], 2 * np.pi / 1000),  # noqa: ARG005
        Sensor("wheel_speed", ("speed",), 100, 0.6, lambda y, p: y[:, 2:3]),  # noqa: ARG005
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(lost=0.01)),
    MACHINE.case("dirty_pivot", "single", (("joint_friction",),), Hidden(added={"friction": 0.012})),
    MACHINE.case(
        "heavier_rim",
        "single",
        (("inertia", "armature"),),
        Hidden(factors={"wheel_inertia": 1.15}),
        Habits(stated=True),
    ),
    MACHINE.case(
        "current_limit", "single", (("actuator_saturation",),), Hidden(factors={"limit": 2.2e-4}), Habits(stated=True)
    ),
    MACHINE.case(
        "oil_and_tachometer",
        "pair",
        (("joint_damping",), ("sensor_gain",)),
        Hidden(added={"damping": 0.005}, gain={"wheel_speed": 1.05}),
        Habits(stated=True),
    ),
    MACHINE.case("shaking_bench", "outside", (), Hidden(added={"shaking": 0.5})),
)
