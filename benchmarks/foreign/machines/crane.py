"""A small gantry crane: a trolley with a position controller, and a panel on a rod that a camera sees."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="gantry crane">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="trolley" pos="0 0 1.4">
      <inertial pos="0 0 0" mass="3" diaginertia="0.01 0.01 0.01"/>
      <joint name="track" type="slide" axis="1 0 0" armature="1.5" damping="20" frictionloss="4"/>
      <geom type="box" size="0.1 0.08 0.05" contype="0" conaffinity="0"/>
      <body name="load">
        <inertial pos="0 0 -0.9" mass="0.4" diaginertia="0.004 0.004 0.004"/>
        <joint name="swing" type="hinge" axis="0 -1 0" damping="0.006"/>
        <geom type="box" size="0.02 0.1 0.1" pos="0 0 -0.9" contype="0" conaffinity="0"/>
        <site name="target" pos="0 0 -0.95"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="trolley" joint="track" biastype="affine" gainprm="1500" biasprm="0 -1500 -120"/>
  </actuator>
  <sensor>
    <jointpos name="trolley" joint="track"/>
    <framepos name="target" objtype="site" objname="target"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the crane."""

    trolley: float = 3.0
    rotor: float = 1.5
    load: float = 0.4
    rope: float = 0.9
    inertia: float = 0.004
    target: float = 0.95
    damping: float = 20.0
    friction: float = 4.0
    swing_damping: float = 0.006
    kp: float = 1500.0
    kv: float = 120.0
    drag: float = 0.0
    """Force on the panel at 1 m/s against the air [N]."""
    wind: float = 0.0
    """Speed of the air along x [m/s]."""
    mast: float = 0.0
    """Compliance of the gantry on which the rail lies [m/N]; 0 where it is rigid."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Lagrange's equations; the state is position, angle, their rates, deflection and speed of the gantry."""
    sin, cos = np.sin(y[1]), np.cos(y[1])
    moving = y[5] if p.mast > 0.0 else 0.0
    against_air = y[2] + moving + p.rope * cos * y[3] - p.wind
    upward = p.rope * sin * y[3]
    air = p.drag * np.sqrt(against_air**2 + upward**2)
    force = p.kp * (u[0] - y[0]) - (p.kv + p.damping) * y[2] - coulomb(y[2], p.friction)
    arm = p.load * p.rope
    m11, m12, m22 = p.trolley + p.rotor + p.load, arm * cos, p.inertia + arm * p.rope
    base, back = 0.0, 0.0
    if p.mast > 0.0:
        # The gantry of 9 kg takes what drives the trolley, less what turns the rotor, and carries its rail along.
        base, back = (-force - y[4] / p.mast - 14.0 * y[5]) / 9.0, p.rotor / 9.0
    f1 = force + arm * sin * y[3] ** 2 - air * against_air - (p.trolley + p.load) * base
    f2 = (
        -arm * 9.81 * sin
        - p.swing_damping * y[3]
        - p.rope * air * (cos * against_air + sin * upward)
        - arm * cos * base
    )
    m11, m21 = m11 + (p.trolley + p.load) * back, m12 * (1 + back)
    det = m11 * m22 - m12 * m21
    dy[0] = y[2]
    dy[1] = y[3]
    dy[2] = (m22 * f1 - m12 * f2) / det
    dy[3] = (m11 * f2 - m21 * f1) / det
    dy[4] = moving
    dy[5] = base + back * dy[2] if p.mast > 0.0 else 0.0


def target(y: np.ndarray, p: Values) -> np.ndarray:
    """Return positions of the target on the load in the world [m]."""
    x = y[:, 0] + p.target * np.sin(y[:, 1]) + (y[:, 4] if p.mast > 0 else 0.0)
    return np.stack([x, np.zeros(len(y)), 1.4 - p.target * np.cos(y[:, 1])], axis=1)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return a motion of reaches and one of sines near the load's own frequency."""
    t = clock(7.0, 100)
    far = rng.uniform(0.45, 0.55)
    path = reach(t, [(0, 0), (0.4, far), (3.0, -0.2), (5.2, 0.1)], 1.1)
    sway = sines(t, (0.06, 0.45, 0), (0.03, rng.uniform(0.85, 0.95), 0.5))
    return [Motion(7.0, {"trolley": Held(t, c)}) for c in (path, sway - sway[0])]


MACHINE = Machine(
    name="crane",
    model=MODEL,
    nominal=Values(),
    lengths=("rope", "target"),
    loose=("damping", "friction", "swing_damping"),
    exact=("kp", "kv", "drag", "wind", "mast"),
    derivative=derivative,
    rest=lambda p, u: np.array([u[0], np.arctan(p.drag * p.wind * abs(p.wind) / (9.81 * p.load)), 0, 0, 0, 0]),
    actuators=("trolley",),
    sensors=(
        Sensor("trolley", ("position",), 100, 2e-4, lambda y, p: y[:, :1], 1e-4),  # noqa: ARG005
        Sensor("target", ("x", "y", "z"), 60, 1e-3, target),
    ),
    motions=motions,
    settle=20.0,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case("air_drag", "single", (("air_drag",),), Hidden(added={"drag": 0.029})),
    MACHINE.case("fan", "single", (("wind",),), Hidden(added={"drag": 0.029, "wind": 0.9}), Habits(stated=True)),
    MACHINE.case("late_camera", "single", (("latency",),), Hidden(latency={"target": 0.03}), Habits(lost=0.02)),
    MACHINE.case(
        "drag_and_camera_scale",
        "pair",
        (("air_drag",), ("length_scale", "sensor_gain")),
        Hidden(added={"drag": 0.029}, gain={"target": 1.012}),
        Habits(stated=True),
    ),
    MACHINE.case("swaying_gantry", "outside", (), Hidden(added={"mast": 6e-4})),
)
