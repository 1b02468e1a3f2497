"""A turntable behind a gearbox of 20 to 1, with a speed controller of the motor, an encoder and a tachometer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, stribeck
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, sines, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="turntable">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="table" pos="0 0 0.2">
      <inertial pos="0 0 0" mass="12" diaginertia="0.18 0.18 0.35"/>
      <joint name="turn" type="hinge" axis="0 0 1" armature="0.08" damping="0.3" frictionloss="0.7"/>
      <geom type="cylinder" size="0.24 0.012" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><velocity name="drive" joint="turn" gear="20" kv="0.012"/></actuator>
  <sensor>
    <jointpos name="angle" joint="turn"/>
    <jointvel name="tachometer" joint="turn"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the turntable."""

    inertia: float = 0.35
    rotor: float = 0.08
    damping: float = 0.3
    friction: float = 0.7
    kv: float = 0.012
    gear: float = 20.0
    extra: float = 0.0
    """Friction out of rest, beyond the level [N m]."""
    fades: float = 0.15
    """Speed over which it fades [rad/s]."""
    eccentric: float = 0.0
    """Share by which the ratio of the gear varies in a turn of the table."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law about the axle; the state is angle and speed."""
    ratio = p.gear * (1 + p.eccentric * np.sin(y[0] + 0.4))
    torque = ratio * p.kv * (u[0] - ratio * y[1])
    torque -= p.damping * y[1] + stribeck(y[1], p.friction, p.extra, p.fades)
    dy[0] = y[1]
    dy[1] = torque / (p.inertia + p.rotor)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a motion with steps of the speed, one with slow reversals, and one with sines."""
    t = clock(5.0, 100)
    level = rng.uniform(28, 34)
    jumps = steps(t, [(0, 0), (0.3, level), (1.2, -level), (2.1, 12), (2.8, 45), (3.5, -25), (4.4, 0)])
    slow = sines(t, (9.0, 0.45, 0.0))
    mixed = sines(t, (18.0, 0.4, 0.0), (22.0, rng.uniform(1.1, 1.4), 0.7))
    return [Motion(5.0, {"drive": Held(t, np.round(c, 4))}) for c in (jumps, slow, mixed)]


MACHINE = Machine(
    name="turntable",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("damping", "friction"),
    exact=("gear", "extra", "fades", "eccentric"),
    derivative=derivative,
    rest=lambda p, u: np.zeros(2),  # noqa: ARG005
    actuators=("drive",),
    sensors=(
        Sensor("angle", ("angle",), 200, 1e-3, lambda y, p: y[:, :1], 2e-3),  # noqa: ARG005
        Sensor("tachometer", ("speed",), 200, 0.012, lambda y, p: y[:, 1:2]),  # noqa: ARG005
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case("workpiece", "single", (("inertia", "mass", "armature"),), Hidden(added={"inertia": 0.1})),
    MACHINE.case("sticking_axle", "single", (("stribeck_friction",),), Hidden(added={"extra": 0.5})),
    MACHINE.case(
        "tachometer_scale", "single", (("sensor_gain",),), Hidden(gain={"tachometer": 1.05}), Habits(stated=True)
    ),
    MACHINE.case("eccentric_gear", "outside", (), Hidden(added={"eccentric": 0.05}), Habits(stated=True, lost=0.01)),
)
