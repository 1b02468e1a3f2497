"""A block with three different moments of inertia is thrown and caught; a camera reads its pose in flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, State, integrate
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera, turned

MODEL = """<mujoco model="tossed_block">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 0.1"/>
    <body name="block" pos="0 0 1">
      <freejoint/>
      <geom name="block" type="box" size="0.1 0.06 0.02" mass="0.6"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""

THROWS = (
    (0.0, 0.0, 1.0, 0.8, 0.1, 2.9, 6.0, 1.0, 2.0),
    (0.1, -0.1, 1.1, -0.7, 0.3, 2.7, 1.0, 7.0, -0.5),
    (-0.2, 0.0, 1.0, 0.5, -0.6, 3.0, -2.0, 0.5, 8.0),
    (0.0, 0.2, 0.9, 0.1, -0.5, 3.1, 4.0, -4.0, 3.0),
    (0.0, 0.0, 1.0, -0.4, 0.4, 2.8, -5.0, 0.3, -4.0),
)
"""Place of the centre of mass [m], velocity [m/s] and angular velocity along the block's axes [rad/s]."""
DURATION = 0.62


@dataclass(frozen=True)
class Block:
    """The block."""

    inertia_x: float = 0.6 * (0.12**2 + 0.04**2) / 12
    inertia_y: float = 0.6 * (0.2**2 + 0.04**2) / 12
    inertia_z: float = 0.6 * (0.2**2 + 0.12**2) / 12
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of mass, from the middle of the block [m]."""
    wheel: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Angular momentum of a wheel that spins inside, along the block's axes [N m s]."""
    clock: float = 0.0


VARIED = ("inertia_x", "inertia_y", "inertia_z")


def fly(block: Block, throw: Sequence[float], duration: float = DURATION) -> Path:
    """Return quaternion and angular velocity along the block's axes, by Euler's equations."""
    ix, iy, iz = block.inertia_x, block.inertia_y, block.inertia_z
    hx, hy, hz = block.wheel

    def rate(_: float, s: State) -> State:
        a, b, c, d, p, q, r = s
        lx, ly, lz = ix * p + hx, iy * q + hy, iz * r + hz
        return (
            0.5 * (-b * p - c * q - d * r),
            0.5 * (a * p + c * r - d * q),
            0.5 * (a * q + d * p - b * r),
            0.5 * (a * r + b * q - c * p),
            (ly * r - lz * q) / ix,
            (lz * p - lx * r) / iy,
            (lx * q - ly * p) / iz,
        )

    return integrate(rate, (1.0, 0.0, 0.0, 0.0, *throw[6:]), duration, step=5e-4)


def record(block: Block, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return five throws."""
    camera = Camera(rate=120.0, noise=4e-4, turn_noise=0.005, lost=0.03, jitter=5e-5, clock=block.clock)
    motions = []
    for throw in THROWS:
        thrown = [v + rng.normal(0, 0.05) for v in throw]
        path = fly(block, thrown)
        t = path.time[:, None]
        mass_centre = np.array(thrown[:3]) + np.array(thrown[3:6]) * t - np.array([0.0, 0.0, GRAVITY / 2]) * t**2
        orientation = path.state[:, :4]
        middle = mass_centre - turned(orientation, np.tile(block.centre, (len(t), 1)))
        place, turn = camera.read(rng, path.time, middle, orientation)
        motions.append(Recorded({"block_position": place, "block_orientation": turn}, {}))
    return motions, {"block_position": camera.noise, "block_orientation": camera.turn_noise}


OTHER_GRAVITY = ("time_base", "length_scale", "gravity_compensation")
"""A free flight shows a wrong clock by its downward acceleration alone."""

CASES = cases(
    "tossed_block",
    MODEL,
    Block(),
    VARIED,
    (
        Cause("nothing", "null"),
        Cause("lead_in_a_corner", "single", (("center_of_mass",),), values={"centre": (0.009, -0.005, 0.0)}),
        Cause("mass_moved_outward", "single", (("inertia",),), {"inertia_x": 1.35}, noise_stated=True),
        Cause("slow_clock", "single", (OTHER_GRAVITY,), values={"clock": -0.02}, noise_stated=True),
        Cause(
            "lead_and_fast_clock",
            "pair",
            (("center_of_mass",), OTHER_GRAVITY),
            values={"centre": (-0.007, 0.004, 0.004), "clock": 0.025},
        ),
        Cause("spinning_wheel_inside", "outside", values={"wheel": (0.0, 0.004, 0.002)}, noise_stated=True),
    ),
    record,
)
