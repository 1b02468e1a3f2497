"""A leg of two links whose hip rides on a vertical rail: squats, scuffs, hops and stamps on a rubber foot.

The constants of the contact in the model are those of a laboratory that tuned them to how far the foot sinks in and how
little it creeps. Names that count:

- The battery at the hip falls with the leg, so that hops show its weight and its inertia: it is mass,
  and no preload of the rail.
- The mat is softer under every load; a smaller foot would sit lower by one length in all of them.
- The cord pulls below one height alone, which no spring on the rail does, since that acts in hops, too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb, lugre
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="leg on a rail">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="50"/>
  <default>
    <geom type="capsule" size="0.018" contype="0" conaffinity="0"/>
    <joint type="hinge" axis="0 -1 0"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" contype="1" conaffinity="1" friction="0.6"/>
    <body name="carriage" pos="0 0 0.42">
      <inertial pos="0 0 0" mass="2.1" diaginertia="0.004 0.004 0.004"/>
      <joint name="rail" type="slide" axis="0 0 1" damping="3" frictionloss="1.2"/>
      <geom type="box" size="0.05 0.05 0.03"/>
      <body name="thigh">
        <inertial pos="0 0 -0.06" mass="0.75" diaginertia="0.004 0.004 0.0006"/>
        <joint name="hip" armature="0.009" damping="0.05" frictionloss="0.12"/>
        <geom fromto="0 0 0 0 0 -0.2"/>
        <body name="shank" pos="0 0 -0.2">
          <inertial pos="0 0 -0.09" mass="0.22" diaginertia="0.0011 0.0011 0.0001"/>
          <joint name="knee" armature="0.009" damping="0.05" frictionloss="0.12"/>
          <geom fromto="0 0 0 0 0 -0.2" size="0.012"/>
          <geom name="foot" type="sphere" size="0.02" pos="0 0 -0.2" contype="1" conaffinity="1" friction="0.6"
            solref="0.005 0.5" solimp="0.6 0.6 0.001"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hip_drive" joint="hip" kp="75" kv="1.6" ctrlrange="-1.5 1.5"/>
    <position name="knee_drive" joint="knee" kp="75" kv="1.6" ctrlrange="-2.6 0"/>
  </actuator>
  <sensor>
    <jointpos name="rail_height" joint="rail"/>
    <jointpos name="hip_position" joint="hip"/>
    <jointpos name="knee_position" joint="knee"/>
  </sensor>
</mujoco>
"""

TALL = 0.42
"""Height of the hip above the floor where the rail reads 0: that of the straight leg [m]."""


class Values(NamedTuple):
    """Values of the rig: 0 is carriage and rail, 1 the thigh and the hip, 2 the shank and the knee."""

    mass0: float = 2.1
    mass1: float = 0.75
    mass2: float = 0.22
    centre1: float = 0.06
    centre2: float = 0.09
    inertia1: float = 0.004
    inertia2: float = 0.0011
    length1: float = 0.2
    length2: float = 0.2
    radius: float = 0.02
    rotor1: float = 0.009
    rotor2: float = 0.009
    damping0: float = 3.0
    damping1: float = 0.05
    damping2: float = 0.05
    friction0: float = 1.2
    friction1: float = 0.12
    friction2: float = 0.12
    kp1: float = 75.0
    kp2: float = 75.0
    kv1: float = 1.6
    kv2: float = 1.6
    ground: float = 6.0e4
    """Stiffness of the foot on the floor [N/m]."""
    loss: float = 3.0
    """Damping of the contact by Hunt and Crossley, a share of the stiff force by the closing speed [s/m]."""
    grip: float = 0.6
    """Coefficient of friction of the foot on the floor."""
    bristle: float = 4000.0
    """Stiffness of the rubber along the floor by the load [1/m]."""
    cord: float = 0.0
    """Stiffness of the elastic cord that catches the carriage [N/m]."""
    catch: float = -0.11
    """Reading of the rail below which the cord is taut [m]."""


@njit(cache=True)
def ground(depth: float, closing: float, slip: float, bristle: float, p: Values) -> tuple[float, float, float]:
    """Return normal force and friction of the floor on the foot [N], and the rate of the bristles' deflection [m/s].

    Hunt and Crossley's force, and friction by bristles whose stiffness goes with the load; they relax in the air.
    """
    normal = max(0.0, p.ground * depth * (1.0 + p.loss * closing)) if depth > 0.0 else 0.0
    share, rate = lugre(bristle, slip, p.grip, p.bristle, 2.0)
    if normal == 0.0:
        return 0.0, 0.0, -bristle / 0.005
    return normal, -normal * share, rate


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Lagrange's equations; the state is rail, hip, knee, their speeds, and the deflection of the foot's bristles."""
    v0, v1, v2 = y[3], y[4], y[5]
    a1, a2, w1, w2 = y[1], y[1] + y[2], v1, v1 + v2
    s1, c1, s2, c2 = np.sin(a1), np.cos(a1), np.sin(a2), np.cos(a2)
    foot = TALL + y[0] - p.length1 * c1 - p.length2 * c2
    closing = -(v0 + p.length1 * s1 * w1 + p.length2 * s2 * w2)
    slip = p.length1 * c1 * w1 + (p.length2 * c2 + p.radius) * w2
    normal, rub, dy[6] = ground(p.radius - foot, closing, slip, y[6], p)

    # Momenta of the links' angles against the vertical, then of the joints.
    k1, k2 = p.mass1 * p.centre1 + p.mass2 * p.length1, p.mass2 * p.centre2
    m11 = p.inertia1 + p.mass1 * p.centre1**2 + p.mass2 * p.length1**2
    m12, m22 = k2 * p.length1 * np.cos(a1 - a2), p.inertia2 + k2 * p.centre2
    turn = k2 * p.length1 * np.sin(a1 - a2)
    total = p.mass0 + p.mass1 + p.mass2
    f0 = normal - 9.81 * total - k1 * c1 * w1**2 - k2 * c2 * w2**2
    f1 = normal * p.length1 * s1 + rub * p.length1 * c1 - 9.81 * k1 * s1 - turn * w2**2
    f2 = normal * p.length2 * s2 + rub * (p.length2 * c2 + p.radius) - 9.81 * k2 * s2 + turn * w1**2
    f0 += p.cord * max(0.0, p.catch - y[0]) - p.damping0 * v0 - coulomb(v0, p.friction0)
    q1 = p.kp1 * (u[0] - y[1]) - (p.kv1 + p.damping1) * v1 - coulomb(v1, p.friction1)
    q2 = p.kp2 * (u[1] - y[2]) - (p.kv2 + p.damping2) * v2 - coulomb(v2, p.friction2)
    inertia = np.array(
        [
            [total, k1 * s1 + k2 * s2, k2 * s2],
            [k1 * s1 + k2 * s2, m11 + 2 * m12 + m22 + p.rotor1, m12 + m22],
            [k2 * s2, m12 + m22, m22 + p.rotor2],
        ]
    )
    dy[0], dy[1], dy[2] = v0, v1, v2
    dy[3:6] = np.linalg.solve(inertia, np.array([f0, q1 + f1 + f2, q2 + f2]))


DURATION = 3.5


def legs(bend: np.ndarray, lean: np.ndarray) -> dict[str, np.ndarray]:
    """Return set-points of a leg of equal links that is bent by an angle at the hip and leans forward by another."""
    return {"hip_drive": bend + lean, "knee_drive": -2 * bend}


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return squats, scuffs to and fro, hops, and stamps."""
    t = clock(DURATION, 250)
    still = np.zeros(len(t))
    deep, high = rng.uniform(0.92, 0.96), rng.uniform(0.28, 0.32)
    squats = reach(t, [(0, 0.45), (0.3, deep), (1.2, 0.4), (2.1, 0.85), (2.5, 0.5), (3.0, 0.7)], 0.4)
    sway = sines(t, (0.03, rng.uniform(0.6, 0.7), 0))
    stand = reach(t, [(0, 0.55), (2.0, 0.75)], 1.0)
    scuff = sines(t, (0.16, rng.uniform(0.7, 0.8), 0), (0.09, 1.9, 0.7))
    hops = reach(t, [(0, 0.5), (0.3, 0.9)], 0.5)
    for jump, land in ((0.9, 0.6), (2.1, 0.65)):
        hops += reach(t, [(0, 0), (jump, high - 0.9)], 0.22) + reach(t, [(0, 0), (jump + 0.18, land - high)], 0.2)
        hops += reach(t, [(0, 0), (jump + 0.6, 0.9 - land)], 0.4)
    stamps = reach(t, [(0, 0.5)], 1.0)
    for at, lift in ((0.4, 0.35), (1.4, 0.25), (2.4, 0.4)):
        stamps += reach(t, [(0, 0), (at, lift)], 0.1) + reach(t, [(0, 0), (at + 0.13, -lift)], 0.25)
    swing = sines(t, (0.05, 0.5, 0))
    commands = (legs(squats, sway), legs(stand, scuff), legs(hops, still), legs(stamps, swing))
    return [Motion(DURATION, {name: Held(t, np.round(c, 4)) for name, c in m.items()}) for m in commands]


def rest(p: Values, u: np.ndarray) -> np.ndarray:
    """Return the leg as commanded, with the foot on the floor."""
    height = p.radius + p.length1 * np.cos(u[0]) + p.length2 * np.cos(u[0] + u[1])
    return np.array([height - TALL, u[0], u[1], 0.0, 0.0, 0.0, 0.0])


def column(k: int) -> Callable[[np.ndarray, Values], np.ndarray]:
    """Return what reads one of the states."""
    return lambda y, p: y[:, k : k + 1]  # noqa: ARG005


MACHINE = Machine(
    name="squat_leg",
    model=MODEL,
    nominal=Values(),
    lengths=("centre1", "centre2"),
    loose=("damping0", "damping1", "damping2", "friction0", "friction1", "friction2", "ground", "loss", "bristle"),
    exact=("length1", "length2", "radius", "cord", "catch"),
    derivative=derivative,
    rest=rest,
    actuators=("hip_drive", "knee_drive"),
    sensors=(
        Sensor("rail_height", ("m",), 200, 3e-4, column(0), 1e-4),
        Sensor("hip_position", ("rad",), 500, 4e-4, column(1), 2 * np.pi / 16384),
        Sensor("knee_position", ("rad",), 500, 4e-4, column(2), 2 * np.pi / 16384),
    ),
    motions=motions,
    settle=3.0,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case("dusty_floor", "single", (("sliding_friction",),), Hidden(factors={"grip": 0.6}), Habits(stated=True)),
    MACHINE.case("foam_mat", "single", (("contact_compliance",),), Hidden(factors={"ground": 0.35})),
    MACHINE.case("dry_rail", "single", (("joint_friction",),), Hidden(added={"friction0": 5.0}), Habits(lost=0.01)),
    MACHINE.case("battery", "single", (("mass",),), Hidden(added={"mass0": 0.5}), Habits(stated=True)),
    MACHINE.case("safety_cord", "outside", (), Hidden(added={"cord": 450.0}), Habits(lost=0.01)),
)
