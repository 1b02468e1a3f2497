"""A stage on leaf springs, driven by a voice coil, with a position sensor of 500 Hz."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, chirp, clock, sines, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="voice coil stage">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="stage" pos="0 0 0.1">
      <inertial pos="0 0 0" mass="0.35" diaginertia="0.0003 0.0003 0.0003"/>
      <joint name="flexure" type="slide" axis="1 0 0" stiffness="180" damping="3"/>
      <geom type="box" size="0.03 0.03 0.01" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="coil" joint="flexure" gear="8.5" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos name="position" joint="flexure"/></sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the stage."""

    mass: float = 0.35
    stiffness: float = 180.0
    damping: float = 3.0
    gain: float = 8.5
    hardening: float = 0.0
    """Share by which the springs are stiffer at 10 mm, growing with the square of the stroke."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law; the state is position and speed."""
    spring = p.stiffness * y[0] * (1 + p.hardening * (y[0] / 0.01) ** 2)
    dy[0] = y[1]
    dy[1] = (p.gain * u[0] - spring - p.damping * y[1]) / p.mass


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a chirp, steps of the current, and sines with steps of another size."""
    t = clock(4.0, 500)
    high = rng.uniform(8, 9)
    jumps = steps(t, [(0, 0), (0.3, 0.16), (1.0, -0.2), (1.6, 0.05), (2.2, 0.24), (2.9, -0.1), (3.5, 0)])
    mixed = sines(t, (0.12, 1.3, 0.2), (0.09, 4.1 * rng.uniform(0.95, 1.05), 0)) + 0.3 * jumps
    return [Motion(4.0, {"coil": Held(t, np.round(c, 5))}) for c in (chirp(t, 0.17, 0.5, high), jumps, mixed)]


MACHINE = Machine(
    name="voice_coil",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("damping",),
    exact=("hardening",),
    derivative=derivative,
    rest=lambda p, u: np.zeros(2),  # noqa: ARG005
    actuators=("coil",),
    sensors=(Sensor("position", ("position",), 500, 3e-5, lambda y, p: y[:, :1]),),  # noqa: ARG005
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(lost=0.01)),
    MACHINE.case(
        "stiff_leaves", "single", (("joint_stiffness",),), Hidden(factors={"stiffness": 1.05}), Habits(stated=True)
    ),
    MACHINE.case("inductance", "single", (("actuator_lag",),), Hidden(lag={"coil": 0.006})),
    MACHINE.case("mirror_on_stage", "single", (("mass", "armature"),), Hidden(factors={"mass": 1.06})),
    MACHINE.case(
        "weak_coil_and_late_reading",
        "pair",
        (("actuator_gain", "sensor_gain", "length_scale"), ("latency", "actuator_delay")),
        Hidden(factors={"gain": 0.94}, latency={"position": 0.0025}),
        Habits(stated=True),
    ),
    MACHINE.case("hardening_leaves", "outside", (), Hidden(added={"hardening": 0.04}), Habits(stated=True)),
)
