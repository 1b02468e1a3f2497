"""A finger pushes a cube off its centre, so that it turns; an encoder reads the finger, a slow camera the cube."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.integrate import Held, integrate
from benchmarks.foreign.log import Recorded, Table
from benchmarks.foreign.readings import Camera, Encoder, command_times, rotation, smooth_step

MODEL = """<mujoco model="off_centre_push">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1" friction="0.3"/>
    <body name="finger" pos="0 0 0.04">
      <joint name="push" type="slide" axis="1 0 0" range="-0.05 0.4" damping="6"/>
      <geom name="rod" type="box" pos="-0.09 0 0" size="0.08 0.006 0.006" mass="0.9" contype="0" conaffinity="0"/>
      <geom name="tip" type="sphere" size="0.008" mass="0.02" friction="0.1" priority="1" solref="0.004 1"/>
    </body>
    <body name="cube" pos="0.06 0 0.04">
      <freejoint/>
      <geom name="cube" type="box" size="0.04 0.04 0.04" mass="0.6" friction="0.3"/>
    </body>
  </worldbody>
  <actuator><position name="push" joint="push" kp="1200" kv="70"/></actuator>
  <sensor>
    <jointpos name="push_encoder" joint="push"/>
    <framepos name="cube_position" objtype="xbody" objname="cube"/>
    <framequat name="cube_orientation" objtype="xbody" objname="cube"/>
  </sensor>
</mujoco>
"""

HALF, TIP = 0.04, 0.008
"""Half the edge of the cube, and radius of the finger's tip [m]."""
STIFFNESS, DAMPING = 4e4, 20.0
"""Of tip and cube [N/m], [s/m]."""
DURATION = 3.0
PUSHES = (
    (0.060, 0.018, 0.10, 0.14, 1.2),
    (0.062, -0.024, 0.00, 0.12, 0.7),
    (0.066, 0.010, -0.25, 0.16, 0.8),
    (0.058, -0.012, 0.05, 0.18, 1.6),
)
"""Where the cube stands [m], [m], [rad]; way [m] and time [s] of the finger."""


class Values(NamedTuple):
    """Finger, cube and table."""

    finger: float = 0.92
    damping: float = 6.0
    kp: float = 1200.0
    kv: float = 70.0
    mass: float = 0.6
    inertia: float = 0.6 * 0.08**2 / 6
    friction: float = 0.3
    tip_friction: float = 0.1
    ahead: float = 0.0
    """Place of the centre of mass along the cube's x [m]."""
    beside: float = 0.0
    """The same along its y [m]."""
    belt: float = 0.0
    """Speed of the table along y [m/s]."""
    sink: float = 1e-4
    """By how much the cube's feet are pressed in [m]."""
    late: float = 0.0
    """Delay of the camera [s]."""


VARIED = ("finger", "damping", "kp", "kv", "mass", "inertia", "friction", "tip_friction")


@njit(cache=True)
def table_friction(p: Values, y: np.ndarray, out: np.ndarray) -> None:
    """Write force [N], [N] and torque about the centre of mass [N m] of the table on four feet of the cube.

    The loads of the feet are those of feet of one stiffness; friction below the centre of mass shifts them.
    """
    c, s = np.cos(y[4]), np.sin(y[4])
    place, unit = np.empty((4, 2)), np.empty((4, 2))
    system = np.zeros((3, 3))
    for k in range(4):
        along = (HALF if k % 2 else -HALF) - p.ahead
        beside = (HALF if k > 1 else -HALF) - p.beside
        place[k, 0], place[k, 1] = c * along - s * beside, s * along + c * beside
        vx, vy = y[5] - y[7] * place[k, 1], y[6] + y[7] * place[k, 0] - p.belt
        size = np.sqrt(vx * vx + vy * vy + 1e-6)
        unit[k, 0], unit[k, 1] = -p.friction * vx / size, -p.friction * vy / size
        row = np.array([1.0, place[k, 0], place[k, 1]])
        system += np.outer(row, row)
    weight = p.mass * 9.81
    out[:] = 0.0
    for _ in range(4):
        shares = np.linalg.solve(system, np.array([weight, -HALF * out[0], -HALF * out[1]]))
        out[:] = 0.0
        for k in range(4):
            load = max(0.0, shares[0] + shares[1] * place[k, 0] + shares[2] * place[k, 1])
            out[0] += load * unit[k, 0]
            out[1] += load * unit[k, 1]
            out[2] += load * (place[k, 0] * unit[k, 1] - place[k, 1] * unit[k, 0])


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law of finger and cube: way and speed of the finger, place, heading and speeds of the cube's mass."""
    force = np.zeros(3)
    table_friction(p, y, force)
    c, s = np.cos(y[4]), np.sin(y[4])
    dx, dz = y[0] - y[2], -y[3]
    along, beside = c * dx + s * dz + p.ahead, -s * dx + c * dz + p.beside
    near_x, near_y = min(max(along, -HALF), HALF), min(max(beside, -HALF), HALF)
    gap = np.sqrt((along - near_x) ** 2 + (beside - near_y) ** 2)
    back = 0.0
    if 0.0 < gap < TIP:
        nx, ny = (along - near_x) / gap, (beside - near_y) / gap
        normal_x, normal_y = c * nx - s * ny, s * nx + c * ny
        rx, ry = near_x - p.ahead, near_y - p.beside
        arm_x, arm_y = c * rx - s * ry, s * rx + c * ry
        vx, vy = y[5] - y[7] * arm_y - y[1], y[6] + y[7] * arm_x
        closing = vx * normal_x + vy * normal_y
        press = max(0.0, STIFFNESS * (TIP - gap) * (1.0 + DAMPING * closing))
        rub = p.tip_friction * press * np.tanh((vy * normal_x - vx * normal_y) / 1e-3)
        fx, fy = -press * normal_x + rub * normal_y, -press * normal_y - rub * normal_x
        force[0] += fx
        force[1] += fy
        force[2] += arm_x * fy - arm_y * fx
        back = fx
    dy[0], dy[1] = y[1], (p.kp * (u[0] - y[0]) - (p.kv + p.damping) * y[1] - back) / p.finger
    dy[2], dy[3], dy[4] = y[5], y[6], y[7]
    dy[5], dy[6], dy[7] = force[0] / p.mass, force[1] / p.mass, force[2] / p.inertia


def push(values: Values, run: Sequence[float], duration: float = DURATION) -> tuple[Held, np.ndarray, np.ndarray]:
    """Return the command, times [s], and way of the finger with place and heading of the cube, shape (steps, 4)."""
    x, y, heading, way, lasts = run
    t = command_times(duration)
    command = Held(t, np.round(way * smooth_step((t - 0.3) / lasts) - 0.08 * smooth_step((t - 0.5 - lasts) / 0.6), 5))
    time = np.arange(round(duration / 1e-3) + 1) * 1e-3
    c, s = np.cos(heading), np.sin(heading)
    x, y = x + c * values.ahead - s * values.beside, y + s * values.ahead + c * values.beside
    start = np.array([0.0, 0.0, x, y, heading, 0.0, values.belt, 0.0])
    state = integrate(derivative, values, start, (command,), (0.0,), time, 0.0)
    c, s = np.cos(state[:, 4]), np.sin(state[:, 4])
    x = state[:, 2] - c * values.ahead + s * values.beside
    y = state[:, 3] - s * values.ahead - c * values.beside
    return command, time, np.stack([state[:, 0], x, y, state[:, 4]], axis=1)


def record(values: Values, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return four pushes."""
    encoder = Encoder(rate=125.0, step=1e-4, noise=5e-5)
    camera = Camera(rate=30.0, noise=7e-4, turn_noise=0.008, lost=0.02, latency=values.late)
    motions = []
    for run in PUSHES:
        placed = (
            *(v + rng.normal(0, spread) for v, spread in zip(run[:3], (0.001, 0.001, 0.01), strict=True)),
            *run[3:],
        )
        command, time, path = push(values, placed)
        zero = np.zeros(len(time))
        position = np.stack([path[:, 1], path[:, 2], zero + HALF - values.sink], axis=1)
        place, turn = camera.read(rng, time, position, rotation(np.stack([zero, zero, path[:, 3]], axis=1)))
        measured = {
            "push_encoder": encoder.read(rng, time, path[:, 0]),
            "cube_position": place,
            "cube_orientation": turn,
        }
        motions.append(Recorded(measured, {"push": Table(command.time, {"command": command.value})}))
    noise = {"push_encoder": encoder.deviation, "cube_position": camera.noise, "cube_orientation": camera.turn_noise}
    return motions, noise


CASES = cases(
    "off_centre_push",
    MODEL,
    Values(),
    VARIED,
    (
        Cause("nothing", "null", noise_stated=True),
        Cause("lead_in_a_corner", "single", (("center_of_mass",),), values={"ahead": 0.009, "beside": -0.012}),
        Cause("worn_table", "single", (("sliding_friction",),), {"friction": 1.6}, noise_stated=True),
        Cause(
            "lead_and_late_camera",
            "pair",
            (("center_of_mass",), ("latency",)),
            values={"ahead": -0.01, "beside": 0.012, "late": 0.08},
            noise_stated=True,
        ),
        Cause("belt_creeps", "outside", values={"belt": 0.01}),
    ),
    record,
)
