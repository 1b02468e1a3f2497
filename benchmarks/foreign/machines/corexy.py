"""A plotter's head on crossed belts, which two motors at the frame drive together, and a screw that lifts a load."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="gantry on crossed belts">
  <option timestep="0.001" integrator="implicitfast"/>
  <default>
    <geom type="box" contype="0" conaffinity="0" mass="0"/>
    <joint type="slide"/>
  </default>
  <worldbody>
    <body name="bridge" pos="0 0 0.5">
      <inertial pos="0 0 0" mass="2.1" diaginertia="0.05 0.01 0.05"/>
      <joint name="y" axis="0 1 0" armature="0.6" damping="14" frictionloss="4"/>
      <geom size="0.3 0.03 0.02"/>
      <body name="head">
        <inertial pos="0 0 0" mass="0.9" diaginertia="0.002 0.002 0.002"/>
        <joint name="x" axis="1 0 0" armature="0.6" damping="10" frictionloss="3"/>
        <geom size="0.04 0.04 0.05"/>
        <body name="lift" pos="0 0 -0.1">
          <inertial pos="0 0 0" mass="0.5" diaginertia="0.001 0.001 0.0005"/>
          <joint name="z" axis="0 0 1" armature="2.5" damping="60" frictionloss="6"/>
          <geom size="0.02 0.02 0.08"/>
          <body name="load" pos="0 0 -0.1">
            <inertial pos="0 0 0" mass="0.7" diaginertia="0.0005 0.0005 0.0005"/>
            <geom size="0.03 0.03 0.03"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="belt_a"><joint joint="x" coef="1"/><joint joint="y" coef="1"/></fixed>
    <fixed name="belt_b"><joint joint="x" coef="1"/><joint joint="y" coef="-1"/></fixed>
  </tendon>
  <actuator>
    <position name="motor_a" tendon="belt_a" kp="6000" kv="150"/>
    <position name="motor_b" tendon="belt_b" kp="6000" kv="150"/>
    <position name="screw" joint="z" kp="15000" kv="420"/>
  </actuator>
  <sensor>
    <jointpos name="scale_x" joint="x"/>
    <jointpos name="scale_y" joint="y"/>
    <jointpos name="scale_z" joint="z"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the gantry."""

    bridge: float = 2.1
    head: float = 0.9
    lift: float = 0.5
    load: float = 0.7
    rotor_a: float = 0.3
    """Half of the inertia of a belt's motor, as it acts on x and on y [kg]."""
    rotor_b: float = 0.3
    rotor_z: float = 2.5
    damping_x: float = 10.0
    damping_y: float = 14.0
    damping_z: float = 60.0
    friction_x: float = 3.0
    friction_y: float = 4.0
    friction_z: float = 6.0
    kp_a: float = 6000.0
    kp_b: float = 6000.0
    kp_z: float = 15000.0
    kv_a: float = 150.0
    kv_b: float = 150.0
    kv_z: float = 420.0
    dirt: float = 0.0
    """Friction of the bridge on a dirty part of its rails, 60 mm long [N]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law along each axis; the state is y, x, z and their rates. Belts move by x + y and by x - y."""
    vy, vx, vz = y[3], y[4], y[5]
    belt_a = p.kp_a * (u[0] - y[1] - y[0]) - p.kv_a * (vx + vy)
    belt_b = p.kp_b * (u[1] - y[1] + y[0]) - p.kv_b * (vx - vy)
    hanging = p.lift + p.load
    level = p.friction_y + p.dirt / (1 + ((y[0] - 0.03) / 0.03) ** 8)
    fx = belt_a + belt_b - p.damping_x * vx - coulomb(vx, p.friction_x)
    fy = belt_a - belt_b - p.damping_y * vy - coulomb(vy, level)
    screw = p.kp_z * (u[2] - y[2]) - p.kv_z * vz
    # Motors turn by x + y and by x - y, so that unequal ones couple the axes.
    both, between = p.rotor_a + p.rotor_b, p.rotor_a - p.rotor_b
    mx, my = p.head + hanging + both, p.bridge + p.head + hanging + both
    det = mx * my - between * between
    dy[0] = vy
    dy[1] = vx
    dy[2] = vz
    dy[3] = (mx * fy - between * fx) / det
    dy[4] = (my * fx - between * fy) / det
    dy[5] = (screw - p.damping_z * vz - coulomb(vz, p.friction_z) - 9.81 * hanging) / (hanging + p.rotor_z)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a pick and place with a lift at each end, and a curve that is drawn fast."""
    t = clock(4.0, 250)
    far = rng.uniform(0.13, 0.16)
    place = {
        "x": reach(t, [(0, -0.1), (0.7, far), (2.4, -0.05)], 0.8),
        "y": reach(t, [(0, -0.06), (0.7, 0.1), (2.4, -0.02)], 0.8),
        "z": reach(t, [(0, 0), (0.2, 0.06), (1.5, 0.01), (2.0, 0.06), (3.3, 0)], 0.45),
    }
    curve = {
        "x": sines(t, (0.06, rng.uniform(0.9, 1.1), 0), (0.012, 3.2, 0)),
        "y": sines(t, (0.05, 1.4, 0.6), (0.01, rng.uniform(3.6, 4.2), 0)),
        "z": 0.03 + sines(t, (0.015, 0.8, 0), (0.004, 3.0, 1.0)),
    }
    return [
        Motion(
            4.0,
            {
                "motor_a": Held(t, np.round(m["x"] + m["y"], 6)),
                "motor_b": Held(t, np.round(m["x"] - m["y"], 6)),
                "screw": Held(t, np.round(m["z"], 6)),
            },
        )
        for m in (place, curve)
    ]


def scale(axis: int, name: str) -> Sensor:
    """Return the linear scale of an axis, with steps of 20 micrometres."""
    return Sensor(f"scale_{name}", ("position",), 1000, 4e-5, lambda y, p: y[:, axis : axis + 1], 2e-5)  # noqa: ARG005


MACHINE = Machine(
    name="corexy",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("damping_x", "damping_y", "damping_z", "friction_x", "friction_y", "friction_z"),
    exact=("dirt",),
    derivative=derivative,
    rest=lambda p, u: np.array([(u[0] - u[1]) / 2, (u[0] + u[1]) / 2, u[2], 0, 0, 0]),  # noqa: ARG005
    actuators=("motor_a", "motor_b", "screw"),
    sensors=(scale(1, "x"), scale(0, "y"), scale(2, "z")),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case(
        "late_motor_b", "single", (("actuator_delay",),), Hidden(delay={"motor_b": 0.006}), Habits(stated=True)
    ),
    MACHINE.case("dry_screw", "single", (("joint_friction",),), Hidden(added={"friction_z": 10.0})),
    MACHINE.case(
        "weak_motor_a", "single", (("actuator_gain",),), Hidden(factors={"kp_a": 0.65, "kv_a": 0.65}), Habits(lost=0.01)
    ),
    MACHINE.case(
        "other_load_and_scale",
        "pair",
        (("mass",), ("sensor_gain", "length_scale")),
        Hidden(added={"load": 0.8}, gain={"scale_x": 1.01}),
        Habits(stated=True),
    ),
    MACHINE.case("dirty_rail", "outside", (), Hidden(added={"dirt": 25.0}), Habits(stated=True)),
)
