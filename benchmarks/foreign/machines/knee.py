"""An exoskeleton's knee on a test stand, with an impedance controller, a shank that hangs, and a soft stop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, stribeck
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="exoskeleton knee">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="shank" pos="0 0 0.7">
      <inertial pos="0.02 0 -0.19" mass="1.9" diaginertia="0.03 0.031 0.003"/>
      <joint name="knee" type="hinge" axis="0 1 0" range="-0.05 2" armature="0.09" damping="0.5" frictionloss="0.35"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <general name="impedance" joint="knee" biastype="affine" gainprm="18" biasprm="0 -18 -1.2"/>
    <motor name="feedforward" joint="knee" gear="1"/>
  </actuator>
  <sensor>
    <jointpos name="knee_angle" joint="knee"/>
    <jointvel name="knee_speed" joint="knee"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the knee."""

    mass: float = 1.9
    below: float = 0.19
    ahead: float = 0.02
    inertia: float = 0.031
    rotor: float = 0.09
    damping: float = 0.5
    friction: float = 0.35
    stiffness: float = 18.0
    feedback: float = 1.2
    forward: float = 1.0
    brace: float = 0.0
    """Stiffness of a brace that rests at 0.9 rad [N m/rad]."""
    stop: float = 2.0
    """Angle at which an elastic stop begins [rad]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law about the knee; the state is angle and speed. Turned by q, the shank's foot goes back."""
    weight = p.mass * 9.81 * (p.below * np.sin(y[0]) - p.ahead * np.cos(y[0]))
    torque = p.stiffness * (u[0] - y[0]) - p.feedback * y[1] + p.forward * u[1] - weight - p.damping * y[1]
    torque -= stribeck(y[1], p.friction, 0.02, 0.05) + p.brace * (y[0] - 0.9)
    torque -= max(150.0 * (y[0] - p.stop) * (1 + 0.3 * y[1]), 0.0) if y[0] > p.stop else 0.0
    dy[0] = y[1]
    dy[1] = torque / (p.inertia + p.mass * (p.below**2 + p.ahead**2) + p.rotor)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return strides, and pulses of torque about a held angle."""
    t = clock(6.0, 250)
    angle = 0.7 + sines(t, (0.45, rng.uniform(0.6, 0.7), 0), (0.2, 1.3, 0.6))
    strides = {"impedance": angle, "feedforward": 2.5 * np.ones(len(t))}
    pulses = steps(t, [(0, 2), (0.5, 6), (0.9, 0), (1.5, 2), (2.2, 8), (2.5, -2), (2.8, 2), (4.2, 5), (5.0, 1)])
    held = {"impedance": reach(t, [(0, 0.6), (2.9, 1.0)], 1.0), "feedforward": pulses}
    return [Motion(6.0, {name: Held(t, np.round(c, 5)) for name, c in m.items()}) for m in (strides, held)]


MACHINE = Machine(
    name="knee",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("damping", "friction"),
    exact=("brace", "stop"),
    derivative=derivative,
    rest=lambda p, u: np.array([0.5 * u[0] + 0.2, 0.0]),  # noqa: ARG005
    actuators=("impedance", "feedforward"),
    sensors=(
        Sensor("knee_angle", ("angle",), 250, 7e-4, lambda y, p: y[:, :1], 1.5e-3),  # noqa: ARG005
        Sensor("knee_speed", ("speed",), 250, 0.03, lambda y, p: y[:, 1:2]),  # noqa: ARG005
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(lost=0.01)),
    MACHINE.case(
        "slow_amplifier",
        "single",
        (("actuator_lag",),),
        Hidden(lag={"impedance": 0.015, "feedforward": 0.015}),
        Habits(stated=True),
    ),
    MACHINE.case("brace", "single", (("joint_stiffness",),), Hidden(added={"brace": 0.8})),
    MACHINE.case(
        "boot_and_friction",
        "pair",
        (("armature", "inertia"), ("joint_friction",)),
        Hidden(added={"rotor": 0.04, "friction": 0.2}),
        Habits(stated=True),
    ),
    MACHINE.case("stop_in_the_way", "outside", (), Hidden(added={"stop": -0.85}), Habits(stated=True)),
)
