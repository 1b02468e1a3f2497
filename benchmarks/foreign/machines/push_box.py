"""A finger on a slide pushes a box along a table and lets it slide on; an encoder and a camera watch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, State, friction_1d, integrate, normal_force
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera, Command, Encoder, command_times, smooth_step

MODEL = """<mujoco model="push_box">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="1 0.5 0.1" friction="0.35"/>
    <body name="finger" pos="0 0 0.03">
      <joint name="push" type="slide" axis="1 0 0" range="-0.05 0.6" damping="5"/>
      <geom name="rod" type="box" pos="-0.07 0 0.04" size="0.06 0.01 0.01" mass="0.78" contype="0" conaffinity="0"/>
      <geom name="tip" type="sphere" size="0.01" mass="0.02" condim="1" priority="1" solref="0.004 1"/>
    </body>
    <body name="box" pos="0.073 0 0.03">
      <freejoint/>
      <geom name="box" type="box" size="0.06 0.05 0.03" mass="0.5" friction="0.35"/>
    </body>
  </worldbody>
  <actuator><position name="push" joint="push" kp="1500" kv="60"/></actuator>
  <sensor>
    <jointpos name="push_encoder" joint="push"/>
    <framepos name="box_position" objtype="xbody" objname="box"/>
    <framequat name="box_orientation" objtype="xbody" objname="box"/>
  </sensor>
</mujoco>
"""

GAP = 0.003
"""From the tip to the box at the beginning [m]."""
TIP = 0.01
DURATION = 2.0
STROKES = ((0.26, 0.9), (0.24, 0.42), (0.17, 0.36))
"""Way [m] and time [s] of the pushes."""
TIP_STIFFNESS, TIP_DAMPING = 3e4, 20.0


@dataclass(frozen=True)
class Bench:
    """Finger and box."""

    finger: float = 0.8
    box: float = 0.5
    friction: float = 0.35
    damping: float = 5.0
    kp: float = 1500.0
    kv: float = 60.0
    half_length: float = 0.06
    sink: float = 2e-4
    """By how much the felt under the box is pressed in [m]."""
    lag: float = 0.0
    latency: float = 0.0
    strip: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Part of the table along x [m] on which friction is this factor higher: from, to, factor."""


VARIED = ("finger", "box", "friction", "damping", "kp", "kv")


def push(bench: Bench, command: Command, duration: float = DURATION) -> Path:
    """Return positions and speeds of finger and box, and the lagged set-point."""
    first, last, factor = bench.strip

    def rate(t: float, s: State) -> State:
        x, v, box, box_v, shown = s
        depth = x + TIP - (box - bench.half_length)
        force = normal_force(depth, v - box_v, TIP_STIFFNESS, TIP_DAMPING)
        target = shown if bench.lag else command(t)
        drive = bench.kp * (target - x) - (bench.kv + bench.damping) * v
        mu = bench.friction * (factor if first < box < last else 1.0)
        drag = friction_1d(box_v, mu * bench.box * GRAVITY)
        follow = (command(t) - shown) / bench.lag if bench.lag else 0.0
        return v, (drive - force) / bench.finger, box_v, (force + drag) / bench.box, follow

    return integrate(rate, (0.0, 0.0, bench.half_length + TIP + GAP, 0.0, 0.0), duration)


def stroke(way: float, time: float) -> Command:
    """Return the set-points of a push out and a slower way back."""
    t = command_times(DURATION)
    return Command(t, way * smooth_step((t - 0.2) / time) - (way - 0.02) * smooth_step((t - 0.35 - time) / 0.6))


def record(bench: Bench, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return three pushes."""
    encoder = Encoder(rate=250.0, step=5e-5, noise=8e-5)
    camera = Camera(rate=60.0, noise=4e-4, turn_noise=0.004, lost=0.02, latency=bench.latency)
    motions = []
    for way, time in STROKES:
        command = stroke(way, time)
        path = push(bench, command)
        z = np.full(len(path.time), 0.03 - bench.sink)
        position = np.stack([path[2], 0 * z, z], axis=1)
        place, turn = camera.read(rng, path.time, position)
        measured = {
            "push_encoder": encoder.read(rng, path.time, path[0]),
            "box_position": place,
            "box_orientation": turn,
        }
        motions.append(Recorded(measured, {"push": command.table()}))
    noise = {"push_encoder": encoder.deviation, "box_position": camera.noise, "box_orientation": camera.turn_noise}
    return motions, noise


CASES = cases(
    "push_box",
    MODEL,
    Bench(),
    VARIED,
    (
        Cause("nothing", "null"),
        Cause("dusty_table", "single", (("sliding_friction",),), {"friction": 0.8}, noise_stated=True),
        Cause("filled_box", "single", (("mass",),), {"box": 2.2}),
        Cause("slow_drive", "single", (("actuator_lag",),), values={"lag": 0.015}, noise_stated=True),
        Cause(
            "rough_table_late_camera",
            "pair",
            (("sliding_friction",), ("latency",)),
            {"friction": 1.35},
            {"latency": 0.03},
            noise_stated=True,
        ),
        Cause("sticky_strip", "outside", values={"strip": (0.2, 0.27, 2.2)}),
    ),
    record,
)
