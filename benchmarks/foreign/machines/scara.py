"""A SCARA arm of four joints with position servos, output encoders, and a marker beside the axis of its tool."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, lugre
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines, steps
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="scara">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <geom contype="0" conaffinity="0"/>
    <joint type="hinge" axis="0 0 1"/>
  </default>
  <worldbody>
    <body name="inner" pos="0 0 0.4">
      <inertial pos="0.13 0 0" mass="2.2" diaginertia="0.004 0.022 0.024"/>
      <joint name="j1" range="-2.2 2.2" armature="0.12" damping="0.8" frictionloss="0.5"/>
      <geom type="capsule" fromto="0 0 0 0.28 0 0" size="0.035"/>
      <body name="outer" pos="0.28 0 0">
        <inertial pos="0.12 0 0.02" mass="1.5" diaginertia="0.003 0.012 0.013"/>
        <joint name="j2" range="-2.4 2.4" armature="0.06" damping="0.4" frictionloss="0.25"/>
        <geom type="capsule" fromto="0 0 0 0.22 0 0" size="0.03"/>
        <body name="quill" pos="0.22 0 0">
          <inertial pos="0 0 -0.05" mass="0.5" diaginertia="0.0015 0.0015 0.0001"/>
          <joint name="j3" type="slide" range="-0.15 0.1" armature="1.4" damping="25" frictionloss="2.5"/>
          <geom type="capsule" fromto="0 0 -0.15 0 0 0.1" size="0.008"/>
          <body name="flange" pos="0 0 -0.15">
            <inertial pos="0 0 -0.02" mass="0.25" diaginertia="0.0002 0.0002 0.00015"/>
            <joint name="j4" range="-3 3" armature="0.004" damping="0.02" frictionloss="0.03"/>
            <geom type="cylinder" size="0.03 0.02"/>
            <site name="spot" pos="0.06 0 -0.03"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="drive1" joint="j1" kp="220" kv="18"/>
    <position name="drive2" joint="j2" kp="110" kv="7"/>
    <position name="drive3" joint="j3" kp="6000" kv="200"/>
    <position name="drive4" joint="j4" kp="6" kv="0.25" forcerange="-1.5 1.5"/>
  </actuator>
  <sensor>
    <jointpos name="encoder1" joint="j1"/>
    <jointpos name="encoder2" joint="j2"/>
    <jointpos name="encoder3" joint="j3"/>
    <jointpos name="encoder4" joint="j4"/>
    <framepos name="spot" objtype="site" objname="spot"/>
  </sensor>
</mujoco>
"""


class Values(NamedTuple):
    """Values of the arm: 1 and 2 are its links, 3 the quill, 4 the flange."""

    mass1: float = 2.2
    centre1: float = 0.13
    length1: float = 0.28
    inertia1: float = 0.024
    mass2: float = 1.5
    centre2: float = 0.12
    length2: float = 0.22
    inertia2: float = 0.013
    mass3: float = 0.5
    inertia3: float = 0.0001
    mass4: float = 0.25
    inertia4: float = 0.00015
    spot: float = 0.06
    rotor1: float = 0.12
    rotor2: float = 0.06
    rotor3: float = 1.4
    rotor4: float = 0.004
    damping1: float = 0.8
    damping2: float = 0.4
    damping3: float = 25.0
    damping4: float = 0.02
    friction1: float = 0.5
    friction2: float = 0.25
    friction3: float = 2.5
    friction4: float = 0.03
    kp1: float = 220.0
    kp2: float = 110.0
    kp3: float = 6000.0
    kp4: float = 6.0
    kv1: float = 18.0
    kv2: float = 7.0
    kv3: float = 200.0
    kv4: float = 0.25
    play: float = 0.0
    """Play in the gear of the second joint [rad]."""
    offset: float = 0.0
    """Angle of the second joint where its encoder and its drive count 0 [rad]."""
    wall: float = 10.0
    """Angle of the first joint at which a forgotten bracket is touched [rad]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Lagrange's equations; the state is positions, speeds, bristles, angle and speed of the second motor."""
    v1, v2, v3, v4 = y[4], y[5], y[6], y[7]
    drag1, dy[8] = lugre(y[8], v1, p.friction1, p.friction1 / 2e-4, 0.2)
    drag2, dy[9] = lugre(y[9], v2, p.friction2, p.friction2 / 2e-4, 0.1)
    drag3, dy[10] = lugre(y[10], v3, p.friction3, p.friction3 / 5e-5, 30.0)
    drag4, dy[11] = lugre(y[11], v4, p.friction4, p.friction4 / 4e-4, 0.01)
    end = p.mass3 + p.mass4
    moment = p.length1 * (p.mass2 * p.centre2 + end * p.length2)
    c, h = moment * np.cos(y[1]), moment * np.sin(y[1])
    a = p.inertia1 + p.mass1 * p.centre1**2 + (p.mass2 + end) * p.length1**2
    b = p.inertia2 + p.mass2 * p.centre2**2 + p.inertia3 + end * p.length2**2 + p.inertia4
    m11, m12, m22 = a + b + 2 * c + p.rotor1, b + c, b
    if p.play > 0.0:
        # The motor, with its inertia, meets the link at either end of the play through stiff, damped teeth.
        apart = y[12] - y[1]
        beyond = apart - min(max(apart, -0.5 * p.play), 0.5 * p.play)
        drive2 = 2e4 * beyond + (4.0 * (y[13] - v2) if beyond != 0.0 else 0.0)
        dy[12] = y[13]
        dy[13] = (p.kp2 * (u[1] - y[12]) - p.kv2 * y[13] - drive2) / p.rotor2
    else:
        drive2 = p.kp2 * (u[1] - (y[1] - p.offset)) - p.kv2 * v2
        m22 += p.rotor2
        dy[12] = 0.0
        dy[13] = 0.0
    drive4 = min(max(p.kp4 * (u[3] - y[3]) - p.kv4 * v4, -1.5), 1.5)
    bracket = 900.0 * max(y[0] - p.wall, 0.0) * max(1 + 0.2 * v1, 0.0)
    f1 = p.kp1 * (u[0] - y[0]) - (p.kv1 + p.damping1) * v1 - drag1 + h * (2 * v1 * v2 + v2**2) - bracket
    f2 = drive2 - p.damping2 * v2 - drag2 - h * v1**2
    f4 = drive4 - p.damping4 * v4 - drag4
    # The flange turns with both links: its row is inertia4 (a1 + a2 + a4) + rotor4 a4 = f4.
    own = p.inertia4 + p.rotor4
    less = p.inertia4**2 / own
    f1 -= p.inertia4 / own * f4
    f2 -= p.inertia4 / own * f4
    m11, m12, m22 = m11 - less, m12 - less, m22 - less
    det = m11 * m22 - m12 * m12
    dy[0] = v1
    dy[1] = v2
    dy[2] = v3
    dy[3] = v4
    dy[4] = (m22 * f1 - m12 * f2) / det
    dy[5] = (m11 * f2 - m12 * f1) / det
    force3 = p.kp3 * (u[2] - y[2]) - (p.kv3 + p.damping3) * v3 - drag3 - end * 9.81
    dy[6] = force3 / (end + p.rotor3)
    dy[7] = (f4 - p.inertia4 * (dy[4] + dy[5])) / own


def spot(y: np.ndarray, p: Values) -> np.ndarray:
    """Return positions of the marker on the flange in the world [m]."""
    q1, q2, q4 = y[:, 0], y[:, 0] + y[:, 1], y[:, 0] + y[:, 1] + y[:, 3]
    x = p.length1 * np.cos(q1) + p.length2 * np.cos(q2) + p.spot * np.cos(q4)
    along = p.length1 * np.sin(q1) + p.length2 * np.sin(q2) + p.spot * np.sin(q4)
    return np.stack([x, along, 0.22 + y[:, 2]], axis=1)


def rest(p: Values, u: np.ndarray) -> np.ndarray:
    """Return a state at the commands."""
    return np.concatenate([[u[0], u[1] + p.offset, u[2], u[3]], np.zeros(8), [u[1], 0.0]])


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return pick and place in the air, and a motion with sines and steps."""
    t = clock(5.0, 200)
    far = rng.uniform(0.75, 0.85)
    first = {
        "drive1": reach(t, [(0, -0.6), (0.4, far), (2.3, -0.4), (3.6, 0.3)], 0.7),
        "drive2": reach(t, [(0, 0.9), (0.4, 1.5), (1.3, 0.7), (2.3, 1.6), (3.6, 0.5)], 0.7),
        "drive3": reach(t, [(0, 0.02), (1.2, -0.08), (1.9, 0.02), (3.0, -0.1), (3.9, 0.0)], 0.5),
        "drive4": steps(t, [(0, 0.0), (0.8, 0.7), (1.9, -0.6), (3.2, 0.4), (4.2, 0.0)]),
    }
    second = {
        "drive1": sines(t, (0.3, 0.5, 0), (0.1, rng.uniform(1.4, 1.8), 0)),
        "drive2": 1.0 + sines(t, (0.3, 0.7, 0.4), (0.1, rng.uniform(2.2, 2.8), 0)),
        "drive3": sines(t, (0.03, 0.8, 0), (0.01, 2.3, 0)) - 0.03,
        "drive4": sines(t, (0.6, 0.9, 0), (0.2, 2.6, 0)),
    }
    return [Motion(5.0, {name: Held(t, c) for name, c in motion.items()}) for motion in (first, second)]


def encoder(joint: int, noise: float) -> Sensor:
    """Return the encoder of a joint."""
    off = joint == 2
    return Sensor(
        f"encoder{joint}",
        ("position",),
        200,
        noise,
        lambda y, p: y[:, joint - 1 : joint] - (p.offset if off else 0.0),
        noise,
    )


MACHINE = Machine(
    name="scara",
    model=MODEL,
    nominal=Values(),
    lengths=("length1", "length2", "spot"),
    loose=tuple(f"{what}{joint}" for what in ("damping", "friction") for joint in (1, 2, 3, 4)),
    exact=("play", "offset", "wall"),
    derivative=derivative,
    rest=rest,
    actuators=("drive1", "drive2", "drive3", "drive4"),
    sensors=(
        encoder(1, 3e-4),
        encoder(2, 3e-4),
        encoder(3, 2e-4),
        encoder(4, 1e-3),
        Sensor("spot", ("x", "y", "z"), 100, 5e-4, spot),
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True, jitter=1e-4)),
    MACHINE.case("worn_gear", "single", (("backlash",),), Hidden(added={"play": 0.012})),
    MACHINE.case("elbow_zero", "single", (("joint_offset",),), Hidden(added={"offset": 0.02}), Habits(stated=True)),
    MACHINE.case("biased_encoder", "single", (("sensor_bias",),), Hidden(bias={"encoder1": 0.006}), Habits(lost=0.01)),
    MACHINE.case("heavy_flange", "single", (("mass",),), Hidden(added={"mass4": 0.6}), Habits(stated=True)),
    MACHINE.case("forgotten_bracket", "outside", (), Hidden(added={"wall": -9.25})),
)
