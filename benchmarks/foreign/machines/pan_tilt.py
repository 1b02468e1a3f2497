"""A pan and tilt head for a camera, with speed controllers, encoders and gyroscopes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, sines, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="pan tilt head">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="yoke" pos="0 0 1.2">
      <inertial pos="0 0 0.05" mass="0.8" diaginertia="0.003 0.003 0.0025"/>
      <joint name="pan" type="hinge" axis="0 0 1" armature="0.004" damping="0.02" frictionloss="0.04"/>
      <geom type="box" size="0.03 0.06 0.05" pos="0 0 0.05" contype="0" conaffinity="0"/>
      <body name="camera" pos="0 0 0.1">
        <inertial pos="0.03 0 0.015" mass="0.7" diaginertia="0.0008 0.0016 0.0014"/>
        <joint name="tilt" type="hinge" axis="0 -1 0" range="-1.4 1.4" armature="0.002" damping="0.015"
          frictionloss="0.025"/>
        <geom type="box" size="0.06 0.03 0.03" pos="0.03 0 0.015" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity name="pan_drive" joint="pan" kv="0.16"/>
    <velocity name="tilt_drive" joint="tilt" kv="1.1"/>
  </actuator>
  <sensor>
    <jointpos name="pan_angle" joint="pan"/>
    <jointpos name="tilt_angle" joint="tilt"/>
    <jointvel name="pan_speed" joint="pan"/>
    <jointvel name="tilt_speed" joint="tilt"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the head."""

    yoke: float = 0.0025
    mass: float = 0.7
    ahead: float = 0.03
    above: float = 0.015
    inertia_x: float = 0.0008
    inertia_y: float = 0.0016
    inertia_z: float = 0.0014
    pan_rotor: float = 0.004
    tilt_rotor: float = 0.002
    pan_damping: float = 0.02
    tilt_damping: float = 0.015
    pan_friction: float = 0.04
    tilt_friction: float = 0.025
    pan_kv: float = 0.16
    tilt_kv: float = 1.1
    pan_limit: float = 1e3
    """Largest torque of the pan drive [N m]."""
    cable: float = 0.0
    """Torque of the camera's cable, which is taut beyond 0.2 rad of pan on one side [N m/rad^2]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Lagrange's equations; the state is pan, tilt, and their rates."""
    sin, cos = np.sin(y[1]), np.cos(y[1])
    out, slope = p.ahead * cos - p.above * sin, -p.ahead * sin - p.above * cos
    about_z = p.yoke + p.pan_rotor + p.mass * out**2 + p.inertia_x * sin**2 + p.inertia_z * cos**2
    change = 2 * p.mass * out * slope + 2 * (p.inertia_x - p.inertia_z) * sin * cos
    about_y = p.inertia_y + p.tilt_rotor + p.mass * (p.ahead**2 + p.above**2)
    pan = min(max(p.pan_kv * (u[0] - y[2]), -p.pan_limit), p.pan_limit)
    pan -= p.pan_damping * y[2] + coulomb(y[2], p.pan_friction) + p.cable * max(y[0] - 0.2, 0.0) ** 2
    tilt = p.tilt_kv * (u[1] - y[3]) - p.tilt_damping * y[3] - coulomb(y[3], p.tilt_friction)
    dy[0] = y[2]
    dy[1] = y[3]
    dy[2] = (pan - change * y[2] * y[3]) / about_z
    dy[3] = (tilt + 0.5 * change * y[2] ** 2 - p.mass * 9.81 * out) / about_y


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a motion with sines of both axes, and one with steps of the speeds."""
    t = clock(4.0, 250)
    weight = 0.7 * 9.81 * 0.03 / 1.1  # Speed commanded that carries the camera.
    pan = sines(t, (1.6, 0.5, 0.0), (1.0, rng.uniform(1.6, 2.0), 0.4))
    tilt = weight + sines(t, (0.8, 0.6, 0.3), (0.7, rng.uniform(2.1, 2.5), 0.0))
    first = {"pan_drive": Held(t, np.round(pan, 5)), "tilt_drive": Held(t, np.round(tilt, 5))}
    jumps = steps(t, [(0, 0), (0.3, 2.2), (0.9, -2.4), (1.6, 1.2), (2.1, 0), (2.6, 2.6), (3.1, -2.0), (3.6, 0)])
    other = weight + steps(t, [(0, 0), (0.5, 1.0), (1.0, -1.3), (1.7, 0.8), (2.3, 0), (2.8, -0.9), (3.4, 1.1)])
    return [Motion(4.0, first), Motion(4.0, {"pan_drive": Held(t, jumps), "tilt_drive": Held(t, np.round(other, 5))})]


MACHINE = Machine(
    name="pan_tilt",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("pan_damping", "tilt_damping", "pan_friction", "tilt_friction"),
    exact=("pan_limit", "cable"),
    derivative=derivative,
    rest=lambda p, u: np.zeros(4),  # noqa: ARG005
    actuators=("pan_drive", "tilt_drive"),
    sensors=(
        Sensor("pan_angle", ("angle",), 250, 1e-3, lambda y, p: y[:, :1], 1e-3),  # noqa: ARG005
        Sensor("tilt_angle", ("angle",), 250, 1e-3, lambda y, p: y[:, 1:2], 1e-3),  # noqa: ARG005
        Sensor("pan_speed", ("speed",), 250, 0.02, lambda y, p: y[:, 2:3]),  # noqa: ARG005
        Sensor("tilt_speed", ("speed",), 250, 0.02, lambda y, p: y[:, 3:4]),  # noqa: ARG005
    ),
    motions=motions,
    settle=0.0,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(jitter=1e-4)),
    MACHINE.case("pan_flywheel", "single", (("armature", "inertia"),), Hidden(added={"pan_rotor": 0.0025})),
    MACHINE.case(
        "weak_pan_amplifier",
        "single",
        (("actuator_saturation",),),
        Hidden(factors={"pan_limit": 2.8e-4}),
        Habits(stated=True),
    ),
    MACHINE.case(
        "late_commands",
        "single",
        (("actuator_delay", "latency"),),
        Hidden(delay={"pan_drive": 0.012, "tilt_drive": 0.012}),
        Habits(stated=True),
    ),
    MACHINE.case("lens_ahead", "single", (("center_of_mass",),), Hidden(added={"ahead": 0.002})),
    MACHINE.case("cable", "outside", (), Hidden(added={"cable": 0.03}), Habits(stated=True)),
)
