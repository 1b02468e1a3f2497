"""Seven experiments of the world on Drake, with the nominal scenes of their users.

`swing`: a servo swings a weight. `reach`: a two-joint arm in a vertical plane. `gantry`: two slides push a block on a
table. `launch`: a block slides to rest. `bounce`: a soft ball on smooth PTFE, of which only the position is tracked.
`roll`: a ball skids, then rolls. `toss`: a block turns in flight. The nominal contact of the bouncing ball has the
frequency and damping of the world's linear spring and damper on the ball's mass; other nominal contacts are MuJoCo's
default.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.independent.foreign.plans import RATE, cosine, ramp, rest, timed, tones
from benchmarks.independent.foreign.rig import Drive, ForeignRig, ForeignTrial, Sensor
from benchmarks.independent.foreign.values import BALL, ball, block, nominal_contact, tracked

SWING = """
<mujoco model="swing">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="swing" pos="0 0 0.4">
      <joint name="axle" type="hinge" axis="0 1 0" damping="{damping}" armature="{armature}" frictionloss="{friction}"/>
      <inertial pos="0 0 -{center}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia_z}"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.15" size="0.006" contype="0" conaffinity="0"/>
      <site name="target" pos="0 0 -{length}"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="axle" kp="{kp}" kv="{kv}"/>
  </actuator>
  <sensor>
    <jointpos name="axle_encoder" joint="axle"/>
    <framepos name="target_position" objtype="site" objname="target"/>
  </sensor>
</mujoco>
"""


def swing_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample ramps at several speeds, slow reversals, holds at height, and a sum of tones: about 10 s."""
    side = rng.choice([-1.0, 1.0])
    a, b, c = side * rng.uniform(1.0, 1.4), -side * rng.uniform(0.8, 1.2), side * rng.uniform(0.3, 0.7)
    action = timed(
        rest(0.0, 0.4),
        ramp(0.0, a, rng.uniform(0.8, 1.2)),
        rest(a, 0.4),
        ramp(a, b, rng.uniform(2.0, 3.0)),
        rest(b, 0.3),
        ramp(b, a, rng.uniform(4.0, 5.0)),
        cosine(a, c, 0.7),
        tones(rng, c, 0.3, 0.6, 4.0, 3.0),
        ramp(c, c - 0.12, rng.uniform(0.12, 0.2)),
        ramp(c - 0.12, c, rng.uniform(0.12, 0.2)),
        rest(c, 0.3),
    )
    return ForeignTrial(len(action[0]) / RATE, {"servo": action}, before=0.5)


REACH = """
<mujoco model="reach">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 0.5">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="{damping_1}" armature="{armature_1}"/>
      <inertial pos="0 0 -{center_1}" mass="{mass_1}" diaginertia="{inertia_1} {inertia_1} 6e-4"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.28" size="0.02" contype="0" conaffinity="0"/>
      <body name="fore" pos="0 0 -{length_1}">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="{damping_2}" armature="{armature_2}"/>
        <inertial pos="0 0 -{center_2}" mass="{mass_2}" diaginertia="{inertia_2} {inertia_2} 4e-4"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.22" size="0.015" contype="0" conaffinity="0"/>
        <site name="hand" pos="0 0 -{length_2}"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder_servo" joint="shoulder" kp="{kp_1}" kv="{kv_1}"/>
    <position name="elbow_servo" joint="elbow" kp="{kp_2}" kv="{kv_2}"/>
  </actuator>
  <sensor>
    <jointpos name="shoulder_encoder" joint="shoulder"/>
    <jointpos name="elbow_encoder" joint="elbow"/>
    <framepos name="hand_position" objtype="site" objname="hand"/>
  </sensor>
</mujoco>
"""


def reach_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample point-to-point motions, slow sweeps and tones of both joints: about 8 s."""
    series = []
    for reach, kind in ((1.0, 0), (1.2, 1)):
        a, b, c = rng.uniform(0.5, reach), -rng.uniform(0.4, reach), rng.uniform(-0.4, 0.6)
        slow = ramp(a, b, rng.uniform(0.4, 0.6)) if kind else cosine(a, b, 1.6)
        wave = tones(rng, c, 0.25, 0.5, 2.5, 2.5)
        series.append(np.concatenate([rest(0.0, 0.4), cosine(0, a, 0.9), rest(a, 0.3), slow, cosine(b, c, 0.7), wave]))
    most = max(map(len, series))
    padded = [np.concatenate([s, np.full(most - len(s) + 40, s[-1])]) for s in series]
    action = {name: timed(s) for name, s in zip(("shoulder_servo", "elbow_servo"), padded, strict=True)}
    return ForeignTrial((most + 40) / RATE, action, before=1.0)


GANTRY = """
<mujoco model="gantry">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1" friction="{friction} 0.005 0.0001"/>
    <body name="bridge" pos="-0.12 0 0.03">
      <joint name="slide_x" type="slide" axis="1 0 0" damping="{damping}" frictionloss="{friction_x}"/>
      <inertial pos="0 0 0" mass="{bridge}" diaginertia="0.002 0.002 0.002"/>
      <body name="carriage">
        <joint name="slide_y" type="slide" axis="0 1 0" damping="{damping}" frictionloss="{friction_y}"/>
        <inertial pos="0 0 0" mass="{carriage}" diaginertia="0.001 0.001 0.001"/>
        <geom name="finger" type="cylinder" size="{finger_radius} {finger_length}" friction="{pad} 0.005 0.0001"/>
      </body>
    </body>
    <body name="block" pos="0 0 {half_z}">
      <freejoint/>
      <geom name="block" type="box" size="{half_x} {half_y} {half_z}" mass="{mass}" friction="{pad} 0.005 0.0001"/>
    </body>
  </worldbody>
  <actuator>
    <position name="motor_x" joint="slide_x" kp="{kp_x}" kv="{kv_x}"/>
    <position name="motor_y" joint="slide_y" kp="{kp_y}" kv="{kv_y}"/>
  </actuator>
  <sensor>
    <jointpos name="encoder_x" joint="slide_x"/>
    <jointpos name="encoder_y" joint="slide_y"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


def gantry_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a push along x off the centre, a retreat, and a second push with a sideways motion: about 6 s."""
    near, far, end = rng.uniform(0.09, 0.13), rng.uniform(0.02, 0.05), rng.uniform(0.15, 0.18)
    first, second = rng.uniform(-0.02, 0.02, 2)
    x = [rest(0, 0.3), ramp(0, near, rng.uniform(0.06, 0.09)), rest(near, 0.3), cosine(near, far, 0.6), rest(far, 0.5)]
    x += [ramp(far, end, rng.uniform(0.1, 0.16)), rest(end, 0.3), cosine(end, 0.0, 1.0), rest(0.0, 0.2)]
    start = sum(map(len, x[:3]))
    series = np.concatenate(x)
    y = np.concatenate([cosine(0, first, 0.3), np.full(start - round(0.3 * RATE), first)])
    y = np.concatenate([y, rest(first, 0.6), cosine(first, second, 0.4)])
    tail = len(series) - len(y)
    drift = second + np.linspace(0, rng.uniform(-0.02, 0.02), tail)
    action = {"motor_x": timed(series), "motor_y": timed(np.concatenate([y, drift]))}
    turn = rng.uniform(-0.2, 0.2)
    pose = (*rng.uniform(-0.004, 0.004, 2), 0.025, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
    return ForeignTrial(len(series) / RATE, action, pose=pose, before=0.3)


LAUNCH = """
<mujoco model="launch">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="2 2 0.1" friction="{friction} 0.005 0.0001"/>
    <body name="block" pos="0 0 {half_z}">
      <freejoint/>
      <geom name="block" type="box" size="{half_x} {half_y} {half_z}" mass="{mass}" friction="{friction} 0.005 0.0001"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


def launch_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a launch over the middle of the table with some spin."""
    heading, turn, speed = *rng.uniform(-np.pi, np.pi, 2), rng.uniform(0.6, 1.2)
    x, y = rng.uniform(-0.03, 0.03, 2) - 0.1 * np.array([np.cos(heading), np.sin(heading)])
    pose = (x, y, 0.02, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
    velocity = (speed * np.cos(heading), speed * np.sin(heading), 0.0, 0.0, 0.0, rng.uniform(-2.0, 2.0))
    return ForeignTrial(speed / 3.0 + 0.3, pose=pose, velocity=velocity)


BOUNCE = BALL.format(
    model="bounce",
    contact='solref="{time_constant} {damping_ratio}" solimp="0.98 0.98 0.001"',
    height=0.5,
    table="",
    extra="",
)
ROLL = BALL.format(
    model="roll",
    contact="",
    height="{radius}",
    table="",
    extra='\n    <framequat name="ball_orientation" objtype="xbody" objname="ball"/>',
)


def bounce_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a throw that meets the table twice."""
    heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.4, 1.2)
    pose = (*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.35, 0.5), 1.0, 0.0, 0.0, 0.0)
    velocity = (speed * np.cos(heading), speed * np.sin(heading), rng.uniform(0.3, 1.2), *rng.uniform(-3, 3, 3))
    return ForeignTrial(0.85, pose=pose, velocity=velocity)


def roll_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a ball shoved over the middle of the table; it skids before it rolls."""
    heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 1.1)
    quaternion = Rotation.random(None, rng).as_quat(scalar_first=True)
    x, y = rng.uniform(-0.03, 0.03, 2) - 0.1 * np.array([np.cos(heading), np.sin(heading)])
    pose = (x, y, 0.03, *quaternion)
    velocity = (speed * np.cos(heading), speed * np.sin(heading), 0.0, 0.0, 0.0, rng.uniform(-2, 2))
    return ForeignTrial(1.5, pose=pose, velocity=velocity)


TOSS = """
<mujoco model="toss">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="RK4"/>
  <worldbody>
    <body name="brick" pos="0 0 0.6">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia_x} {inertia_y} {inertia_z}"/>
      <geom name="brick" type="box" size="{half_x} {half_y} {half_z}" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="brick_position" objtype="xbody" objname="brick"/>
    <framequat name="brick_orientation" objtype="xbody" objname="brick"/>
  </sensor>
</mujoco>
"""


def toss_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a throw with spin that ends before it lands."""
    quaternion = Rotation.random(None, rng).as_quat(scalar_first=True)
    pose = (*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.5, 0.8), *quaternion)
    velocity = (*rng.uniform(-1.5, 1.5, 2), rng.uniform(2.0, 3.0), *rng.uniform(-8, 8, 3))
    return ForeignTrial(0.7, pose=pose, velocity=velocity)


def _hand(v: Mapping[str, float]) -> tuple[float, float, float]:
    return (0.0, 0.0, -v["length_2"])


_RIGS = (
    ForeignRig(
        "swing",
        SWING,
        {
            **{"mass": 0.28, "center": 0.145, "inertia": 5e-4, "inertia_z": 4e-5, "length": 0.15},
            **{"kp": 6.0, "kv": 0.25, "armature": 0.0012, "damping": 0.002, "friction": 0.006},
        },
        ("mass", "inertia", "kp", "kv", "armature"),
        ("center", "length"),
        (
            Sensor("axle_encoder", "angle", "axle"),
            Sensor("target_position", "marker", "swing", lambda v: (0.0, 0.0, -v["length"])),
        ),
        swing_plan,
        2e-4,
        drives=(Drive("servo", "axle", "kp", "kv", "armature"),),
        links=("swing",),
        friction={"axle": "friction"},
        damping={"axle": "damping"},
        body="swing",
        engine="Drake",
    ),
    ForeignRig(
        "reach",
        REACH,
        {
            **{"mass_1": 0.9, "center_1": 0.13, "inertia_1": 0.007, "length_1": 0.28, "mass_2": 0.6, "center_2": 0.12},
            **{"inertia_2": 0.004, "length_2": 0.24, "kp_1": 90.0, "kv_1": 5.0, "kp_2": 45.0, "kv_2": 1.6},
            **{"armature_1": 0.03, "armature_2": 0.012, "damping_1": 0.1, "damping_2": 0.05},
        },
        ("mass_1", "mass_2", "inertia_1", "inertia_2", "kp_1", "kv_1", "kp_2", "kv_2", "armature_1", "armature_2"),
        ("center_1", "center_2", "length_1", "length_2"),
        (
            Sensor("shoulder_encoder", "fine_angle", "shoulder"),
            Sensor("elbow_encoder", "fine_angle", "elbow"),
            Sensor("hand_position", "marker", "fore", _hand),
        ),
        reach_plan,
        2e-4,
        drives=(
            Drive("shoulder_servo", "shoulder", "kp_1", "kv_1", "armature_1"),
            Drive("elbow_servo", "elbow", "kp_2", "kv_2", "armature_2", weight=0.5),
        ),
        links=("upper", "fore"),
        damping={"shoulder": "damping_1", "elbow": "damping_2"},
        body="fore",
        engine="Drake",
    ),
    ForeignRig(
        "gantry",
        GANTRY,
        {
            **block(0.05, 0.04, 0.025, 0.35),
            **{"bridge": 1.2, "carriage": 0.7, "damping": 3.0, "friction_x": 0.4, "friction_y": 0.3},
            **{"kp_x": 1800.0, "kv_x": 70.0, "kp_y": 1400.0, "kv_y": 45.0, "friction": 0.35},
            **{"finger_radius": 0.01, "finger_length": 0.02, "pad": 0.2, "no_armature": 0.0},
        },
        ("mass", "bridge", "carriage", "kp_x", "kv_x", "kp_y", "kv_y"),
        ("half_x", "half_y", "half_z", "finger_radius"),
        (Sensor("encoder_x", "travel", "slide_x"), Sensor("encoder_y", "travel", "slide_y"), *tracked("block")),
        gantry_plan,
        5e-4,
        drives=(
            Drive("motor_x", "slide_x", "kp_x", "kv_x", "no_armature"),
            Drive("motor_y", "slide_y", "kp_y", "kv_y", "no_armature", weight=0.7),
        ),
        links=("bridge", "carriage"),
        friction={"slide_x": "friction_x", "slide_y": "friction_y"},
        damping={"slide_x": "damping", "slide_y": "damping"},
        body="block",
        shape="box",
        finger="carriage",
        engine="Drake",
    ),
    ForeignRig(
        "launch",
        LAUNCH,
        {**block(0.045, 0.035, 0.02, 0.25), "friction": 0.3},
        ("mass",),
        ("half_x", "half_y", "half_z"),
        tracked("block"),
        launch_plan,
        5e-4,
        body="block",
        shape="box",
        throws=5,
        engine="Drake",
    ),
    ForeignRig(
        "bounce",
        BOUNCE,
        {**ball(0.035, 0.06, 0.5), **nominal_contact(6e3, 0.1, 0.06), "friction": 0.04},
        ("mass", "inertia"),
        ("radius",),
        (Sensor("ball_position", "position", "ball"),),
        bounce_plan,
        1e-4,
        body="ball",
        shape="ball",
        bounces=True,
        throws=5,
        engine="Drake",
    ),
    ForeignRig(
        "roll",
        ROLL,
        {**ball(0.03, 0.12, 0.4), "friction": 0.15},
        ("mass", "inertia"),
        ("radius",),
        tracked("ball"),
        roll_plan,
        5e-4,
        body="ball",
        shape="ball",
        throws=4,
        start_recorded=True,
        engine="Drake",
    ),
    ForeignRig(
        "toss",
        TOSS,
        {**block(0.06, 0.035, 0.02, 0.3), "inertia_x": 1.7e-4, "inertia_y": 4.2e-4, "inertia_z": 5.0e-4},
        ("mass", "inertia_x+inertia_y+inertia_z"),
        (),
        tracked("brick"),
        toss_plan,
        1e-3,
        continuous=True,
        body="brick",
        throws=6,
        start_recorded=True,
        engine="Drake",
    ),
)
DRAKE_RIGS = {rig.name: rig for rig in _RIGS}
"""By name."""
