"""A round finger on two slides pushes a disc over a table, lets it slide on, and catches up; seen by a camera above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.integrate import Held, integrate
from benchmarks.foreign.log import Recorded, Table
from benchmarks.foreign.readings import Camera, Encoder, command_times, rotation, smooth_step

MODEL = """<mujoco model="disc_push">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1" friction="0.25"/>
    <body name="bridge" pos="0 0 0.2">
      <joint name="x" type="slide" axis="1 0 0" damping="8"/>
      <geom name="bridge" type="box" size="0.03 0.3 0.02" mass="1.4" contype="0" conaffinity="0"/>
      <body name="finger" pos="0 0 -0.188">
        <joint name="y" type="slide" axis="0 1 0" damping="6"/>
        <geom name="carriage" type="box" pos="0 0 0.14" size="0.03 0.03 0.02" mass="0.68" contype="0" conaffinity="0"/>
        <geom name="tip" type="sphere" size="0.008" mass="0.02" friction="0.2" priority="1"
          solref="0.002 1" solimp="0.99 0.99 0.001"/>
      </body>
    </body>
    <body name="disc" pos="0.06 0 0.012">
      <freejoint/>
      <geom name="disc" type="cylinder" size="0.045 0.012" mass="0.3" friction="0.25"/>
    </body>
  </worldbody>
  <actuator>
    <position name="x" joint="x" kp="2500" kv="110"/>
    <position name="y" joint="y" kp="1500" kv="60"/>
  </actuator>
  <sensor>
    <jointpos name="x_encoder" joint="x"/>
    <jointpos name="y_encoder" joint="y"/>
    <framepos name="disc_position" objtype="xbody" objname="disc"/>
    <framequat name="disc_orientation" objtype="xbody" objname="disc"/>
  </sensor>
</mujoco>
"""

RADIUS, HALF, TIP = 0.045, 0.012, 0.008
"""Of the disc, half its height, and of the finger's tip [m]; the disc rests on a thin ring along its rim."""
RING = 24
"""Points at which the load on the ring is taken."""
DURATION = 3.0
RUNS: tuple[tuple[tuple[float, float, float], tuple[tuple[float, float, float, float], ...]], ...] = (
    (
        (0.058, 0.005, 0.2),
        ((0.3, 0.40, 0.11, 0.0), (0.8, 0.25, 0.11, 0.010), (1.1, 0.42, 0.22, 0.010), (1.9, 0.6, 0.18, 0.010)),
    ),
    (
        (-0.004, 0.060, -0.4),
        ((0.3, 0.42, 0.0, 0.11), (0.8, 0.25, -0.016, 0.11), (1.1, 0.42, -0.016, 0.22), (1.9, 0.6, -0.016, 0.18)),
    ),
    ((0.040, 0.044, 0.0), ((0.3, 0.40, 0.08, 0.08), (1.1, 0.42, 0.157, 0.165), (1.9, 0.6, 0.13, 0.13))),
    (
        (-0.058, 0.006, 0.9),
        ((0.3, 0.50, -0.12, 0.0), (0.8, 0.25, -0.12, 0.017), (1.1, 0.40, -0.22, 0.017), (1.9, 0.6, -0.18, 0.017)),
    ),
)
"""Where the disc stands [m], [m], [rad]; when the finger leaves and how long it takes [s], and where it goes [m]."""


class Values(NamedTuple):
    """Finger, disc and table."""

    bridge: float = 1.4
    carriage: float = 0.7
    damping_x: float = 8.0
    damping_y: float = 6.0
    kp_x: float = 2500.0
    kp_y: float = 1500.0
    kv_x: float = 110.0
    kv_y: float = 60.0
    mass: float = 0.3
    inertia: float = 0.5 * 0.3 * RADIUS**2
    friction: float = 0.25
    across: float = 1.0
    """Friction of sliding along y by that along x."""
    tip_friction: float = 0.2
    stiffness: float = 3e7
    """Of tip and disc [N/m^1.5]."""
    restitution: float = 4.0
    """Damping of their contact by its elastic force [s/m]."""
    slope_x: float = 0.0
    """Share of gravity along the table's x; `slope_y` the same along y."""
    slope_y: float = 0.0
    pull: float = 0.0
    """Largest pull along the table of a magnet below it [N]."""
    magnet_x: float = 0.0
    """Where that is [m]."""
    magnet_y: float = 0.0
    reach: float = 0.035
    """From the magnet to where it pulls most [m]."""
    sink: float = 5e-5
    clock: float = 0.0
    """Share by which the clock of the camera is fast."""


VARIED = (
    "bridge", "carriage", "damping_x", "damping_y", "mass", "inertia", "friction", "tip_friction", "stiffness",
    "restitution",
)  # fmt: skip
"""Not the gains, which the controller computes."""


@njit(cache=True)
def ring_friction(p: Values, load: float, y: np.ndarray, out: np.ndarray) -> None:
    """Write force [N], [N] and torque [N m] of the table on the ring.

    The load along the ring is linear in place, as on felt of one stiffness; friction below the disc's centre shifts it.
    Where friction depends on the direction, it is that of greatest dissipation, with an elliptic limit.
    """
    px, py = p.friction, p.friction * p.across
    out[:] = 0.0
    for _ in range(4):
        lean_x, lean_y = -2.0 * HALF * out[0] / RADIUS, -2.0 * HALF * out[1] / RADIUS
        out[:] = 0.0
        for k in range(RING):
            angle = 2.0 * np.pi * k / RING
            c, s = np.cos(angle), np.sin(angle)
            vx, vy = y[7] - y[9] * RADIUS * s, y[8] + y[9] * RADIUS * c
            size = np.sqrt((px * vx) ** 2 + (py * vy) ** 2 + (1e-3 * px) ** 2)
            part = max(0.0, load + lean_x * c + lean_y * s) / RING
            fx, fy = -part * px * px * vx / size, -part * py * py * vy / size
            out[0] += fx
            out[1] += fy
            out[2] += RADIUS * (c * fy - s * fx)


@njit(cache=True)
def tip_force(p: Values, y: np.ndarray, out: np.ndarray) -> None:
    """Write force [N], [N] and torque [N m] of the finger on the disc.

    The normal force is that of Hunt and Crossley (J. Appl. Mech. 42, 1975) with Hertz' exponent.
    """
    out[:] = 0.0
    dx, dy = y[4] - y[0], y[5] - y[1]
    apart = np.sqrt(dx * dx + dy * dy)
    depth = RADIUS + TIP - apart
    if depth <= 0.0:
        return
    nx, ny = dx / apart, dy / apart
    vx, vy = y[7] - y[2], y[8] - y[3]
    closing = -(vx * nx + vy * ny)
    press = max(0.0, p.stiffness * depth**1.5 * (1.0 + p.restitution * closing))
    slip = vy * nx - vx * ny - y[9] * RADIUS
    rub = -p.tip_friction * press * np.tanh(slip / 1e-3)
    out[0], out[1] = press * nx - rub * ny, press * ny + rub * nx
    out[2] = -RADIUS * rub


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law: place and speed of the finger, place, heading and speeds of the disc."""
    tip, drag = np.zeros(3), np.zeros(3)
    tip_force(p, y, tip)
    away_x, away_y = (y[4] - p.magnet_x) / p.reach, (y[5] - p.magnet_y) / p.reach
    near = np.exp(0.5 - 0.5 * (away_x**2 + away_y**2))
    # the pull along the table is the gradient of a bell; straight down it is twice as large at the middle
    ring_friction(p, p.mass * 9.81 + 2.0 * p.pull * near, y, drag)
    dy[0], dy[1] = y[2], y[3]
    dy[2] = (p.kp_x * (u[0] - y[0]) - (p.kv_x + p.damping_x) * y[2] - tip[0]) / (p.bridge + p.carriage)
    dy[3] = (p.kp_y * (u[1] - y[1]) - (p.kv_y + p.damping_y) * y[3] - tip[1]) / p.carriage
    dy[4], dy[5], dy[6] = y[7], y[8], y[9]
    dy[7] = (tip[0] + drag[0] - p.pull * near * away_x) / p.mass + 9.81 * p.slope_x
    dy[8] = (tip[1] + drag[1] - p.pull * near * away_y) / p.mass + 9.81 * p.slope_y
    dy[9] = (tip[2] + drag[2]) / p.inertia


def set_points(strokes: Sequence[Sequence[float]]) -> tuple[Held, Held]:
    """Return what the slides are told."""
    t = command_times(DURATION, 200.0)
    way = np.zeros((2, len(t)))
    stops = [(0.0, 0.0, 0.0, 0.0), *strokes]
    for before, (start, lasts, x, y) in pairwise(stops):
        way += np.outer([x - before[2], y - before[3]], smooth_step((t - start) / lasts))
    x, y = np.round(way, 5) + 0.0
    return Held(t, x), Held(t, y)


def push(
    values: Values, stands: Sequence[float], commands: tuple[Held, Held], duration: float = DURATION
) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and states, shape (steps, 10)."""
    time = np.arange(round(duration / 1e-3) + 1) * 1e-3
    start = np.array([0.0, 0.0, 0.0, 0.0, *stands, 0.0, 0.0, 0.0])
    return time, integrate(derivative, values, start, commands, (0.0, 0.0), time, 0.0)


def record(values: Values, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return four runs of two pushes each."""
    encoder = Encoder(rate=200.0, step=5e-5, noise=4e-5)
    camera = Camera(rate=100.0, noise=3e-4, turn_noise=0.005, lost=0.02, jitter=3e-4, clock=values.clock)
    motions = []
    for stands, strokes in RUNS:
        placed = [v + rng.normal(0, spread) for v, spread in zip(stands, (5e-4, 5e-4, 0.02), strict=True)]
        commands = set_points(strokes)
        time, state = push(values, placed, commands)
        zero = np.zeros(len(time))
        position = np.stack([state[:, 4], state[:, 5], zero + HALF - values.sink], axis=1)
        heading = rotation(np.stack([zero, zero, state[:, 6]], axis=1))
        place, turn = camera.read(rng, time, position, heading, seen="xy")
        measured = {
            "x_encoder": encoder.read(rng, time, state[:, 0]),
            "y_encoder": encoder.read(rng, time, state[:, 1]),
            "disc_position": place,
            "disc_orientation": turn,
        }
        told = {name: Table(c.time, {"command": c.value}) for name, c in zip("xy", commands, strict=True)}
        motions.append(Recorded(measured, told))
    noise = {
        "x_encoder": encoder.deviation,
        "y_encoder": encoder.deviation,
        "disc_position": camera.noise,
        "disc_orientation": camera.turn_noise,
    }
    return motions, noise


CASES = cases(
    "disc_push",
    MODEL,
    Values(),
    VARIED,
    (
        Cause("nothing", "null", noise_stated=True),
        Cause("waxed_table", "single", (("sliding_friction",),), {"friction": 0.82}),
        Cause("table_leans", "single", (("gravity_tilt",),), values={"slope_x": -0.01, "slope_y": 0.014}),
        Cause("brushed_table", "single", (("anisotropic_friction",),), values={"across": 1.2}, noise_stated=True),
        Cause("camera_clock", "single", (("time_base",),), values={"clock": 0.012}, noise_stated=True),
        # A force that depends on the place of the disc, along the table and down: the library has none.
        Cause("magnet_below", "outside", values={"pull": 0.2, "magnet_x": 0.13, "magnet_y": 0.06}),
    ),
    record,
)
