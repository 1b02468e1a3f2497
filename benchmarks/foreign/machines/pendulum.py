"""A pendulum on the shaft of a torque motor, with an encoder of 4096 counts a turn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, lugre
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, sines
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="pendulum test bench">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="rod" pos="0 0 0.5">
      <inertial pos="0 0 -0.21" mass="0.42" diaginertia="0.0075 0.0075 0.0002"/>
      <joint name="shaft" type="hinge" axis="0 1 0" armature="0.0012" damping="0.03" frictionloss="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.01" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="shaft" ctrlrange="-2 2"/></actuator>
  <sensor><jointpos name="shaft_angle" joint="shaft"/></sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the pendulum."""

    mass: float = 0.42
    reach: float = 0.21
    inertia: float = 0.0075
    rotor: float = 0.0012
    damping: float = 0.03
    friction: float = 0.02
    gain: float = 1.0
    cogging: float = 0.0
    """Amplitude of the cogging torque [N m]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law about the shaft; the state is angle, speed, bristle."""
    drag, dy[2] = lugre(y[2], y[1], p.friction, p.friction / 2e-4, 0.02)
    torque = p.gain * u[0] - p.mass * 9.81 * p.reach * np.sin(y[0]) - p.damping * y[1] - drag
    torque += p.cogging * np.sin(14 * y[0])
    dy[0] = y[1]
    dy[1] = torque / (p.inertia + p.mass * p.reach**2 + p.rotor)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return two motions: sines, then the motor is off; faster sines."""
    made = []
    for slow, fast in ((0.35, 1.3), (0.6, 1.9)):
        t = clock(6.0, 250)
        torque = sines(t, (0.28, slow * rng.uniform(0.9, 1.1), 0.0), (0.18, fast * rng.uniform(0.95, 1.05), 1.0))
        torque[t >= 4.5] = 0.0
        made.append(Motion(6.0, {"motor": Held(t, np.round(torque, 5))}))
    return made


MACHINE = Machine(
    name="pendulum",
    model=MODEL,
    nominal=Values(),
    lengths=("reach",),
    loose=("damping", "friction"),
    exact=("cogging",),
    derivative=derivative,
    rest=lambda p, u: np.zeros(3),  # noqa: ARG005
    actuators=("motor",),
    sensors=(Sensor("shaft_angle", ("angle",), 500, 6e-4, lambda y, p: y[:, :1], 2 * np.pi / 4096),),  # noqa: ARG005
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case("tight_seal", "single", (("joint_friction",),), Hidden(added={"friction": 0.012})),
    MACHINE.case("weak_magnet", "single", (("actuator_gain",),), Hidden(factors={"gain": 0.94}), Habits(stated=True)),
    MACHINE.case("slow_clock", "single", (("time_base",),), Hidden(clock={"shaft_angle": -0.006}), Habits(lost=0.01)),
    MACHINE.case(
        "grease_and_late_reading",
        "pair",
        (("joint_damping",), ("latency", "actuator_delay")),
        Hidden(added={"damping": 0.006}, latency={"shaft_angle": 0.004}),
        Habits(stated=True, jitter=1e-4),
    ),
    MACHINE.case("cogging", "outside", (), Hidden(added={"cogging": 0.02})),
)
