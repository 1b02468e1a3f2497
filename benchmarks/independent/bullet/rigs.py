"""Six experiments of the world on Bullet, with the nominal scenes of their users.

`lift`: an arm of two joints in a vertical plane. `cart`: a driven slide with a pendulum that hangs on it. `shove`: a
block slides and turns to rest. `poke`: a finger of two tips on two slides pushes a block. `lob`: a soft ball flies and
bounces, of which only the position is tracked. `ramp`: a ball rolls on an inclined table; its position is tracked.
Blocks are square and stand on a small foot. The nominal contact of the bouncing ball has the frequency and damping of
the world's linear spring and damper on the ball's mass; other nominal contacts are MuJoCo's default.
"""

from __future__ import annotations

import numpy as np

from benchmarks.independent.foreign.plans import RATE, cosine, ramp, rest, timed, tones
from benchmarks.independent.foreign.rig import Drive, ForeignRig, ForeignTrial, Sensor
from benchmarks.independent.foreign.values import BALL, ball, nominal_contact, tracked

LIFT = """
<mujoco model="lift">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="boom" pos="0 0 0.6">
      <joint name="hoist" type="hinge" axis="0 1 0"
        damping="{damping_1}" armature="{armature_1}" frictionloss="{dry_1}"/>
      <inertial pos="{center_1} 0 0" mass="{mass_1}" diaginertia="4e-4 {inertia_1} {inertia_1}"/>
      <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" contype="0" conaffinity="0"/>
      <body name="jib" pos="{length_1} 0 0">
        <joint name="knee" type="hinge" axis="0 1 0"
          damping="{damping_2}" armature="{armature_2}" frictionloss="{dry_2}"/>
        <inertial pos="{center_2} 0 0" mass="{mass_2}" diaginertia="2e-4 {inertia_2} {inertia_2}"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.015" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hoist_servo" joint="hoist" kp="{kp_1}" kv="{kv_1}"/>
    <position name="knee_servo" joint="knee" kp="{kp_2}" kv="{kv_2}"/>
  </actuator>
  <sensor>
    <jointpos name="hoist_encoder" joint="hoist"/>
    <jointpos name="knee_encoder" joint="knee"/>
  </sensor>
</mujoco>
"""


def lift_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a move, a slow sweep at constant speed, and tones of both joints: 5.6 s."""
    series = []
    for first, second in (
        (rng.uniform(-0.9, -0.5), rng.uniform(0.1, 0.5)),
        (rng.uniform(0.5, 1.0), -rng.uniform(0.3, 0.8)),
    ):
        sweep = np.linspace(first, second, round(1.8 * RATE))
        wave = tones(rng, second, 0.35, 0.5, 2.5, 2.4)
        series.append(
            np.concatenate([rest(0.0, 0.3), cosine(0.0, first, 0.8), rest(first, 0.2), sweep, rest(second, 0.1), wave])
        )
    return ForeignTrial(5.6, {"hoist_servo": timed(series[0]), "knee_servo": timed(series[1])}, before=1.0)


CART = """
<mujoco model="cart">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="cart" pos="0 0 0.5">
      <joint name="rail" type="slide" axis="1 0 0" damping="{damping}" frictionloss="{dry}"/>
      <inertial pos="0 0 0" mass="{cart}" diaginertia="0.001 0.001 0.001"/>
      <body name="pendulum">
        <joint name="pivot" type="hinge" axis="0 1 0" damping="{pivot}"/>
        <inertial pos="0 0 -{center}" mass="{mass}" diaginertia="{inertia} {inertia} 2e-5"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.006" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="rail_motor" joint="rail" kp="{kp}" kv="{kv}"/>
  </actuator>
  <sensor>
    <jointpos name="rail_encoder" joint="rail"/>
    <jointpos name="pivot_encoder" joint="pivot"/>
  </sensor>
</mujoco>
"""


def cart_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample two strokes, then tones about the pendulum's frequency, then a rest in which it swings: 5.6 s."""
    a, b = rng.uniform(0.06, 0.1), -rng.uniform(0.04, 0.08)
    wave = tones(rng, 0.0, 0.04, 0.5, 2.2, 2.6)
    parts = rest(0.0, 0.2), cosine(0.0, a, 0.5), rest(a, 0.3), ramp(a, b, 0.25), cosine(b, 0.0, 0.4), wave
    series = np.concatenate(parts)
    left = round(5.6 * RATE) - len(series)
    return ForeignTrial(5.6, {"rail_motor": timed(series, np.full(left, series[-1]))}, before=0.5)


BLOCK = """
    <body name="block" pos="0 0 {half_z}">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia_z}"/>
      <geom name="plate" type="box" size="{half} {half} 0.02" pos="0 0 0.005" friction="{pad} 0.005 0.0001"/>
      <geom name="foot" type="box" size="{foot} {foot} 0.005" pos="0 0 -0.02" friction="{friction} 0.005 0.0001"/>
    </body>
"""
"""A square block on a foot; its frame is 25 mm above the table."""
SHOVE = f"""
<mujoco model="shove">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="2 2 0.1" friction="{{friction}} 0.005 0.0001"/>{BLOCK}  </worldbody>
  <sensor>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


def shove_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a block that slides over the middle of the table and turns, until it rests."""
    heading, turn, speed = *rng.uniform(-np.pi, np.pi, 2), rng.uniform(0.6, 1.1)
    x, y = rng.uniform(-0.02, 0.02, 2) - 0.1 * np.array([np.cos(heading), np.sin(heading)])
    pose = (x, y, 0.025, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
    velocity = (
        speed * np.cos(heading),
        speed * np.sin(heading),
        0.0,
        0.0,
        0.0,
        rng.choice([-1, 1]) * rng.uniform(2, 6),
    )
    return ForeignTrial(speed / 2.45 + 0.25, pose=pose, velocity=velocity)


POKE = f"""
<mujoco model="poke">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1" friction="{{friction}} 0.005 0.0001"/>
    <body name="beam" pos="-0.08 0 0.026">
      <joint name="slide_x" type="slide" axis="1 0 0" damping="{{damping}}" frictionloss="{{dry_x}}"/>
      <inertial pos="0 0 0" mass="{{beam}}" diaginertia="0.002 0.002 0.002"/>
      <body name="finger">
        <joint name="slide_y" type="slide" axis="0 1 0" damping="{{damping}}" frictionloss="{{dry_y}}"/>
        <inertial pos="0 0 0" mass="{{finger}}" diaginertia="0.001 0.001 0.001"/>
        <geom name="left" type="sphere" size="{{tip}}" pos="0 0.02 0" friction="{{pad}} 0.005 0.0001"/>
        <geom name="right" type="sphere" size="{{tip}}" pos="0 -0.02 0" friction="{{pad}} 0.005 0.0001"/>
      </body>
    </body>{BLOCK}  </worldbody>
  <actuator>
    <position name="motor_x" joint="slide_x" kp="{{kp_x}}" kv="{{kv_x}}"/>
    <position name="motor_y" joint="slide_y" kp="{{kp_y}}" kv="{{kv_y}}"/>
  </actuator>
  <sensor>
    <jointpos name="encoder_x" joint="slide_x"/>
    <jointpos name="encoder_y" joint="slide_y"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


def poke_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a push of about 40 mm, a retreat with a sideways move, and a second push to about 80 mm: 6 s."""
    near, far, end = rng.uniform(0.055, 0.065), rng.uniform(0.01, 0.02), rng.uniform(0.095, 0.105)
    first, second = rng.uniform(0.004, 0.012, 2) * rng.choice([-1, 1])
    x = np.concatenate(
        [
            *(rest(0, 0.4), ramp(0, near, rng.uniform(0.04, 0.05)), rest(near, 0.2), cosine(near, far, 0.6)),
            *(rest(far, 0.4), ramp(far, end, rng.uniform(0.05, 0.07)), rest(end, 0.2), cosine(end, 0.02, 0.8)),
        ]
    )
    y = np.concatenate([cosine(0, first, 0.4), rest(first, 2.3), cosine(first, -second, 0.4)])
    lines = [np.concatenate([s, np.full(round(6 * RATE) - len(s), s[-1])]) for s in (x, y)]
    turn = rng.uniform(-0.15, 0.15)
    pose = (*rng.uniform(-0.003, 0.003, 2), 0.025, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
    return ForeignTrial(6.0, {"motor_x": timed(lines[0]), "motor_y": timed(lines[1])}, pose=pose, before=0.3)


LOB = BALL.format(
    model="lob",
    contact='solref="{time_constant} {damping_ratio}" solimp="0.98 0.98 0.001"',
    height=0.5,
    table="",
    extra="",
)
RAMP = BALL.format(model="ramp", contact="", height="{radius}", table=' euler="0 {slope} 0"', extra="")


def lob_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a throw that meets the table once."""
    heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.6, 1.6)
    pose = (*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.3, 0.45), 1.0, 0.0, 0.0, 0.0)
    velocity = (speed * np.cos(heading), speed * np.sin(heading), rng.uniform(0.8, 1.8), *rng.uniform(-2, 2, 3))
    return ForeignTrial(0.85, pose=pose, velocity=velocity)


def ramp_plan(rng: np.random.Generator) -> ForeignTrial:
    """Sample a ball that rolls without slip across the slope, and then down."""
    heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.1, 0.3)
    along, across = speed * np.cos(heading), speed * np.sin(heading)
    x, y = rng.uniform(-0.04, 0.0), -0.1 * np.sin(heading)
    pose = (x, y, 0.025, 1.0, 0.0, 0.0, 0.0)
    return ForeignTrial(1.6, pose=pose, velocity=(along, across, 0.0, -across / 0.025, along / 0.025, 0.0))


_BLOCK = {"half": 0.05, "half_z": 0.025, "foot": 0.018, "inertia": 5e-4, "inertia_z": 9e-4}
_RIGS = (
    ForeignRig(
        "lift",
        LIFT,
        {
            **{"mass_1": 0.8, "center_1": 0.11, "inertia_1": 0.005, "length_1": 0.25, "mass_2": 0.5, "center_2": 0.1},
            **{"inertia_2": 0.003, "kp_1": 60.0, "kv_1": 3.5, "kp_2": 25.0, "kv_2": 1.0, "dry_1": 0.03, "dry_2": 0.015},
            **{"armature_1": 0.02, "armature_2": 0.008, "damping_1": 0.08, "damping_2": 0.04},
        },
        ("mass_1", "mass_2", "inertia_1", "inertia_2", "kp_1", "kv_1", "kp_2", "kv_2", "armature_1", "armature_2"),
        ("center_1", "center_2", "length_1"),
        (Sensor("hoist_encoder", "fine_angle", "hoist"), Sensor("knee_encoder", "fine_angle", "knee")),
        lift_plan,
        2.5e-4,
        drives=(
            Drive("hoist_servo", "hoist", "kp_1", "kv_1", "armature_1"),
            Drive("knee_servo", "knee", "kp_2", "kv_2", "armature_2", weight=0.5),
        ),
        links=("boom", "jib"),
        friction={"hoist": "dry_1", "knee": "dry_2"},
        damping={"hoist": "damping_1", "knee": "damping_2"},
        body="jib",
        throws=2,
        engine="Bullet",
    ),
    ForeignRig(
        "cart",
        CART,
        {
            **{"cart": 0.7, "mass": 0.2, "center": 0.2, "inertia": 8e-4, "kp": 800.0, "kv": 30.0, "damping": 2.0},
            **{"dry": 0.2, "pivot": 4e-3, "no_armature": 0.0},
        },
        ("cart", "mass", "inertia", "kp", "kv"),
        ("center",),
        (Sensor("rail_encoder", "travel", "rail"), Sensor("pivot_encoder", "angle", "pivot")),
        cart_plan,
        2.5e-4,
        drives=(Drive("rail_motor", "rail", "kp", "kv", "no_armature"),),
        links=("cart", "pendulum"),
        friction={"rail": "dry"},
        damping={"rail": "damping", "pivot": "pivot"},
        body="pendulum",
        throws=2,
        engine="Bullet",
    ),
    ForeignRig(
        "shove",
        SHOVE,
        {**_BLOCK, "mass": 0.4, "friction": 0.25, "pad": 0.25},
        ("mass", "inertia+inertia_z"),
        ("half", "half_z", "foot"),
        tracked("block"),
        shove_plan,
        2.5e-4,
        body="block",
        shape="box",
        throws=5,
        engine="Bullet",
    ),
    ForeignRig(
        "poke",
        POKE,
        {
            **_BLOCK,
            **{"mass": 0.4, "friction": 0.3, "pad": 0.15, "tip": 0.012, "beam": 1.0, "finger": 0.6, "damping": 4.0},
            **{"dry_x": 0.25, "dry_y": 0.15, "kp_x": 1600.0, "kv_x": 70.0, "kp_y": 1300.0, "kv_y": 45.0},
            "no_armature": 0.0,
        },
        ("mass", "inertia+inertia_z", "beam", "finger", "kp_x", "kv_x", "kp_y", "kv_y"),
        ("half", "foot", "tip"),
        (Sensor("encoder_x", "travel", "slide_x"), Sensor("encoder_y", "travel", "slide_y"), *tracked("block")),
        poke_plan,
        2.5e-4,
        drives=(
            Drive("motor_x", "slide_x", "kp_x", "kv_x", "no_armature"),
            Drive("motor_y", "slide_y", "kp_y", "kv_y", "no_armature", weight=0.7),
        ),
        links=("beam", "finger"),
        friction={"slide_x": "dry_x", "slide_y": "dry_y"},
        damping={"slide_x": "damping", "slide_y": "damping"},
        body="block",
        shape="box",
        finger="finger",
        engine="Bullet",
    ),
    ForeignRig(
        "lob",
        LOB,
        {**ball(0.035, 0.06, 0.5), **nominal_contact(6e3, 0.12, 0.06), "friction": 0.03},
        ("mass", "inertia"),
        ("radius",),
        (Sensor("ball_position", "position", "ball"),),
        lob_plan,
        1e-4,
        body="ball",
        shape="ball",
        bounces=True,
        throws=5,
        engine="Bullet",
    ),
    ForeignRig(
        "ramp",
        RAMP,
        {**ball(0.025, 0.1, 0.4), "friction": 0.3, "slope": 0.06},
        ("mass", "inertia"),
        ("radius",),
        (Sensor("ball_position", "position", "ball"),),
        ramp_plan,
        2.5e-4,
        body="ball",
        shape="ball",
        throws=5,
        start_recorded=True,
        engine="Bullet",
    ),
)
BULLET_RIGS = {rig.name: rig for rig in _RIGS}
"""By name."""
