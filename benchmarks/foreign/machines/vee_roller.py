"""A steel roller is let go in a shallow V of two plates and rolls down and up; a camera reads where its axis is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import cos, radians, sin
from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.integrate import integrate
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera

SLOPE = radians(7)
MODEL = """<mujoco model="vee_roller">
  <compiler angle="degree"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <default>
    <geom condim="6" friction="0.4 0.001 0.0006" solref="0.005 1" solimp="0.99 0.99 0.001"/>
  </default>
  <worldbody>
    <geom name="left" type="plane" size="1 1 0.1" euler="0 7 0"/>
    <geom name="right" type="plane" size="1 1 0.1" euler="0 -7 0"/>
    <body name="roller" pos="-0.3 0 0.0771369">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="turn" type="hinge" axis="0 1 0"/>
      <geom name="roller" type="cylinder" size="0.04 0.03" euler="90 0 0" mass="1.1"/>
    </body>
  </worldbody>
  <sensor><framepos name="roller_position" objtype="xbody" objname="roller"/></sensor>
</mujoco>
"""

RADIUS = 0.04
STARTS = (-0.30, 0.24)
"""Where the roller is let go, along x [m]."""
DURATION = 4.0
CONTACT_TIME = 0.005
"""Time constant of the contact, which is damped critically [s]."""


PRESSED = 9.81 * cos(SLOPE) * CONTACT_TIME**2
"""By how much its weight presses the roller in [m]; contact begins as much further out, so that it lies on the V."""


class Values(NamedTuple):
    """Roller, plates and what else acts."""

    mass: float = 1.1
    inertia: float = 0.5 * 1.1 * RADIUS**2
    friction: float = 0.4
    rolling: float = 0.0006
    """Lever of rolling resistance [m]."""
    tilt: float = 0.0
    """By which angle gravity is turned about y [rad]."""
    brake: float = 0.0
    """Eddy-current brake below the right plate [N s/m]."""


VARIED = ("mass", "inertia", "friction", "rolling")
BRAKED = (0.06, 0.14)
"""Where the brake's magnets are, along x [m]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law of the roller; the state is place along x and z, turn, and their speeds."""
    fx, fz = -p.mass * 9.81 * np.sin(p.tilt), -p.mass * 9.81 * np.cos(p.tilt)
    torque = 0.0
    for side in (-1.0, 1.0):
        nx, nz = -side * np.sin(SLOPE), np.cos(SLOPE)
        depth = RADIUS + PRESSED - (nx * y[0] + nz * y[1])
        if depth <= 0.0:
            continue
        closing = -(nx * y[3] + nz * y[4])
        press = max(0.0, p.mass * (depth / CONTACT_TIME + 2.0 * closing) / CONTACT_TIME)
        slip = nz * y[3] - nx * y[4] - RADIUS * y[5]
        rub = -p.friction * press * np.tanh(slip / 2e-3)
        fx += press * nx + rub * nz
        fz += press * nz - rub * nx
        torque += -RADIUS * rub - p.rolling * press * np.tanh(y[5] / 0.05)
    if BRAKED[0] < y[0] < BRAKED[1]:
        fx -= p.brake * y[3]
    dy[0], dy[1], dy[2] = y[3], y[4], y[5]
    dy[3], dy[4], dy[5] = fx / p.mass, fz / p.mass, torque / p.inertia


def height(x: float) -> float:
    """Return the height of the axis of a roller that lies on a plate [m]."""
    return (RADIUS + abs(x) * sin(SLOPE)) / cos(SLOPE)


def roll(values: Values, x: float, duration: float = DURATION) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and states, shape (steps, 6), of a roller that is let go."""
    time = np.arange(round(duration / 1e-3) + 1) * 1e-3
    start = np.array([x, height(x), 0.0, 0.0, 0.0, 0.0])
    return time, integrate(derivative, values, start, (), (), time, 0.0)


def record(values: Values, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return two runs, one from each side."""
    camera = Camera(rate=120.0, noise=4e-4, lost=0.01)
    motions = []
    for x in STARTS:
        time, state = roll(values, x + rng.normal(0, 0.003))
        position = np.stack([state[:, 0], np.zeros(len(time)), state[:, 1]], axis=1)
        place, _ = camera.read(rng, time, position, seen="xz")
        motions.append(Recorded({"roller_position": place}, {}))
    return motions, {"roller_position": camera.noise}


CASES = cases(
    "vee_roller",
    MODEL,
    Values(),
    VARIED,
    (
        Cause("nothing", "null"),
        Cause("dirty_plates", "single", (("rolling_friction",),), {"rolling": 1.7}, noise_stated=True),
        Cause("tube", "single", (("inertia", "armature"),), {"inertia": 1.35}),
        Cause("bench_leans", "single", (("gravity_tilt",),), values={"tilt": 0.008}, noise_stated=True),
        Cause("eddy_brake", "outside", values={"brake": 0.5}),
    ),
    record,
)
