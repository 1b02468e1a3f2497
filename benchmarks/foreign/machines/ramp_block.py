"""A steel block with four feet is thrown onto a ramp, up, across and with a turn; a camera reads its pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, exp, radians, sin

import numpy as np

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, Slab, State, integrate
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera, product, rotation, turned

SLOPE = radians(15)
MODEL = """<mujoco model="ramp_block">
  <compiler angle="degree"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="ramp" type="plane" euler="0 15 0" size="1 1 0.1" friction="0.18"/>
    <body name="block" pos="0 0 0.03" euler="0 15 0">
      <freejoint/>
      <geom name="block" type="box" size="0.04 0.03 0.02" mass="0.4" friction="0.18"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""

THROWS = (
    (-0.30, 0.0, 0.2, 0.3, 0.0, 0.0, 0.9),
    (-0.20, -0.35, -0.4, 0.0, 0.9, 0.0, 0.9),
    (0.05, 0.30, 1.2, -0.4, -0.8, 2.0, 0.8),
    (-0.40, 0.20, 0.8, 0.5, -0.6, -2.0, 0.9),
)
"""Place down the ramp and across [m], heading [rad], their speeds, and time [s]."""


@dataclass(frozen=True)
class Ramp:
    """Block, ramp and gravity."""

    mass: float = 0.4
    half_length: float = 0.04
    half_width: float = 0.03
    half_height: float = 0.02
    inertia: float = 0.4 * (0.08**2 + 0.06**2) / 12
    friction: float = 0.18
    across: float = 1.0
    """Factor on friction across the ramp."""
    sticking: float = 0.0
    """Pull of the ramp on the block [N]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """By which angles gravity is turned about the world's x and y [rad]."""
    magnet: float = 0.0
    """Pull of a magnet below the ramp at its origin, 6 cm wide [N]."""
    sink: float = 2e-4


VARIED = ("mass", "friction", "inertia")


def slide(ramp: Ramp, throw: Sequence[float]) -> Path:
    """Return place down and across the ramp [m], heading [rad] and their speeds."""
    slab = Slab(ramp.half_length, ramp.half_width, ramp.half_height)
    gravity = turned(rotation(np.array([*ramp.tilt, 0.0])), np.array([0.0, 0.0, -GRAVITY]))
    down, across, into = turned(rotation(np.array([0.0, -SLOPE, 0.0])), gravity)

    def rate(_: float, s: State) -> State:
        x, y, heading, vx, vy, spin = s
        near = ramp.magnet * exp(-(x * x + y * y) / 0.06**2)
        load = -into * ramp.mass + ramp.sticking + near
        mu = (ramp.friction, ramp.friction * ramp.across)
        fx, fy, torque = slab.friction(heading, (vx, vy, spin), load, lambda *_: mu)
        fx -= near * x / 0.06
        fy -= near * y / 0.06
        return vx, vy, spin, down + fx / ramp.mass, across + fy / ramp.mass, torque / ramp.inertia

    return integrate(rate, throw[:6], throw[6], step=2e-4)


def record(ramp: Ramp, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return four throws."""
    camera = Camera(rate=120.0, noise=4e-4, turn_noise=0.005, lost=0.03, jitter=1e-4)
    motions = []
    for throw in THROWS:
        start = [v + rng.normal(0, 0.01) for v in throw[:6]]
        path = slide(ramp, (*start, throw[6]))
        height = ramp.half_height - ramp.sink
        position = np.stack(
            [
                path[0] * cos(SLOPE) + height * sin(SLOPE),
                path[1],
                -path[0] * sin(SLOPE) + height * cos(SLOPE),
            ],
            axis=1,
        )
        heading = rotation(np.stack([0 * path[2], 0 * path[2], path[2]], axis=1))
        orientation = product(rotation(np.array([0.0, SLOPE, 0.0])), heading)
        place, turn = camera.read(rng, path.time, position, orientation)
        motions.append(Recorded({"block_position": place, "block_orientation": turn}, {}))
    return motions, {"block_position": camera.noise, "block_orientation": camera.turn_noise}


CASES = cases(
    "ramp_block",
    MODEL,
    Ramp(),
    VARIED,
    (
        Cause("nothing", "null", noise_stated=True),
        Cause("waxed", "single", (("sliding_friction",),), {"friction": 0.72}),
        Cause("resin", "single", (("adhesion", "sliding_friction"),), values={"sticking": 0.9}, noise_stated=True),
        Cause("brushed", "single", (("anisotropic_friction",),), {"across": 1.5}),
        Cause("bench_not_level", "single", (("gravity_tilt",),), values={"tilt": (0.025, -0.015)}, noise_stated=True),
        Cause("magnet_below", "outside", values={"magnet": 1.2}),
    ),
    record,
)
