"""A cart on a rail, pulled by a belt, with a pole that hangs from it; encoders of cart and pole."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, sines, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="cart and pole">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="cart" pos="0 0 0.6">
      <inertial pos="0 0 0" mass="0.95" diaginertia="0.002 0.002 0.002"/>
      <joint name="rail" type="slide" axis="1 0 0" range="-0.8 0.8" armature="0.25" damping="5" frictionloss="1.2"/>
      <geom type="box" size="0.06 0.04 0.03" contype="0" conaffinity="0"/>
      <body name="pole">
        <inertial pos="0 0 -0.22" mass="0.18" diaginertia="0.0031 0.0031 0.00002"/>
        <joint name="pivot" type="hinge" axis="0 -1 0" damping="0.009" frictionloss="0.0008"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.44" size="0.006" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="belt" joint="rail" gear="40" ctrlrange="-0.4 0.4"/></actuator>
  <sensor>
    <jointpos name="cart" joint="rail"/>
    <jointpos name="pole" joint="pivot"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of cart and pole."""

    cart: float = 0.95
    rotor: float = 0.25
    pole: float = 0.18
    centre: float = 0.22
    inertia: float = 0.0031
    damping: float = 5.0
    friction: float = 1.2
    pivot_damping: float = 0.009
    pivot_friction: float = 0.0008
    gear: float = 40.0
    tilt: float = 0.0
    """How far the end of the rail at positive x is lower than level [rad]."""
    limit: float = 1e3
    """Largest force of the motor [N]."""
    sag: float = 0.0
    """Share of the force that is lost per 10 s, as the battery empties."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:
    """Lagrange's equations; the state is position, angle, and their rates."""
    sin, cos = np.sin(y[1]), np.cos(y[1])
    along, down = 9.81 * np.sin(p.tilt), 9.81 * np.cos(p.tilt)
    force = min(max(p.gear * u[0] * (1 - p.sag * max(t, 0.0) / 10), -p.limit), p.limit)
    force += -p.damping * y[2] - coulomb(y[2], p.friction)
    arm = p.pole * p.centre
    m11, m12, m22 = p.cart + p.rotor + p.pole, arm * cos, p.inertia + arm * p.centre
    f1 = force + arm * sin * y[3] ** 2 + (p.cart + p.pole) * along
    f2 = arm * (cos * along - sin * down) - p.pivot_damping * y[3] - coulomb(y[3], p.pivot_friction)
    det = m11 * m22 - m12 * m12
    dy[0] = y[2]
    dy[1] = y[3]
    dy[2] = (m22 * f1 - m12 * f2) / det
    dy[3] = (m11 * f2 - m12 * f1) / det


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a motion with sines and one with steps of the torque."""
    t = clock(6.0, 200)
    slow = sines(t, (0.1, 0.5 * rng.uniform(0.9, 1.1), 1.2), (0.08, 1.7 * rng.uniform(0.95, 1.05), 0))
    pushes = [(0, 0), (0.5, 0.1), (0.9, -0.12), (1.8, 0.08), (2.3, 0), (3.0, 0.13), (3.3, -0.08), (4.2, 0)]
    jumps = steps(t, pushes)
    return [Motion(6.0, {"belt": Held(t, np.round(slow, 5))}), Motion(6.0, {"belt": Held(t, jumps)})]


MACHINE = Machine(
    name="cart_pole",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("damping", "friction", "pivot_damping", "pivot_friction"),
    exact=("tilt", "limit", "sag"),
    derivative=derivative,
    rest=lambda p, u: np.zeros(4),  # noqa: ARG005
    actuators=("belt",),
    sensors=(
        Sensor("cart", ("position",), 250, 4e-4, lambda y, p: y[:, :1], 2e-4),  # noqa: ARG005
        Sensor("pole", ("angle",), 250, 1e-3, lambda y, p: y[:, 1:2], 1.5e-3),  # noqa: ARG005
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(jitter=2e-4)),
    MACHINE.case("dry_bearing", "single", (("joint_friction",),), Hidden(added={"friction": 0.18})),
    MACHINE.case("sloping_rail", "single", (("gravity_tilt",),), Hidden(added={"tilt": 0.003}), Habits(stated=True)),
    MACHINE.case(
        "weak_supply", "single", (("actuator_saturation",),), Hidden(factors={"limit": 5.4e-3}), Habits(lost=0.01)
    ),
    MACHINE.case(
        "friction_and_pole_zero",
        "pair",
        (("joint_friction",), ("sensor_bias", "joint_offset")),
        Hidden(added={"friction": 0.18}, bias={"pole": 0.012}),
        Habits(stated=True),
    ),
    MACHINE.case("emptying_battery", "outside", (), Hidden(added={"sag": 0.16}), Habits(stated=True)),
)
