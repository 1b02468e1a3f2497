"""A finger on a slide pushes a door open and lets it swing on; an encoder reads the one, a potentiometer the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, exp, sin

import numpy as np

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, State, friction_1d, integrate, normal_force
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Command, Encoder, command_times, rotation, smooth_step, turned

MODEL = """<mujoco model="door_push">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <body name="door" pos="0 0 0.1">
      <joint name="hinge" type="hinge" axis="0 0 1" damping="0.3" frictionloss="0.2"/>
      <geom name="door" type="box" pos="0.3 0 0.4" size="0.3 0.015 0.4" mass="6"/>
    </body>
    <body name="finger" pos="0.45 -0.028 0.5">
      <joint name="push" type="slide" axis="0 1 0" range="-0.2 0.5" damping="4"/>
      <geom name="rod" type="capsule" fromto="0 -0.3 0 0 -0.02 0" size="0.008" mass="0.68" contype="0" conaffinity="0"/>
      <geom name="roller" type="sphere" size="0.01" mass="0.02" condim="1" priority="1" solref="0.004 1"/>
    </body>
  </worldbody>
  <actuator><position name="push" joint="push" kp="800" kv="70"/></actuator>
  <sensor>
    <jointpos name="push_encoder" joint="push"/>
    <jointpos name="hinge_angle" joint="hinge"/>
  </sensor>
</mujoco>
"""

REACH = 0.45
"""From the hinge to the finger's line [m]."""
START = -0.028
THICKNESS, ROLLER = 0.015, 0.01
"""Half thickness of the door and radius of the roller [m]."""
STIFFNESS, DAMPING = 4e4, 20.0
DURATION = 3.6
PUSHES = ((0.22, 0.7), (0.15, 0.8), (0.26, 1.0))
"""Way [m] and time [s]."""


@dataclass(frozen=True)
class Door:
    """Door, hinge and finger."""

    mass: float = 6.0
    width: float = 0.6
    damping: float = 0.3
    friction: float = 0.2
    finger: float = 0.7
    finger_damping: float = 4.0
    kp: float = 800.0
    kv: float = 70.0
    gain: float = 1.0
    spring: float = 0.0
    preload: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    """By which angles gravity is turned about x and y [rad]."""
    catch: float = 0.0
    """Torque of a magnetic catch on the closed door [N m]."""


VARIED = ("mass", "damping", "friction", "finger", "finger_damping", "kp", "kv")


def swing(door: Door, command: Command, duration: float = DURATION) -> Path:
    """Return way and speed of the finger, angle and speed of the door."""
    moment = door.mass * (door.width**2 / 3 + (2 * THICKNESS) ** 2 / 12)
    pull = door.mass * turned(rotation(np.array([*door.tilt, 0.0])), np.array([0.0, 0.0, -GRAVITY]))
    pull_x, pull_y = float(pull[0]), float(pull[1])

    def rate(t: float, s: State) -> State:
        way, v, angle, turn = s
        c, n = cos(angle), sin(angle)
        y = START + way
        along, beside = REACH * c + y * n, -REACH * n + y * c
        depth = THICKNESS + ROLLER + beside
        force = normal_force(depth, v * c - turn * along, STIFFNESS, DAMPING)
        torque = force * along - door.damping * turn + friction_1d(turn, door.friction)
        torque += door.preload - door.spring * angle
        torque += door.width / 2 * (c * pull_y - n * pull_x)
        if door.catch:
            torque -= door.catch * exp(-max(angle, 0.0) / 0.12)
            torque += max(0.0, -3000 * angle - 30 * turn) if angle < 0 else 0.0
        drive = door.gain * (door.kp * (command(t) - way) - door.kv * v)
        return v, (drive - door.finger_damping * v - force * c) / door.finger, turn, torque / moment

    return integrate(rate, (0.0, 0.0, 0.0, 0.0), duration)


def record(door: Door, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return three pushes."""
    linear = Encoder(rate=200.0, step=1e-4, noise=1e-4)
    angular = Encoder(rate=200.0, step=2 * np.pi / 4096, noise=1.5e-3)
    motions = []
    for way, time in PUSHES:
        t = command_times(DURATION)
        command = Command(t, way * smooth_step((t - 1.0) / time))
        path = swing(door, command)
        measured = {
            "push_encoder": linear.read(rng, path.time, path[0]),
            "hinge_angle": angular.read(rng, path.time, path[2], "angle"),
        }
        motions.append(Recorded(measured, {"push": command.table()}))
    return motions, {"push_encoder": linear.deviation, "hinge_angle": angular.deviation}


CASES = cases(
    "door_push",
    MODEL,
    Door(),
    VARIED,
    (
        Cause("nothing", "null", noise_stated=True),
        Cause("tight_hinge", "single", (("joint_friction",),), {"friction": 1.5}),
        Cause("heavy_door", "single", (("mass", "inertia", "armature"),), {"mass": 1.2}, noise_stated=True),
        Cause(
            "door_closer",
            "single",
            (("joint_stiffness", "gravity_tilt"),),
            values={"spring": 0.06, "preload": -0.03},
            noise_stated=True,
        ),
        Cause(
            "leaning_frame_weak_drive",
            "pair",
            (("gravity_tilt", "joint_stiffness"), ("actuator_gain",)),
            {"gain": 0.7},
            {"tilt": (-0.009, 0.005)},
        ),
        Cause("magnetic_catch", "outside", values={"catch": 3.0}),
    ),
    record,
)
