"""A puck glides over an air table and rebounds from its cushions; a camera above reads place and heading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.integrate import integrate
from benchmarks.foreign.log import Recorded, Table
from benchmarks.foreign.readings import Camera

MODEL = """<mujoco model="air_puck">
  <compiler angle="degree"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default><default class="cushion">
    <geom type="plane" size="1 1 0.1" friction="0.012" priority="1" solref="-40000 -32" solimp="0.99 0.99 0.001"/>
  </default></default>
  <worldbody>
    <geom name="left" class="cushion" pos="-0.6 0 0" euler="0 90 0"/>
    <geom name="right" class="cushion" pos="0.6 0 0" euler="0 -90 0"/>
    <geom name="near" class="cushion" pos="0 -0.4 0" euler="-90 0 0"/>
    <geom name="far" class="cushion" pos="0 0.4 0" euler="90 0 0"/>
    <body name="puck" pos="0 0 0.01">
      <joint name="x" type="slide" axis="1 0 0" damping="0.008"/>
      <joint name="y" type="slide" axis="0 1 0" damping="0.008"/>
      <joint name="heading" type="hinge" axis="0 0 1" damping="1e-5"/>
      <geom name="puck" type="cylinder" size="0.05 0.01" mass="0.12"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="puck_position" objtype="xbody" objname="puck"/>
    <jointpos name="puck_heading" joint="heading"/>
  </sensor>
</mujoco>
"""

LENGTH, WIDTH, HALF_HEIGHT = 0.6, 0.4, 0.01
"""From the middle of the table to the cushions, and half the height of the puck [m]."""
SHOTS = (
    (-0.35, -0.10, 0.0, 0.75, 0.30, 0.0, 2.6),
    (0.30, 0.25, 1.0, -0.45, -0.55, 3.0, 2.4),
    (0.10, -0.20, -0.5, 0.60, 0.10, -6.0, 2.2),
)
"""Place [m], heading [rad], their speeds, and time [s]; the puck is under way when the recording begins."""
BLOCKED = (0.0, 0.3)
"""Where holes of the table may be blocked, along x [m]."""
HEADING_NOISE = 0.005
"""Standard deviation of a heading [rad]."""


class Values(NamedTuple):
    """Puck, table and cushions."""

    mass: float = 0.12
    radius: float = 0.05
    inertia: float = 0.12 * 0.05**2 / 2
    film: float = 0.008
    """Drag of the film of air [N s/m]."""
    film_turn: float = 1e-5
    """The same against a turn [N m s/rad]."""
    grip: float = 0.012
    """Friction of the cushions."""
    stiffness: float = 40000.0
    """Stiffness of puck and cushion by the puck's mass [1/s^2]."""
    damping: float = 32.0
    """Damping of puck and cushion by the puck's mass [1/s]."""
    slope_x: float = 0.0
    """Horizontal part of gravity along x, as a share of it."""
    slope_y: float = 0.0
    strip_friction: float = 0.0
    """Coefficient of friction where no air comes out of the table."""


VARIED = ("mass", "inertia", "film", "film_turn", "grip", "stiffness", "damping")


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law of the puck; the state is place, heading and their speeds."""
    dry = p.strip_friction * 9.81 * p.mass if BLOCKED[0] < y[0] < BLOCKED[1] else 0.0
    drag = p.film + dry / np.sqrt(y[3] ** 2 + y[4] ** 2 + 1e-6)
    ax = 9.81 * p.slope_x - drag * y[3] / p.mass
    ay = 9.81 * p.slope_y - drag * y[4] / p.mass
    turn = -p.film_turn * y[5]
    for side in range(4):
        out = 1.0 if side % 2 else -1.0
        along_x = side < 2
        depth = out * (y[0] if along_x else y[1]) + p.radius - (LENGTH if along_x else WIDTH)
        if depth <= 0.0:
            continue
        push = max(0.0, p.stiffness * depth + p.damping * out * (y[3] if along_x else y[4]))
        rim = out * p.radius * y[5]
        slip = y[4] + rim if along_x else y[3] - rim
        rub = -p.grip * push * np.tanh(slip / 1e-3)
        if along_x:
            ax -= out * push
            ay += rub
            turn += out * p.radius * rub * p.mass
        else:
            ay -= out * push
            ax += rub
            turn -= out * p.radius * rub * p.mass
    dy[0], dy[1], dy[2] = y[3], y[4], y[5]
    dy[3], dy[4], dy[5] = ax, ay, turn / p.inertia


def glide(values: Values, shot: Sequence[float], step: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and states, shape (steps, 6), of a shot."""
    time = np.arange(round(shot[6] / step) + 1) * step
    return time, integrate(derivative, values, np.array(shot[:6]), (), (), time, 0.0)


def record(values: Values, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return three shots."""
    camera = Camera(rate=60.0, noise=5e-4, lost=0.02)
    motions = []
    for shot in SHOTS:
        time, state = glide(values, (*(v + rng.normal(0, 0.01) for v in shot[:6]), shot[6]))
        position = np.column_stack([state[:, :2], np.full(len(time), HALF_HEIGHT)])
        place, _ = camera.read(rng, time, position, seen="xy")
        heading = np.interp(place.time, time, state[:, 2]) + rng.normal(0, HEADING_NOISE, len(place.time))
        heading[np.isnan(place.columns["x"])] = np.nan
        motions.append(Recorded({"puck_position": place, "puck_heading": Table(place.time, {"angle": heading})}, {}))
    return motions, {"puck_position": camera.noise, "puck_heading": HEADING_NOISE}


CASES = cases(
    "air_puck",
    MODEL,
    Values(),
    VARIED,
    (
        Cause("nothing", "null", noise_stated=True),
        Cause("not_level", "single", (("gravity_tilt",),), values={"slope_x": 0.004, "slope_y": -0.0025}),
        Cause("dead_cushions", "single", (("contact_compliance",),), {"damping": 1.8}, noise_stated=True),
        Cause("weighted_rim", "single", (("inertia", "armature"),), {"inertia": 1.6}, noise_stated=True),
        Cause("blocked_holes", "outside", values={"strip_friction": 0.015}),
    ),
    record,
)
