"""Two fingers grasp a block, lift it, let it slip a little and shake it; a camera reads the block's pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, State, integrate, normal_force
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera, Command, Encoder, command_times, smooth_step

MODEL = """<mujoco model="gripper_lift">
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="50"/>
  <default><default class="pad">
    <geom type="box" size="0.005 0.015 0.015" mass="0.1" friction="0.5" priority="1" solref="0.005 1"/>
  </default></default>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="hand" pos="0 0 0.03" gravcomp="1">
      <joint name="lift" type="slide" axis="0 0 1" range="-0.02 0.3"/>
      <geom name="hand" type="box" pos="0 0 0.12" size="0.07 0.03 0.03" mass="1" contype="0" conaffinity="0"/>
      <body name="left_finger" pos="-0.05 0 0" gravcomp="1">
        <joint name="left" type="slide" axis="1 0 0" damping="20"/>
        <geom name="left_pad" class="pad"/>
      </body>
      <body name="right_finger" pos="0.05 0 0" gravcomp="1">
        <joint name="right" type="slide" axis="-1 0 0" damping="20"/>
        <geom name="right_pad" class="pad"/>
      </body>
    </body>
    <body name="block" pos="0 0 0.03">
      <freejoint/>
      <geom name="block" type="box" size="0.02 0.02 0.03" mass="0.3"/>
    </body>
  </worldbody>
  <actuator>
    <position name="lift" joint="lift" kp="2500" kv="120"/>
    <motor name="left" joint="left" ctrlrange="-20 20"/>
    <motor name="right" joint="right" ctrlrange="-20 20"/>
  </actuator>
  <sensor>
    <jointpos name="lift_encoder" joint="lift"/>
    <jointpos name="left_encoder" joint="left"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""

DURATION = 3.6
RUNS = ((6.0, 1.5, 0.10, 0.030), (7.0, 1.0, 0.08, 0.025))
"""Force of the grasp and while it slips [N], for how long it slips [s], amplitude of the shaking [m]."""
CLOSED = 0.025
"""Way of a finger to the block [m]."""
TABLE = (1e5, 20.0)
PAD = (1e5, 20.0)
SHEAR, SHEAR_DAMPING = 6e4, 30.0
"""Stiffness [N/m] and damping [N s/m] of a pad along its face, before it slips."""


@dataclass(frozen=True)
class Gripper:
    """Hand, fingers and block."""

    hand: float = 1.2
    """Mass with fingers [kg]."""
    finger: float = 0.1
    finger_damping: float = 20.0
    block: float = 0.3
    friction: float = 0.5
    grip: float = 1.0
    kp: float = 2500.0
    kv: float = 120.0
    latency: float = 0.0
    thread: float = 0.0
    """Stiffness of a thread that ties the block to the table [N/m]."""
    slack: float = 0.06
    """Height of the block at which the thread is taut [m]."""
    sink: float = 2e-4


VARIED = ("hand", "finger", "finger_damping", "block", "friction", "grip", "kp", "kv")


def lift(gripper: Gripper, height: Command, force: Command, duration: float = DURATION) -> Path:
    """Return height of the hand, that of the block from the table, way of a finger, and their speeds.

    Friction of the pads is a spring that slips at Coulomb's limit, with damping at rest.
    """

    def rate(t: float, s: State) -> State:
        z, vz, block, block_v, way, v, shear = s
        press = normal_force(way - CLOSED, v, *PAD)
        limit = 2 * gripper.friction * press
        slip = block_v - vz
        if limit > 0.02:
            use = SHEAR * shear / limit
            held = min(1.0, max(-1.0, use))
            # A pad that is let go slips at once: its shear falls to what the lower force holds.
            shear_rate = (0.0 if abs(use) >= 1.0 and use * slip > 0.0 else slip) - 2000.0 * (
                shear - held * limit / SHEAR
            )
            hold = -limit * held - SHEAR_DAMPING * slip * (1 - abs(held))
        else:
            hold, shear_rate = 0.0, -100 * shear
        table = normal_force(gripper.sink / 2 - block, -block_v, *TABLE)
        thread = gripper.thread * max(0.0, block - gripper.slack)
        drive = gripper.kp * (height(t) - z) - gripper.kv * vz
        squeeze = gripper.grip * force(t)
        return (
            vz,
            (drive - hold) / gripper.hand,
            block_v,
            (hold + table - thread) / gripper.block - GRAVITY,
            v,
            (squeeze - gripper.finger_damping * v - press) / gripper.finger,
            shear_rate,
        )

    return integrate(rate, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), duration)


def commands(run: Sequence[float]) -> tuple[Command, Command]:
    """Return height of the hand and force of each finger."""
    grasp, loose, slip, amplitude = run
    t = command_times(DURATION)
    shake = amplitude * np.sin(2 * np.pi * 2.0 * (t - 2.6)) * smooth_step((t - 2.6) / 0.3)
    height = 0.15 * smooth_step((t - 0.8) / 0.8) + np.where(t > 2.6, shake, 0.0)
    force = np.where(t < 0.2, 0.0, grasp)
    force = np.where(t >= 1.995, np.where(t < 1.995 + slip, loose, 8.0), force)
    return Command(t, height), Command(t, force)


def record(gripper: Gripper, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return two grasps."""
    encoder = Encoder(rate=250.0, step=2e-5, noise=3e-5)
    camera = Camera(rate=90.0, noise=4e-4, turn_noise=0.006, lost=0.02, latency=gripper.latency)
    motions = []
    for run in RUNS:
        height, force = commands(run)
        path = lift(gripper, height, force)
        zero = 0 * path[2]
        place, turn = camera.read(rng, path.time, np.stack([zero, zero, 0.03 + path[2] - gripper.sink / 2], axis=1))
        measured = {
            "lift_encoder": encoder.read(rng, path.time, path[0]),
            "left_encoder": encoder.read(rng, path.time, path[4]),
            "block_position": place,
            "block_orientation": turn,
        }
        actions = {"lift": height.table(), "left": force.table(), "right": force.table()}
        motions.append(Recorded(measured, actions))
    noise = {
        "lift_encoder": encoder.deviation,
        "left_encoder": encoder.deviation,
        "block_position": camera.noise,
        "block_orientation": camera.turn_noise,
    }
    return motions, noise


CASES = cases(
    "gripper_lift",
    MODEL,
    Gripper(),
    VARIED,
    (
        Cause("nothing", "null"),
        Cause("oily_pads", "single", (("pad_friction", "sliding_friction"),), {"friction": 0.68}, noise_stated=True),
        Cause("weak_motors", "single", (("grip_force", "actuator_gain"),), {"grip": 0.72}),
        Cause("heavy_block", "single", (("mass",),), {"block": 1.35}, noise_stated=True),
        Cause("heavy_block_late_camera", "pair", (("mass",), ("latency",)), {"block": 1.3}, {"latency": 0.035}),
        Cause("tied_to_the_table", "outside", values={"thread": 14.0}, noise_stated=True),
    ),
    record,
)
