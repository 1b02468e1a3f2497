"""A tabletop arm with three joints, critically damped position servos of 100 Hz, and a marker at its tool."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.foreign.integrate import Held, coulomb
from benchmarks.foreign.jointed import Habits, Hidden, Machine, Motion, Sensor, clock, reach, sines
from benchmarks.foreign.log import Case

MODEL = """
<mujoco model="tabletop arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <geom type="capsule" size="0.02" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body name="column">
      <inertial pos="0 0 0.1" mass="1.2" diaginertia="0.004 0.004 0.003"/>
      <joint name="yaw" axis="0 0 1" range="-3 3" armature="0.03" damping="0.3" frictionloss="0.2"/>
      <geom fromto="0 0 0.05 0 0 0.2"/>
      <body name="link1" pos="0 0 0.25">
        <inertial pos="0.1 0 0" mass="0.8" diaginertia="0.0006 0.005 0.005"/>
        <joint name="shoulder" axis="0 -1 0" range="-1.6 1.6" armature="0.05" damping="0.35" frictionloss="0.3"/>
        <geom fromto="0 0 0 0.22 0 0"/>
        <body name="link2" pos="0.22 0 0">
          <inertial pos="0.09 0 0" mass="0.5" diaginertia="0.0004 0.0025 0.0025"/>
          <joint name="elbow" axis="0 -1 0" range="-2.6 2.6" armature="0.02" damping="0.15" frictionloss="0.12"/>
          <geom fromto="0 0 0 0.2 0 0"/>
          <site name="tool" pos="0.24 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="yaw" joint="yaw" kp="40" dampratio="1"/>
    <position name="shoulder" joint="shoulder" kp="60" dampratio="1"/>
    <position name="elbow" joint="elbow" kp="25" dampratio="1"/>
  </actuator>
  <sensor>
    <jointpos name="yaw_encoder" joint="yaw"/>
    <jointpos name="shoulder_encoder" joint="shoulder"/>
    <jointpos name="elbow_encoder" joint="elbow"/>
    <framepos name="tool_marker" objtype="site" objname="tool"/>
  </sensor>
</mujoco>
"""


def feedback(kp: float, inertia: float) -> float:
    """Return kv of a critically damped servo: of the inertia at its joint with all joints at 0 and the others free."""
    return 2 * float(np.sqrt(kp * inertia))


ELBOW = 0.0025 + 0.5 * 0.09**2 + 0.02
SHOULDER = 0.005 + 0.8 * 0.1**2 + 0.0025 + 0.5 * (0.22 + 0.09) ** 2 + 0.05
BETWEEN = 0.0025 + 0.5 * 0.09**2 + 0.5 * 0.22 * 0.09


class Values(NamedTuple):
    """Values of the arm: 0 is the column, 1 and 2 are the links."""

    inertia0: float = 0.003
    mass1: float = 0.8
    centre1: float = 0.1
    length1: float = 0.22
    along1: float = 0.0006
    across1: float = 0.005
    mass2: float = 0.5
    centre2: float = 0.09
    along2: float = 0.0004
    across2: float = 0.0025
    tool: float = 0.24
    rotor0: float = 0.03
    rotor1: float = 0.05
    rotor2: float = 0.02
    damping0: float = 0.3
    damping1: float = 0.35
    damping2: float = 0.15
    friction0: float = 0.2
    friction1: float = 0.3
    friction2: float = 0.12
    kp0: float = 40.0
    kp1: float = 60.0
    kp2: float = 25.0
    kv0: float = feedback(40.0, 0.003 + SHOULDER - 0.05 + 0.03)
    kv1: float = feedback(60.0, SHOULDER - BETWEEN**2 / ELBOW)
    kv2: float = feedback(25.0, ELBOW - BETWEEN**2 / SHOULDER)
    by_load: float = 0.0
    """Friction of the shoulder's gear, as a share of the torque that it transmits."""
    balance: float = 0.0
    """Share of the links' weight that is carried by balancers."""
    cogging: float = 0.0
    """Torque of the elbow's motor that repeats 20 times a turn [N m]."""


@njit(cache=True)
def derivative(t: float, y: np.ndarray, u: np.ndarray, p: Values, dy: np.ndarray) -> None:  # noqa: ARG001
    """Lagrange's equations; the state is angles and speeds."""
    q1, q12 = y[1], y[1] + y[2]
    v0, v1, v2 = y[3], y[4], y[5]
    c1, s1, c12, s12 = np.cos(q1), np.sin(q1), np.cos(q12), np.sin(q12)
    reach2 = p.length1 * c1 + p.centre2 * c12
    about_z = p.inertia0 + p.rotor0 + p.mass1 * (p.centre1 * c1) ** 2 + p.along1 * s1**2 + p.across1 * c1**2
    about_z += p.mass2 * reach2**2 + p.along2 * s12**2 + p.across2 * c12**2
    by12 = -2 * p.mass2 * reach2 * p.centre2 * s12 + 2 * (p.along2 - p.across2) * s12 * c12
    by1 = -2 * (p.mass1 * p.centre1**2 + p.across1 - p.along1) * s1 * c1
    by1 += -2 * p.mass2 * reach2 * p.length1 * s1 + by12
    a = p.across1 + p.mass1 * p.centre1**2 + p.mass2 * p.length1**2
    b = p.across2 + p.mass2 * p.centre2**2
    moment = p.mass2 * p.length1 * p.centre2
    c, h = moment * np.cos(y[2]), moment * np.sin(y[2])
    g = 9.81 * (1 - p.balance)
    weight2 = g * p.mass2 * p.centre2 * c12
    weight1 = g * (p.mass1 * p.centre1 + p.mass2 * p.length1) * c1 + weight2
    drive0 = p.kp0 * (u[0] - y[0]) - p.kv0 * v0
    drive1 = p.kp1 * (u[1] - y[1]) - p.kv1 * v1
    drive2 = p.kp2 * (u[2] - y[2]) - p.kv2 * v2 + p.cogging * np.sin(20 * y[2])
    level1 = p.friction1 + p.by_load * abs(drive1 + weight1) / 2
    f0 = drive0 - p.damping0 * v0 - coulomb(v0, p.friction0) - (by1 * v1 + by12 * v2) * v0
    f1 = drive1 - p.damping1 * v1 - coulomb(v1, level1) - weight1 + 0.5 * by1 * v0**2 + h * (2 * v1 * v2 + v2**2)
    f2 = drive2 - p.damping2 * v2 - coulomb(v2, p.friction2) - weight2 + 0.5 * by12 * v0**2 - h * v1**2
    m11, m12, m22 = a + b + 2 * c + p.rotor1, b + c, b + p.rotor2
    det = m11 * m22 - m12 * m12
    dy[0] = v0
    dy[1] = v1
    dy[2] = v2
    dy[3] = f0 / about_z
    dy[4] = (m22 * f1 - m12 * f2) / det
    dy[5] = (m11 * f2 - m12 * f1) / det


def tool(y: np.ndarray, p: Values) -> np.ndarray:
    """Return positions of the tool in the world [m]."""
    q12 = y[:, 1] + y[:, 2]
    out = p.length1 * np.cos(y[:, 1]) + p.tool * np.cos(q12)
    up = 0.25 + p.length1 * np.sin(y[:, 1]) + p.tool * np.sin(q12)
    return np.stack([out * np.cos(y[:, 0]), out * np.sin(y[:, 0]), up], axis=1)


def motions(rng: np.random.Generator) -> list[Motion]:
    """Return two motions: pick and place in the air, and sines of all joints."""
    t = clock(6.0, 100)
    side = rng.uniform(0.8, 1.0)
    first = {
        "yaw": reach(t, [(0, -0.5), (0.5, side), (2.6, -0.2), (4.4, 0.4)], 0.9),
        "shoulder": reach(t, [(0, 0.9), (0.6, 0.3), (1.6, 0.8), (2.8, 0.1), (4.2, 0.7)], 0.8),
        "elbow": reach(t, [(0, -1.4), (0.6, -0.6), (1.7, -1.5), (2.8, -0.3), (4.3, -1.2)], 0.8),
    }
    second = {
        "yaw": sines(t, (0.5, 0.4, 0), (0.12, rng.uniform(1.2, 1.5), 0)),
        "shoulder": 0.6 + sines(t, (0.35, 0.55, 0), (0.1, 1.6, 0)),
        "elbow": -1.0 + sines(t, (0.5, 0.7, 0), (0.12, rng.uniform(1.7, 2.1), 0)),
    }
    return [Motion(6.0, {name: Held(t, c) for name, c in motion.items()}) for motion in (first, second)]


def encoder(name: str, joint: int) -> Sensor:
    """Return the encoder of a joint, with 4096 counts a turn."""
    return Sensor(name, ("angle",), 100, 5e-4, lambda y, p: y[:, joint : joint + 1], 2 * np.pi / 4096)  # noqa: ARG005


MACHINE = Machine(
    name="yaw_arm",
    model=MODEL,
    nominal=Values(),
    lengths=("length1", "tool"),
    loose=("damping0", "damping1", "damping2", "friction0", "friction1", "friction2"),
    exact=("by_load", "balance", "cogging"),
    derivative=derivative,
    rest=lambda p, u: np.array([u[0], u[1], u[2], 0, 0, 0]),  # noqa: ARG005
    actuators=("yaw", "shoulder", "elbow"),
    sensors=(
        encoder("yaw_encoder", 0),
        encoder("shoulder_encoder", 1),
        encoder("elbow_encoder", 2),
        Sensor("tool_marker", ("x", "y", "z"), 50, 5e-4, tool),
    ),
    motions=motions,
)

CASES: tuple[Case, ...] = (
    MACHINE.case("null", "null", habits=Habits(stated=True)),
    MACHINE.case("balancers", "single", (("gravity_compensation",),), Hidden(added={"balance": 0.15})),
    MACHINE.case(
        "worm_gear", "single", (("load_friction",),), Hidden(added={"by_load": 0.3}), Habits(stated=True, lost=0.01)
    ),
    MACHINE.case(
        "moved_camera",
        "single",
        (("frame_offset",),),
        Hidden(bias={"tool_marker": (0.006, -0.004, 0.0)}),
        Habits(jitter=2e-4),
    ),
    MACHINE.case(
        "friction_and_encoder_scale",
        "pair",
        (("joint_friction",), ("sensor_gain",)),
        Hidden(added={"friction0": 0.35}, gain={"elbow_encoder": 0.985}),
    ),
    MACHINE.case("elbow_cogging", "outside", (), Hidden(added={"cogging": 0.2}), Habits(stated=True)),
)
