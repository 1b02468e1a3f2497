"""Recordings that no engine of the library made: equations of motion written out and integrated by SciPy.

Each has what a stranger's log has: a clock of its own, noise that is not stated, and states that are not all measured.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from concent_warp.recording.recording import Channel, Demonstration, Recording

GRAVITY = 9.81
"""[m/s^2]."""

PUSHER = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="upper" pos="0 0 0.2">
      <joint name="shoulder" type="hinge" axis="0 0 1" damping="0.05"/>
      <inertial pos="0.15 0 0" mass="0.8" diaginertia="0.006 0.006 0.006"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0" contype="0" conaffinity="0"/>
      <body name="fore" pos="0.3 0 0">
        <joint name="elbow" type="hinge" axis="0 0 1" damping="0.05"/>
        <inertial pos="0.12 0 0" mass="0.5" diaginertia="0.0025 0.0025 0.0025"/>
        <geom type="capsule" fromto="0 0 0 0.24 0 0" size="0.02" mass="0" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="12" kv="0.6"/>
    <position name="elbow" joint="elbow" kp="6" kv="0.25"/>
  </actuator>
  <sensor>
    <jointpos name="shoulder_position" joint="shoulder"/>
    <jointpos name="elbow_position" joint="elbow"/>
  </sensor>
</mujoco>
"""
PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="hinge" axis="0 1 0"/>
      <inertial pos="0 0 -0.25" mass="0.4" diaginertia="0.0085 0.0085 0.0005"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
</mujoco>
"""
BALL = """
<mujoco>
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body name="ball" pos="0 0 1">
      <freejoint/>
      <geom type="sphere" size="0.0365" mass="0.012" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <sensor><framepos name="ball_position" objtype="xbody" objname="ball"/></sensor>
</mujoco>
"""


def _integrated(
    rates: Callable[[float, np.ndarray], np.ndarray], state: list[float], time: np.ndarray, step: float, late: float = 0
) -> np.ndarray:
    """Return the states at some times, shape (T, S), of an equation whose commands change every `step` [s].

    Commands change at multiples of the step plus `late` [s]; each span between two changes is integrated by itself.
    """
    edges = np.concatenate([[0.0], np.arange(late % step or step, time[-1], step), [time[-1] + 1e-9]])
    found, y = [], np.asarray(state)
    for begin, end in pairwise(edges):
        inside = time[(time >= begin - 1e-12) & (time < end - 1e-12)]
        middle = (begin + end) / 2
        span = solve_ivp(
            lambda _, y, t=middle: rates(t, y),
            (begin, end),
            y,
            t_eval=[*np.maximum(inside, begin), end],
            rtol=1e-8,
            atol=1e-10,
        )
        assert span.success
        found.append(span.y[:, :-1])
        y = span.y[:, -1]
    return np.concatenate(found, axis=1).T


@cache
def pusher(
    damping: float = 0.15, delay: float = 0.02, *, noise: float = 1e-3, seconds: float = 6.0, late: float = 0.0
) -> Recording:
    """Return the log of a two-joint arm in the plane; its model has damping 0.05 N m s/rad and no delay.

    The motion is a sum of sines; the arm never rests.

    Args:
        damping: Of both joints [N m s/rad].
        delay: Time from a command to its effect [s].
        noise: Standard deviation of the angles [rad].
        seconds: Length.
        late: Latency of the elbow's encoder alone [s].
    """
    rng = np.random.default_rng(5)
    period = 0.01
    at = np.arange(0.0, seconds, period)
    target = np.stack(
        [
            0.6 * np.sin(2.1 * at) + 0.25 * np.sin(5.3 * at + 0.7) - 0.25 * np.sin(0.7),
            0.5 * np.sin(3.1 * at) - 0.3 * np.sin(6.7 * at),
        ],
        axis=1,
    )
    kp, kv = np.array([12.0, 6.0]), np.array([0.6, 0.25])
    length, c1, c2, m1, m2, i1, i2 = 0.3, 0.15, 0.12, 0.8, 0.5, 0.006, 0.0025

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:2], y[2:]
        row = int(np.floor((t - delay) / period + 1e-9))
        command = target[min(row, len(target) - 1)] if row >= 0 else np.zeros(2)
        torque = kp * (command - q) - kv * v - damping * v
        cross = m2 * length * c2
        mass = np.array(
            [
                [i1 + i2 + m1 * c1**2 + m2 * (length**2 + c2**2) + 2 * cross * np.cos(q[1]), 0.0],
                [i2 + m2 * c2**2 + cross * np.cos(q[1]), i2 + m2 * c2**2],
            ]
        )
        mass[0, 1] = mass[1, 0]
        bend = cross * np.sin(q[1])
        coriolis = np.array([-bend * (2 * v[0] * v[1] + v[1] ** 2), bend * v[0] ** 2])
        return np.concatenate([v, np.linalg.solve(mass, torque - coriolis)])

    time = np.arange(late, seconds - 0.02, 0.008)
    angles = _integrated(rates, [0.0] * 4, time, period, delay)[:, :2]
    if late:
        angles[:, 1] = _integrated(rates, [0.0] * 4, time - late, period, delay)[:, 1]
    angles += rng.normal(0, noise, angles.shape)
    demonstration = Demonstration(
        "demo_0",
        qpos=np.zeros(2),
        qvel=np.zeros(2),
        action={"shoulder": Channel(at, target[:, 0]), "elbow": Channel(at, target[:, 1])},
        measured={
            "shoulder_position": Channel(time, angles[:, :1]),
            "elbow_position": Channel(time, angles[:, 1:]),
        },
    )
    return Recording(PUSHER, (demonstration,))


@cache
def swing_up(coulomb: float = 0.03, viscous: float = 0.01, *, noise: float = 1.5e-3, seconds: float = 8.0) -> Recording:
    """Return the log of a pendulum that a motor swings up in growing swings; its model has no friction at all.

    Args:
        coulomb: Friction torque [N m].
        viscous: Damping [N m s/rad].
        noise: Standard deviation of the angle, which comes in steps of 2 pi / 4096 besides [rad].
        seconds: Length.
    """
    rng = np.random.default_rng(11)
    mass, reach, inertia, period = 0.4, 0.25, 0.0085 + 0.4 * 0.25**2, 0.005
    at = np.arange(0.0, seconds, period)
    command = np.zeros(len(at))

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        torque = command[min(int(t / period + 1e-9), len(at) - 1)]
        friction = coulomb * np.tanh(y[1] / 5e-3) + viscous * y[1]
        return np.array([y[1], (torque - friction - mass * GRAVITY * reach * np.sin(y[0])) / inertia])

    state = np.array([0.05, 0.0])
    for k in range(len(at)):  # the controller pumps energy, as swing-up controllers do, and stops near the top
        energy = 0.5 * inertia * state[1] ** 2 + mass * GRAVITY * reach * (1 - np.cos(state[0]))
        short = np.clip(2 * mass * GRAVITY * reach - energy, 0.0, 1.0)
        command[k] = 0.35 * np.sign(state[1] + 1e-9) * short
        state = solve_ivp(rates, (at[k], at[k] + period), state, rtol=1e-8, atol=1e-10).y[:, -1]
    time = np.arange(0.0, seconds - 0.02, 0.01)
    angle = _integrated(rates, [0.05, 0.0], time, period)[:, :1] + rng.normal(0, noise, (len(time), 1))
    resolution = 2 * np.pi / 4096
    demonstration = Demonstration(
        "demo_0",
        action={"motor": Channel(at, command)},
        measured={"angle": Channel(time, resolution * np.round(angle / resolution))},
    )
    return Recording(PENDULUM, (demonstration,))


@cache
def thrown_ball(drag: float = 0.5, *, noise: float = 1e-3, heights_only: bool = False, throws: int = 3) -> Recording:
    """Return tracks of a light ball in the air, by position alone; its model has no drag.

    Args:
        drag: Drag coefficient [-].
        noise: Standard deviation of a coordinate [m].
        heights_only: Whether x and y were not measured.
        throws: Number of throws.
    """
    rng = np.random.default_rng(3)
    mass, radius, density = 0.012, 0.0365, 1.2
    resistance = 0.5 * density * drag * np.pi * radius**2 / mass

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        v = y[3:]
        return np.concatenate([v, np.array([0, 0, -GRAVITY]) - resistance * np.linalg.norm(v) * v])

    found = []
    for k in range(throws):
        time = 0.013 * k / throws + np.arange(0.0, 0.9, 1 / 120)
        speed = np.array([2.0 + k, 0.5 * k - 0.4, 3.5 + 0.5 * k])
        start = np.array([0.1 * k, 0.0, 1.2])
        place = _integrated(rates, [*start, *speed], time, 0.05)[:, :3] + rng.normal(0, noise, (len(time), 3))
        if heights_only:
            place[:, :2] = np.nan
        found.append(Demonstration(f"demo_{k}", measured={"ball_position": Channel(time, place)}))
    return Recording(BALL, tuple(found))


def write_csv(recording: Recording, folder: Path) -> Path:
    """Write a recording as a folder of CSV files, without the noise that it may state, and return the folder."""
    folder.mkdir(parents=True)
    (folder / "scene.xml").write_text(recording.scene)
    for d in recording.demonstrations:
        inside = folder / d.name
        inside.mkdir()
        for kind, channels in (("measured", d.measured), ("action", d.action)):
            for name, channel in channels.items():
                values = channel.value.reshape(len(channel.time), -1)
                with (inside / f"{kind}_{name}.csv").open("w", newline="") as file:
                    out = csv.writer(file)
                    out.writerow(["time", *(f"v{i}" for i in range(values.shape[1]))])
                    for t, row in zip(channel.time, values, strict=True):
                        out.writerow([f"{t:.6f}", *("" if np.isnan(v) else f"{v:.6f}" for v in row)])
    return folder
