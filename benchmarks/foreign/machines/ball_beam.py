"""A ball rolls on a beam that a servo tilts; a line camera reads where the ball is along the bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, State, friction_1d, integrate
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera, Command, Encoder, command_times

MODEL = """<mujoco model="ball_beam">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <body name="beam" pos="0 0 0.2">
      <joint name="tilt" type="hinge" axis="0 1 0" range="-0.3 0.3" damping="0.05"/>
      <geom name="beam" type="box" size="0.5 0.03 0.01" mass="0.9" friction="0.6"/>
    </body>
    <body name="ball" pos="0 0 0.23">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.02" mass="0.1" friction="0.6"/>
    </body>
  </worldbody>
  <actuator><position name="tilt" joint="tilt" kp="80" kv="4"/></actuator>
  <sensor>
    <jointpos name="tilt_encoder" joint="tilt"/>
    <framepos name="ball_position" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>
"""

PIVOT = 0.2
"""Height of the pivot [m]."""
RUNS = ((-0.15, 0.06, 0.5), (0.10, -0.09, 0.8), (0.0, 0.12, 1.1))
"""Start along the beam [m], amplitude [rad] and frequency [Hz] of the tilt."""
DURATION = 3.0


@dataclass(frozen=True)
class Beam:
    """Beam, ball and drive."""

    mass: float = 0.1
    radius: float = 0.02
    inertia: float = 0.4 * 0.1 * 0.02**2
    half_height: float = 0.01
    beam_inertia: float = 0.9 * (1.0**2 + 0.02**2) / 12
    damping: float = 0.05
    kp: float = 80.0
    kv: float = 4.0
    rolling: float = 0.0
    tilt: float = 0.0
    """By which angle gravity is turned about the pivot's axis [rad]."""
    latency: float = 0.0
    gust: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Push of air on the ball [N], from and to [s]."""


VARIED = ("mass", "inertia", "beam_inertia", "damping", "kp", "kv")


def run(beam: Beam, start: float, command: Command, duration: float = DURATION) -> Path:
    """Return place along the beam, its speed, tilt and its speed; Lagrange's equations of rolling without slip."""
    m, r = beam.mass, beam.radius
    i = beam.inertia
    h = beam.half_height + r
    g_down = GRAVITY * np.cos(beam.tilt)
    g_along = -GRAVITY * np.sin(beam.tilt)
    gust, first, last = beam.gust
    m11 = m + i / r**2
    m12 = m * h + i / r

    def rate(t: float, s: State) -> State:
        x, v, angle, turn = s
        c, n = float(np.cos(angle)), float(np.sin(angle))
        along, normal = g_along * c + g_down * n, g_down * c - g_along * n
        blown = gust if first < t < last else 0.0
        f1 = m * x * turn * turn + m * along + blown + friction_1d(v, beam.rolling * m * normal / r)
        drive = beam.kp * (command(t) - angle) - (beam.kv + beam.damping) * turn
        f2 = m * (x * normal + h * along) + drive - 2 * m * x * v * turn
        m22 = m * (h * h + x * x) + i + beam.beam_inertia
        det = m11 * m22 - m12 * m12
        return v, (m22 * f1 - m12 * f2) / det, turn, (m11 * f2 - m12 * f1) / det

    return integrate(rate, (start, 0.0, 0.0, 0.0), duration, step=2e-4)


def record(beam: Beam, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return three runs."""
    encoder = Encoder(rate=200.0, step=5e-4, noise=3e-4)
    camera = Camera(rate=100.0, noise=6e-4, latency=beam.latency, lost=0.02)
    motions = []
    for start, amplitude, frequency in RUNS:
        t = command_times(DURATION, 200.0)
        command = Command(t, amplitude * np.sin(2 * np.pi * frequency * np.maximum(t - 0.2, 0.0)))
        path = run(beam, start, command)
        h = beam.half_height + beam.radius
        c, s = np.cos(path[2]), np.sin(path[2])
        position = np.stack([path[0] * c + h * s, 0 * c, PIVOT - path[0] * s + h * c], axis=1)
        measured = {
            "tilt_encoder": encoder.read(rng, path.time, path[2], "angle"),
            "ball_position": camera.read(rng, path.time, position, seen="x")[0],
        }
        motions.append(Recorded(measured, {"tilt": command.table()}))
    return motions, {"tilt_encoder": encoder.deviation, "ball_position": camera.noise}


CASES = cases(
    "ball_beam",
    MODEL,
    Beam(),
    VARIED,
    (
        Cause("nothing", "null", noise_stated=True),
        Cause("hollow_ball", "single", (("inertia",),), {"inertia": 1.6}),
        Cause("felt", "single", (("rolling_friction",),), values={"rolling": 1.5e-4}, noise_stated=True),
        Cause("bench_not_level", "single", (("gravity_tilt", "joint_offset"),), values={"tilt": 0.008}),
        Cause("late_camera", "single", (("latency",),), values={"latency": 0.05}, noise_stated=True),
        Cause("puff_of_air", "outside", values={"gust": (0.04, 1.0, 1.5)}),
    ),
    record,
)
