"""A ball is sent over a floor, slipping at first, or spun on the spot; a camera reads its pose by marks on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, State, friction_1d, friction_2d, integrate, string_pull
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera

MODEL = """<mujoco model="bowling_ball">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="floor" type="plane" size="4 4 0.1" friction="0.2 0.001 0.0005"/>
    <body name="ball" pos="0 0 0.05">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.05" mass="0.8" condim="6" friction="0.2 0.001 0.0005"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="ball_position" objtype="xbody" objname="ball"/>
    <framequat name="ball_orientation" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>
"""

LAUNCHES = (
    (-1.0, 0.1, 1.1, 0.1, 0.0, 0.0, 0.0, 2.0),
    (0.6, -0.5, -0.4, 0.9, -5.0, -14.0, 0.0, 2.0),
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 26.0, 1.6),
    (0.3, 0.2, 0.0, 0.0, 0.0, 0.0, -20.0, 1.6),
)
"""Place [m], velocity [m/s], angular velocity in the world [rad/s], and time [s]."""


@dataclass(frozen=True)
class Lane:
    """Ball and floor."""

    mass: float = 0.8
    radius: float = 0.05
    inertia: float = 0.4 * 0.8 * 0.05**2
    friction: float = 0.2
    torsion: float = 0.001
    rolling: float = 0.0005
    tilt: tuple[float, float] = (0.0, 0.0)
    """Horizontal parts of gravity, as shares of it."""
    string: float = 0.0
    """Stiffness of a string from the origin that is taut beyond 0.5 m [N/m]."""
    sink: float = 2e-4


VARIED = ("mass", "inertia", "friction", "torsion", "rolling")


def roll(lane: Lane, launch: Sequence[float]) -> Path:
    """Return place, velocity, angular velocity in the world, and quaternion."""
    load = lane.mass * GRAVITY
    r = lane.radius

    def rate(_: float, s: State) -> State:
        x, y, vx, vy, wx, wy, wz, a, b, c, d = s
        fx, fy = friction_2d(vx - r * wy, vy + r * wx, load, lane.friction, lane.friction)
        turn = sqrt(wx * wx + wy * wy + 0.02**2)
        resist = lane.rolling * load / turn
        pull_x, pull_y = string_pull(x, y, 0.5, lane.string)
        return (
            vx,
            vy,
            (fx + pull_x) / lane.mass + GRAVITY * lane.tilt[0],
            (fy + pull_y) / lane.mass + GRAVITY * lane.tilt[1],
            (r * fy - resist * wx) / lane.inertia,
            (-r * fx - resist * wy) / lane.inertia,
            friction_1d(wz, lane.torsion * load, 0.02) / lane.inertia,
            -0.5 * (wx * b + wy * c + wz * d),
            0.5 * (wx * a + wy * d - wz * c),
            0.5 * (wy * a + wz * b - wx * d),
            0.5 * (wz * a + wx * c - wy * b),
        )

    return integrate(rate, (*launch[:7], 1.0, 0.0, 0.0, 0.0), launch[7], step=2e-4)


def record(lane: Lane, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return two balls that roll and two that spin."""
    camera = Camera(rate=100.0, noise=5e-4, turn_noise=0.006, lost=0.02)
    motions = []
    for launch in LAUNCHES:
        path = roll(lane, launch)
        height = np.full(len(path.time), lane.radius - lane.sink)
        position = np.stack([path[0], path[1], height], axis=1)
        place, turn = camera.read(rng, path.time, position, path.state[:, 7:])
        motions.append(Recorded({"ball_position": place, "ball_orientation": turn}, {}))
    return motions, {"ball_position": camera.noise, "ball_orientation": camera.turn_noise}


CASES = cases(
    "bowling_ball",
    MODEL,
    Lane(),
    VARIED,
    (
        Cause("nothing", "null"),
        Cause("carpet", "single", (("rolling_friction",),), {"rolling": 2.5}, noise_stated=True),
        Cause("flattened_pole", "single", (("torsional_friction",),), {"torsion": 1.35}),
        Cause("hollow", "single", (("inertia",),), {"inertia": 1.5}, noise_stated=True),
        Cause("larger_ball", "single", (("size", "contact_geometry"),), {"radius": 1.06}),
        Cause(
            "carpet_on_slope",
            "pair",
            (("rolling_friction",), ("gravity_tilt",)),
            {"rolling": 2.2},
            {"tilt": (0.009, -0.006)},
        ),
        Cause("on_a_string", "outside", values={"string": 3.0}, noise_stated=True),
    ),
    record,
)
