"""A leg with one drive hops on a vertical rail; encoders read the height of the carriage and the length of the leg."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="hopping leg">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="carriage" pos="0 0 0.475">
      <joint name="rail" type="slide" axis="0 0 1" range="-0.2 0.5" damping="3" frictionloss="2"/>
      <geom type="box" size="0.06 0.05 0.08" mass="2.4" contype="0" conaffinity="0"/>
      <body name="shank" pos="0 0 -0.25">
        <joint name="leg" type="slide" axis="0 0 -1" range="-0.15 0.1" damping="10" armature="0.2"/>
        <geom type="capsule" fromto="0 0 0.1 0 0 -0.17" size="0.01" mass="0.3" contype="0" conaffinity="0"/>
        <geom name="foot" type="sphere" pos="0 0 -0.2" size="0.025" mass="0.08" solref="0.004 1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="leg" joint="leg" kp="5000" kv="110"/></actuator>
  <sensor>
    <jointpos name="rail_height" joint="rail"/>
    <jointpos name="leg_encoder" joint="leg"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of leg, rail and floor."""

    carriage: float = 2.4
    shank: float = 0.38
    rotor: float = 0.2
    rail_damping: float = 3.0
    rail_friction: float = 2.0
    leg_damping: float = 10.0
    kp: float = 5000.0
    kv: float = 110.0
    stiffness: float = 2.5e5
    """Stiffness of foot and floor [N/m]."""
    shake: float = 0.0
    """Amplitude of a floor that a machine nearby shakes at 3 Hz [m]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:
    """Newton's law of carriage and shank; the state is height of the one, length of the leg, and their speeds."""
    pace = 2 * np.pi * 3.0
    depth = p.shake * np.sin(pace * t) - y[0] + y[1]
    press = 0.0
    if depth > 0.0:
        closing = p.shake * pace * np.cos(pace * t) - y[2] + y[3]
        press = max(0.0, p.stiffness * depth * (1.0 + 8.0 * closing))
    drive = p.kp * (u[0] - y[1]) - (p.kv + p.leg_damping) * y[3]
    whole = p.carriage + p.shank
    up = press - 9.81 * whole - p.rail_damping * y[2] - coulomb(y[2], p.rail_friction)
    out = drive + 9.81 * p.shank - press
    # Inertia: [[whole, -shank], [-shank, shank + rotor]] in height of the carriage and length of the leg.
    own = p.shank + p.rotor
    det = whole * own - p.shank**2
    dy[0], dy[1] = y[2], y[3]
    dy[2] = (own * up + p.shank * out) / det
    dy[3] = (p.shank * up + whole * out) / det


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return hops of several heights, and squats with small hops between them."""
    t = clock(4.0, 250)
    hops = np.zeros(len(t))
    for start in (0.3, 1.2, 2.1, 3.0):
        thrust = rng.uniform(0.02, 0.04)
        hops += reach(t, [(0, 0), (start, -0.07)], 0.3) + reach(t, [(0, 0), (start + 0.35, 0.07 + thrust)], 0.14)
        hops += reach(t, [(0, 0), (start + 0.52, -thrust)], 0.15)
    squats = reach(t, [(0, 0), (0.2, -0.08), (0.9, 0.02), (1.5, -0.05), (2.0, 0.03)], 0.4)
    squats += reach(t, [(0, 0), (2.7, -0.08), (3.1, 0.0)], 0.12)
    return [Motion(4.0, {"leg": Held(t, np.round(c, 5))}) for c in (hops, squats)]


MACHINE = Machine(
    name="hopping_leg",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("rail_damping", "rail_friction", "leg_damping"),
    exact=("stiffness", "shake"),
    derivative=derivative,
    rest=lambda p, u: np.array([u[0], u[0], 0.0, 0.0]),  # noqa: ARG005
    actuators=("leg",),
    sensors=(
        Sensor("rail_height", ("height",), 200, 2e-4, lambda y, p: y[:, :1], 1e-4),  # noqa: ARG005
        Sensor("leg_encoder", ("length",), 500, 1e-4, lambda y, p: y[:, 1:2], 1e-4),  # noqa: ARG005
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("nothing", "null"),
    MACHINE.case("payload", "single", (("mass",),), Hidden(factors={"carriage": 1.18}), Habits(stated=True)),
    MACHINE.case("dry_rail", "single", (("joint_friction",),), Hidden(added={"rail_friction": 5.0})),
    MACHINE.case(
        "slow_bus", "single", (("actuator_delay",),), Hidden(delay={"leg": 0.01}), Habits(stated=True, lost=0.01)
    ),
    MACHINE.case("shaken_floor", "outside", (), Hidden(added={"shake": 0.004})),
)
