"""A hoist: a load on a vertical guide, wound up by a drum with a speed controller; a rangefinder reads its height."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, sines, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="hoist">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="load" pos="0 0 1">
      <inertial pos="0 0 0" mass="8" diaginertia="0.05 0.05 0.05"/>
      <joint name="guide" type="slide" axis="0 0 1" range="-0.8 0.8" armature="5" damping="30" frictionloss="9"/>
      <geom type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <general name="drum" joint="guide" gear="12.5" biastype="affine" gainprm="2" biasprm="6.2784 0 -2"/>
  </actuator>
  <sensor>
    <jointpos name="height" joint="guide"/>
    <jointvel name="speed" joint="guide"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the hoist."""

    mass: float = 8.0
    rotor: float = 5.0
    damping: float = 30.0
    friction: float = 9.0
    gear: float = 12.5
    feedback: float = 2.0
    holding: float = 6.2784
    """Torque by which the controller carries the nominal load [N m]."""
    warmth: float = 0.0
    """Share of the friction that is lost as the grease warms up, with 2 s."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:
    """Newton's law along the guide; the state is height and speed."""
    torque = p.feedback * (u[0] - p.gear * y[1]) + p.holding
    level = p.friction * (1 - p.warmth * (1 - np.exp(-max(t, 0.0) / 2)))
    dy[0] = y[1]
    dy[1] = (p.gear * torque - p.mass * 9.81 - p.damping * y[1] - coulomb(y[1], level)) / (p.mass + p.rotor)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return steps of the speed up and down, and sines."""
    t = clock(6.0, 100)
    fast = rng.uniform(4.5, 5.5)
    jumps = steps(t, [(0, 0), (0.4, fast), (1.4, 0), (2.0, -3), (3.2, 6), (3.9, -5), (5.2, 0)])
    mixed = sines(t, (3.0, 0.4, 0.0), (2.5, rng.uniform(1.0, 1.3), 0.5))
    return [Motion(6.0, {"drum": Held(t, np.round(c, 4))}) for c in (jumps, mixed)]


MACHINE = Machine(
    name="hoist",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("damping", "friction"),
    exact=("holding", "gear", "warmth"),
    derivative=derivative,
    rest=lambda p, u: np.zeros(2),  # noqa: ARG005
    actuators=("drum",),
    sensors=(
        Sensor("height", ("height",), 100, 8e-4, lambda y, p: y[:, :1], 5e-4),  # noqa: ARG005
        Sensor("speed", ("speed",), 100, 0.006, lambda y, p: y[:, 1:2]),  # noqa: ARG005
    ),
    motions=motions,
    settle=0.0,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case(
        "overload", "single", (("mass", "gravity_compensation", "joint_stiffness"),), Hidden(added={"mass": 0.4})
    ),
    MACHINE.case("late_drive", "single", (("actuator_delay", "latency"),), Hidden(delay={"drum": 0.04}), Habits(True)),
    MACHINE.case(
        "stiff_guide_and_rangefinder",
        "pair",
        (("joint_damping",), ("sensor_gain", "length_scale")),
        Hidden(added={"damping": 50.0}, gain={"height": 1.04}),
    ),
    MACHINE.case("warming_grease", "outside", (), Hidden(added={"warmth": 0.7}), Habits(stated=True)),
)
