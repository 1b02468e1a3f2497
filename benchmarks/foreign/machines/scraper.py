"""A gantry presses a stylus on a table and scrapes with it; encoders read the axes, a load cell the force."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="scraper">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1" friction="0.25"/>
    <body name="carriage" pos="0 0 0.2">
      <joint name="across" type="slide" axis="1 0 0" range="-0.3 0.3" damping="12" frictionloss="2"/>
      <geom type="box" size="0.06 0.05 0.03" mass="3" contype="0" conaffinity="0"/>
      <body name="quill" pos="0.08 0 0">
        <joint name="down" type="slide" axis="0 0 1" range="-0.05 0.1" damping="15"/>
        <geom type="box" size="0.015 0.015 0.06" mass="0.8" contype="0" conaffinity="0"/>
        <body name="tool" pos="0 0 -0.08">
          <site name="cell"/>
          <geom type="cylinder" pos="0 0 -0.045" size="0.008 0.045" mass="0.24" contype="0" conaffinity="0"/>
          <geom name="stylus" type="sphere" pos="0 0 -0.104" size="0.006" mass="0.01" friction="0.25"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="across" joint="across" kp="6000" kv="250"/>
    <position name="down" joint="down" kp="2500" kv="90"/>
  </actuator>
  <sensor>
    <jointpos name="across_encoder" joint="across"/>
    <jointpos name="down_encoder" joint="down"/>
    <force name="load_cell" site="cell"/>
  </sensor>
</mujoco>
"""

TOUCHES = -0.01
"""Way of the quill at which the stylus touches the table [m]."""
WAVE = 0.012
"""Length of the waves of a table that is not flat [m]."""


class Values(NamedTuple):
    """Values of the gantry and the table."""

    carriage: float = 3.0
    quill: float = 0.8
    tool: float = 0.25
    across_damping: float = 12.0
    across_friction: float = 2.0
    down_damping: float = 15.0
    across_kp: float = 6000.0
    across_kv: float = 250.0
    down_kp: float = 2500.0
    down_kv: float = 90.0
    friction: float = 0.25
    waves: float = 0.0
    """Height of waves of the table [m]."""
    stiffness: float = 5.5e4
    """Stiffness of stylus and table [N/m]."""
    filtering: float = 1e-3
    """Time constant of the load cell [s]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law of both axes; the state is way and speed of each, and the filtered force on the load cell."""
    slope = 2 * np.pi / WAVE
    depth = TOUCHES + p.waves * np.sin(slope * y[0]) - y[2]
    press = 0.0
    if depth > 0.0:
        closing = p.waves * slope * np.cos(slope * y[0]) * y[1] - y[3]
        press = max(0.0, p.stiffness * depth * (1.0 + 25.0 * closing))
    rub = p.friction * press * np.tanh(y[1] / 1e-3)
    hanging = p.quill + p.tool
    across = p.across_kp * (u[0] - y[0]) - (p.across_kv + p.across_damping) * y[1]
    across -= coulomb(y[1], p.across_friction) + rub
    down = p.down_kp * (u[1] - y[2]) - (p.down_kv + p.down_damping) * y[3] + press
    dy[0], dy[2] = y[1], y[3]
    dy[1] = across / (p.carriage + hanging)
    dy[3] = down / hanging - 9.81
    dy[4] = (p.tool * dy[1] + rub - y[4]) / p.filtering
    dy[5] = (p.tool * (dy[3] + 9.81) - press - y[5]) / p.filtering


def load(y: np.ndarray, p: Values) -> np.ndarray:  # noqa: ARG001
    """Return the force on the load cell [N], shape (times, 3)."""
    return np.stack([y[:, 4], 0 * y[:, 4], y[:, 5]], axis=1)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return slow strokes with a tremble, at four pressures."""
    t = clock(8.0, 125)
    across = sines(t, (0.014, 0.22, 0.0), (0.001, rng.uniform(1.3, 1.6), 0.0))
    level = rng.uniform(-0.014, -0.013)
    pressed = [(0, 0.005), (0.4, level), (2.4, -0.018), (4.2, -0.011), (5.3, 0.006), (6.1, -0.016), (7.6, 0.0)]
    commands = {"across": across, "down": reach(t, pressed, 0.4)}
    return [Motion(8.0, {name: Held(t, np.round(c, 6)) for name, c in commands.items()})]


MACHINE = Machine(
    name="scraper",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("across_damping", "across_friction", "down_damping", "friction"),
    exact=("waves", "stiffness", "filtering"),
    derivative=derivative,
    rest=lambda p, u: np.array([u[0], 0.0, u[1] - 9.81 * (p.quill + p.tool) / p.down_kp, 0.0, 0.0, 9.81 * p.tool]),
    actuators=("across", "down"),
    sensors=(
        Sensor("across_encoder", ("position",), 500, 3e-5, lambda y, p: y[:, :1], 5e-5),  # noqa: ARG005
        Sensor("down_encoder", ("position",), 500, 5e-5, lambda y, p: y[:, 2:3], 1e-4),  # noqa: ARG005
        Sensor("load_cell", ("fx", "fy", "fz"), 250, 0.3, load),
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("nothing", "null", habits=Habits(stated=True)),
    MACHINE.case("dry_table", "single", (("sliding_friction",),), Hidden(factors={"friction": 1.5})),
    MACHINE.case(
        "cell_not_calibrated", "single", (("sensor_gain",),), Hidden(gain={"load_cell": 1.15}), Habits(stated=True)
    ),
    MACHINE.case("heavy_tool", "single", (("mass",),), Hidden(factors={"tool": 2.0}), Habits(lost=0.01)),
    MACHINE.case("wavy_table", "outside", (), Hidden(added={"waves": 8e-4}), Habits(stated=True)),
)
