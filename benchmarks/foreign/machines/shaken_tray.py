"""A box stands on a tray that two drives shake in its plane; encoders read the tray, a camera the box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, Slab, State, integrate
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera, Command, Encoder, command_times, rotation, smooth_step

MODEL = """<mujoco model="shaken_tray">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <body name="carriage" pos="0 0 0.45">
      <joint name="x" type="slide" axis="1 0 0" damping="10"/>
      <geom name="carriage" type="box" size="0.05 0.05 0.02" mass="0.8" contype="0" conaffinity="0"/>
      <body name="tray" pos="0 0 0.04">
        <joint name="y" type="slide" axis="0 1 0" damping="10"/>
        <geom name="tray" type="box" size="0.25 0.25 0.01" mass="1.2" friction="0.3"/>
      </body>
    </body>
    <body name="box" pos="0.1 -0.05 0.52">
      <freejoint/>
      <geom name="box" type="box" size="0.05 0.035 0.02" mass="0.5" friction="0.3"/>
    </body>
  </worldbody>
  <actuator>
    <position name="x" joint="x" kp="3000" kv="120"/>
    <position name="y" joint="y" kp="3000" kv="120"/>
  </actuator>
  <sensor>
    <jointpos name="x_encoder" joint="x"/>
    <jointpos name="y_encoder" joint="y"/>
    <framepos name="box_position" objtype="xbody" objname="box"/>
    <framequat name="box_orientation" objtype="xbody" objname="box"/>
  </sensor>
</mujoco>
"""

BOX = (0.1, -0.05, 0.52)
"""Where the box stands [m]."""
SHAKES = ((0.05, 0.0, 1.8, 0.0), (0.0, 0.06, 1.6, 0.0), (0.04, 0.04, 1.9, 1.3))
"""Amplitudes along x and y [m], frequency [Hz], and by how much y is ahead [rad]."""
DURATION = 2.1


@dataclass(frozen=True)
class Tray:
    """Tray, drives, box and camera."""

    carriage: float = 0.8
    tray: float = 1.2
    damping: float = 10.0
    kp: float = 3000.0
    kv: float = 120.0
    box: float = 0.5
    friction: float = 0.3
    delay: float = 0.0
    scale: float = 0.0
    soap: float = 1.0
    """Factor on friction on the part of the tray with x beyond 0.1 m."""
    sink: float = 2e-4


VARIED = ("carriage", "tray", "damping", "kp", "kv", "box", "friction")


def shake(tray: Tray, commands: tuple[Command, Command], duration: float = DURATION) -> Path:
    """Return place of the tray, place and heading of the box, and their speeds."""
    slab = Slab(0.05, 0.035, 0.02)
    moment = tray.box * (0.1**2 + 0.07**2) / 12
    heavy = tray.carriage + tray.tray
    kv = tray.kv + tray.damping

    def rate(t: float, s: State) -> State:
        x, y, bx, _, heading, vx, vy, bvx, bvy, spin = s

        def mu(foot: float, _: float) -> tuple[float, float]:
            value = tray.friction * (tray.soap if bx + foot - x > 0.1 else 1.0)
            return value, value

        slip = (bvx - vx, bvy - vy, spin)
        fx, fy, torque = slab.friction(heading, slip, tray.box * GRAVITY, mu)
        ux, uy = (c(t - tray.delay) for c in commands)
        ax = (tray.kp * (ux - x) - kv * vx - fx) / heavy
        ay = (tray.kp * (uy - y) - kv * vy - fy) / tray.tray
        return vx, vy, bvx, bvy, spin, ax, ay, fx / tray.box, fy / tray.box, torque / moment

    return integrate(rate, (0.0, 0.0, BOX[0], BOX[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), duration, step=2e-4)


def set_points(wave: Sequence[float]) -> tuple[Command, Command]:
    """Return what the drives are told."""
    along_x, along_y, frequency, ahead = wave
    t = command_times(DURATION, 200.0)
    swell = smooth_step((t - 0.1) / 0.6)
    phase = 2 * np.pi * frequency * (t - 0.1)
    return Command(t, along_x * swell * np.sin(phase)), Command(t, along_y * swell * np.sin(phase + ahead))


def record(tray: Tray, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return three ways of shaking."""
    encoder = Encoder(rate=200.0, step=1e-5, noise=3e-5)
    camera = Camera(rate=90.0, noise=4e-4, turn_noise=0.004, lost=0.02, scale=tray.scale)
    motions = []
    for wave in SHAKES:
        x, y = set_points(wave)
        path = shake(tray, (x, y))
        position = np.stack([path[2], path[3], np.full(len(path.time), BOX[2] - tray.sink)], axis=1)
        heading = rotation(np.stack([0 * path[4], 0 * path[4], path[4]], axis=1))
        place, turn = camera.read(rng, path.time, position, heading)
        measured = {
            "x_encoder": encoder.read(rng, path.time, path[0]),
            "y_encoder": encoder.read(rng, path.time, path[1]),
            "box_position": place,
            "box_orientation": turn,
        }
        motions.append(Recorded(measured, {"x": x.table(), "y": y.table()}))
    noise = {
        "x_encoder": encoder.deviation,
        "y_encoder": encoder.deviation,
        "box_position": camera.noise,
        "box_orientation": camera.turn_noise,
    }
    return motions, noise


CASES = cases(
    "shaken_tray",
    MODEL,
    Tray(),
    VARIED,
    (
        Cause("nothing", "null"),
        Cause("greasy", "single", (("sliding_friction",),), {"friction": 0.75}, noise_stated=True),
        Cause("slow_bus", "single", (("actuator_delay", "latency"),), values={"delay": 0.008}),
        Cause("camera_not_scaled", "single", (("length_scale",),), values={"scale": 0.03}, noise_stated=True),
        Cause("heavy_box", "single", (("mass",),), {"box": 3.0}),
        Cause("soap_on_one_side", "outside", values={"soap": 0.8}, noise_stated=True),
    ),
    record,
)
