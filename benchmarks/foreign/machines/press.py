"""A vertical ball screw presses a plate on a rubber pad: linear scale, force cell, and a gauge at the plate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, steps
from benchmarks.foreign.log import Case
from benchmarks.foreign.readings import smooth_step

MODEL = """
<mujoco model="press">
  <option timestep="0.0005" integrator="implicitfast"/>
  <worldbody>
    <geom name="bed" type="box" pos="0 0 -0.02" size="0.1 0.1 0.02" contype="0" conaffinity="0"/>
    <body name="plate" pos="0 0 0.015" gravcomp="1">
      <joint name="pad" type="slide" axis="0 0 1" stiffness="30000" damping="45"/>
      <geom name="plate" type="box" size="0.03 0.03 0.005" mass="0.15" solref="0.002 1" solimp="0.99 0.99 0.001"/>
    </body>
    <body name="ram" pos="0 0 0.06">
      <joint name="ram" type="slide" axis="0 0 1" range="-0.04 0.04" armature="1.5" damping="40" frictionloss="3"
        solreffriction="0.005 1" solimpfriction="0.99 0.99 0.001"/>
      <geom name="ram" type="cylinder" pos="0 0 0.1" size="0.02 0.08" mass="2.5" contype="0" conaffinity="0"/>
      <body name="foot">
        <geom name="foot" type="sphere" size="0.02" mass="0.3" condim="1" solref="0.002 1" solimp="0.99 0.99 0.001"/>
        <site name="cell" pos="0 0 0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="screw" joint="ram" kp="40000" kv="700"/></actuator>
  <sensor>
    <jointpos name="scale" joint="ram"/>
    <jointpos name="gauge" joint="pad"/>
    <force name="force_cell" site="cell"/>
  </sensor>
</mujoco>
"""

GAP = 0.02
"""From the foot to the plate where the scale reads zero [m]."""
CREEP = 1e-4
"""Speed at which the guide's dry friction is about three quarters of its level [m/s]."""


class Values(NamedTuple):
    """Ram, screw, plate and pad."""

    ram: float = 2.5
    foot: float = 0.3
    rotor: float = 1.5
    """Inertia of motor and screw, as a mass at the nut [kg]."""
    plate: float = 0.15
    kp: float = 4e4
    kv: float = 700.0
    damping: float = 40.0
    friction: float = 3.0
    pad: float = 3e4
    """Stiffness of the pad [N/m]."""
    pad_damping: float = 45.0
    contact: float = 5e8
    """Of foot and plate [N/m^1.5]."""
    contact_damping: float = 12.0
    """The same, by its elastic force [s/m]."""
    nut: float = 6e6
    """Stiffness of nut and thrust bearing [N/m]."""
    nut_damping: float = 1000.0
    play: float = 0.0
    """Of the nut on the screw [m]."""
    relaxing: float = 0.0
    """Stiffness of the pad that fades while it is held [N/m]."""
    fades: float = 0.35
    """Time constant of that [s]."""


@njit(cache=True)
def forces(y: np.ndarray, p: Values) -> tuple[float, float, float]:
    """Return forces on the ram by the nut, on the foot by the plate, and on the plate by the pad, upwards [N].

    The contact is that of Hunt and Crossley (J. Appl. Mech. 42, 1975) with Hertz' exponent. The pad is a spring and a
    damper, and a Maxwell element beside them where it relaxes.
    """
    lead = y[0] - y[1]
    if p.play == 0.0:
        nut = p.nut * lead + p.nut_damping * (y[4] - y[5])
    elif abs(lead) <= p.play / 2:
        nut = 0.0
    else:
        side = 1.0 if lead > 0.0 else -1.0
        push = p.nut * (abs(lead) - p.play / 2) + side * p.nut_damping * (y[4] - y[5])
        nut = side * max(0.0, push)
    depth = y[2] - y[1] - GAP
    press = 0.0
    if depth > 0.0:
        press = max(0.0, p.contact * depth**1.5 * (1.0 + p.contact_damping * (y[6] - y[5])))
    pad = -p.pad * y[2] - p.pad_damping * y[6] - p.relaxing * (y[2] - y[3])
    return nut, press, pad


@njit(cache=True)
def acceleration(y: np.ndarray, p: Values) -> float:
    """Return that of the ram [m/s^2]."""
    nut, press, _ = forces(y, p)
    drag = p.damping * y[5] + p.friction * np.tanh(y[5] / CREEP)
    return (nut + press - drag) / (p.ram + p.foot) - 9.81


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Newton's law: places of screw, ram and plate, of the pad's Maxwell element, and speeds of the first three.

    The plate's place is counted from where its pad carries its weight; the servo's encoder is at the screw.
    """
    nut, press, pad = forces(y, p)
    dy[0], dy[1], dy[2] = y[4], y[5], y[6]
    dy[3] = (y[2] - y[3]) / p.fades
    dy[4] = (p.kp * (u[0] - y[0]) - p.kv * y[4] - nut) / p.rotor
    dy[5] = acceleration(y, p)
    dy[6] = (pad - press) / p.plate


def rest(p: Values, first: np.ndarray) -> np.ndarray:
    """Return the state in which the screw carries the ram."""
    weight = 9.81 * (p.ram + p.foot)
    screw = first[0] - weight / p.kp
    return np.array([screw, screw - weight / p.nut - p.play / 2, 0.0, 0.0, 0.0, 0.0, 0.0])


def cell(states: np.ndarray, p: Values) -> np.ndarray:
    """Return the foot's pull on the ram, upwards, as the cell between them reads it; its other axes are not wired."""
    found = np.full((len(states), 3), np.nan)
    for k, y in enumerate(states):
        _, press, _ = forces(y, p)
        found[k, 2] = p.foot * (acceleration(y, p) + 9.81) - press
    return found


def path(t: np.ndarray, points: list[tuple[float, float, float]]) -> np.ndarray:
    """Return set-points that leave for each height [m] at a time [s] and reach it after another."""
    height, before = np.zeros(len(t)), 0.0
    for start, lasts, to in points:
        height += (to - before) * smooth_step((t - start) / lasts)
        before = to
    return height


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return slow presses that are held, taps, and quick presses by jumps of the set-point."""
    t = clock(5.0, 250)
    low = -0.0178 + rng.uniform(-1e-4, 1e-4)
    deep = -0.0226 + rng.uniform(-1e-4, 1e-4)
    slow = [
        (0.3, 0.5, low), (0.9, 0.5, -0.0210), (2.1, 0.25, low), (2.5, 0.25, deep), (3.7, 0.15, low), (4.2, 0.6, -0.005),
    ]  # fmt: skip
    tap = path(t, [(0.2, 0.5, low), (4.4, 0.5, -0.01)])
    tap -= (
        0.0016
        * (smooth_step((t - 0.8) / 0.3) - smooth_step((t - 4.0) / 0.3))
        * (1 - np.cos(2 * np.pi * (1.6 + 0.35 * (t - 0.8)) * (t - 0.8)))
    )
    quick = path(t, [(0.2, 0.5, -0.0175)]) + steps(
        t, [(0, 0), (0.9, -0.003), (1.5, 0.001), (2.0, -0.0045), (2.8, -0.002), (3.3, -0.005), (3.9, 0.002)]
    )
    return [Motion(5.0, {"screw": Held(t, np.round(c, 6))}) for c in (path(t, slow), tap, quick)]


MACHINE = Machine(
    name="press",
    model=MODEL,
    nominal=Values(),
    lengths=(),
    loose=("damping", "friction", "pad_damping"),
    exact=("play", "relaxing", "fades", "kp", "kv"),
    derivative=derivative,
    rest=rest,
    actuators=("screw",),
    sensors=(
        Sensor("scale", ("m",), 500, 6e-6, lambda y, p: y[:, 1:2], 1e-5),  # noqa: ARG005
        Sensor("gauge", ("m",), 250, 8e-6, lambda y, p: y[:, 2:3], 2e-6),  # noqa: ARG005
        Sensor("force_cell", ("x", "y", "z"), 500, 0.25, cell, 0.05),
    ),
    motions=motions,
    settle=1.0,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True, lost=0.003)),
    MACHINE.case("hard_pad", "single", (("joint_stiffness",),), Hidden(factors={"pad": 1.2}), Habits(lost=0.003)),
    MACHINE.case("gel_pad", "single", (("joint_damping",),), Hidden(factors={"pad_damping": 3.5}), Habits(stated=True)),
    MACHINE.case("worn_nut", "single", (("backlash",),), Hidden(added={"play": 2.5e-4}), Habits(stated=True)),
    MACHINE.case("cell_gain", "single", (("sensor_gain",),), Hidden(gain={"force_cell": 1.07}), Habits(jitter=2e-4)),
    # The force fades over a third of a second while the plate is held: no spring or damper of the library does so.
    MACHINE.case("pad_relaxes", "outside", (), Hidden({"pad": 0.85}, {"relaxing": 9e3})),
)
