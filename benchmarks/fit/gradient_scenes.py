"""Four small scenes in which an object's shape decides its motion: it settles, is pushed, tumbles, is inserted.

The truth is an exact box in C MuJoCo with elliptic cones and a finer time step; 24 points on it are tracked at 60 Hz
with 0.1 mm of noise. Two demonstrations each: the first is fitted, the second judges. The model that is fitted has
spheres in place of the box; they start too large or too small by 0.8 to 2 mm, with smooth dents of 0.7 mm.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.fit.geometry.offset import offset_directions
from concent_warp.fit.geometry.perturbation import Perturbation
from concent_warp.model import ContactParameters, Model
from concent_warp.recording.recording import Channel, Demonstration, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

SceneName = Literal["settle", "push", "tumble", "insertion"]
SCENES: tuple[SceneName, ...] = ("settle", "push", "tumble", "insertion")
RATE, NOISE = 60.0, 1e-4
"""Frames a second, and standard deviation of a coordinate of a tracked point [m]."""
DENT = 7e-4
"""Standard deviation of the dents of a starting geometry [m]."""
HOLE = 0.0225
"""Inner width of the socket [m]; the peg is 20 mm wide."""


def option(timestep: float) -> str:
    """Return the options of a scene."""
    return f'<option timestep="{timestep}" cone="elliptic" impratio="3"/><compiler angle="radian"/>'


def body(name: str, half: tuple[float, float, float], height: float) -> str:
    """Return a free box of 80 g."""
    size = " ".join(map(str, half))
    return (
        f'<body name="{name}" pos="0 0 {height}"><freejoint name="{name}_joint"/>'
        f'<geom name="{name}" type="box" size="{size}" mass="0.08" friction="0.4"/></body>'
    )


def sensors(name: str) -> str:
    """Return the sensors of a body's pose and velocity: windows start from them."""
    frame = f'objtype="xbody" objname="{name}"'
    return (
        f'<sensor><framepos name="position" {frame}/><framequat name="orientation" {frame}/>'
        "<jointpos name='slide_position' joint='slide'/></sensor>"
    )


SLIDE = '<actuator><position name="drive" joint="slide" kp="{kp}" kv="{kv}"/></actuator>'


def xml(scene: SceneName, timestep: float = 0.002) -> str:
    """Return the MJCF of a scene."""
    floor = '<geom name="floor" type="plane" size="1 1 0.1" friction="0.4"/>'
    if scene in ("settle", "tumble"):
        half = (0.03, 0.02, 0.015) if scene == "settle" else (0.02, 0.02, 0.02)
        text = sensors("block").replace("<jointpos name='slide_position' joint='slide'/>", "")
        return f"<mujoco>{option(timestep)}<worldbody>{floor}{body('block', half, 0.05)}</worldbody>{text}</mujoco>"
    if scene == "push":
        pusher = (
            '<body name="pusher" pos="-0.08 0 0.02"><joint name="slide" type="slide" axis="1 0 0"/>'
            '<geom name="pusher" type="box" size="0.01 0.012 0.01" mass="0.3" friction="0.4"/></body>'
        )
        drive = SLIDE.format(kp=2000, kv=60)
        world = f"{floor}{pusher}{body('block', (0.03, 0.03, 0.02), 0.02)}"
        return f"<mujoco>{option(timestep)}<worldbody>{world}</worldbody>{drive}{sensors('block')}</mujoco>"
    inner, wall = HOLE / 2, 0.006
    at = inner + wall / 2
    walls = "".join(
        f'<geom type="box" pos="{x} {y} 0.015" size="{a} {b} 0.015" friction="0.2"/>'
        for x, y, a, b in (
            (at, 0, wall / 2, inner + wall), (-at, 0, wall / 2, inner + wall),
            (0, at, inner, wall / 2), (0, -at, inner, wall / 2),
        )
    )  # fmt: skip
    plate = (
        '<body name="plate" pos="0 0 0.09"><joint name="slide" type="slide" axis="0 0 1"/>'
        '<geom name="plate" type="box" size="0.02 0.02 0.005" mass="0.3" friction="0.1"/></body>'
    )
    peg = body("block", (0.01, 0.01, 0.02), 0.05).replace('friction="0.4"', 'friction="0.2"')
    drive = SLIDE.format(kp=1000, kv=40).replace('kp="1000"', 'kp="1000" ctrlrange="-0.2 0.2"')
    names = '<custom><text name="concent_objects" data="block socket"/></custom>'
    world = f'{floor}<body name="socket">{walls}</body>{plate}{peg}'
    return f"<mujoco>{option(timestep)}{names}<worldbody>{world}</worldbody>{drive}{sensors('block')}</mujoco>"


def plan(scene: SceneName, rng: np.random.Generator) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Return duration [s], the block's pose (7,) and velocity (6,), and the drive's commands at 100 Hz (T,)."""
    turn = Rotation.from_euler("z", rng.uniform(-0.3, 0.3))
    place, speed, ctrl, duration = np.array([0.0, 0.0, 0.0]), np.zeros(6), np.zeros(1), 0.6
    if scene == "settle":
        axis = rng.choice([0, 1])
        turn = turn * Rotation.from_rotvec(np.eye(3)[axis] * rng.uniform(0.06, 0.12) * rng.choice([-1, 1]))
        place[2] = 0.022
    elif scene == "tumble":
        turn, duration = Rotation.random(rng=rng), 0.7
        place[2], speed = rng.uniform(0.06, 0.08), np.array([*rng.uniform(-0.3, 0.3, 2), -0.3, *rng.uniform(-4, 4, 3)])
    elif scene == "push":
        place, duration = np.array([0.0, rng.uniform(0.006, 0.012) * rng.choice([-1, 1]), 0.02]), 1.5
        ctrl = np.minimum(np.arange(150) / 100 * 0.09, 0.11)
    else:
        turn, duration = Rotation.from_euler("z", rng.uniform(-0.02, 0.02)), 0.8
        place = np.array([*rng.uniform(-6e-4, 6e-4, 2), 0.046])
        ctrl = -np.minimum(np.arange(80) / 100 * 0.1, 0.05)
    return duration, np.concatenate([place, turn.as_quat(scalar_first=True)]), speed, ctrl


def record(scene: SceneName, seed: int) -> Recording:
    """Return two demonstrations."""
    return Recording(xml(scene), tuple(perform(scene, np.random.default_rng([seed, k]), k) for k in range(2)))


def perform(scene: SceneName, rng: np.random.Generator, k: int) -> Demonstration:
    """Simulate and measure one demonstration."""
    spec = mujoco.MjSpec.from_string(xml(scene, 0.001))
    for geom in spec.geoms:
        geom.solref = [0.004, 1.0]
    m = spec.compile()
    d = mujoco.MjData(m)
    duration, pose, speed, ctrl = plan(scene, rng)
    joint = m.joint("block_joint")
    d.qpos[joint.qposadr[0] : joint.qposadr[0] + 7], d.qvel[joint.dofadr[0] : joint.dofadr[0] + 6] = pose, speed
    mujoco.mj_forward(m, d)
    qpos, qvel = d.qpos.copy(), d.qvel.copy()
    local = rng.uniform(-1, 1, (24, 3)) * m.geom("block").size
    times, points, read = [], [], []
    while d.time <= duration:
        if m.nu:
            d.ctrl[0] = ctrl[min(int(d.time * 100 + 1e-9), len(ctrl) - 1)]
        mujoco.mj_forward(m, d)
        if len(times) <= d.time * RATE + 1e-9:
            times.append(d.time)
            points.append(d.body("block").xpos + local @ d.body("block").xmat.reshape(3, 3).T)
            read.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    time, value, row = np.array(times), np.array(points), np.array(read)
    measured = {}
    for s in range(m.nsensor):
        columns = slice(m.sensor_adr[s], m.sensor_adr[s] + m.sensor_dim[s])
        measured[m.sensor(s).name] = Channel(time, row[:, columns])
    measured["position"] = Channel(time, measured["position"].value + NOISE / 2 * rng.standard_normal((len(time), 3)))
    track = PointTrack(time, value + NOISE * rng.standard_normal(value.shape), np.ones(value.shape[:2], dtype=bool))
    action = {"drive": Channel(np.arange(len(ctrl)) / 100, ctrl)} if m.nu else {}
    return Demonstration(f"demo_{k}", qpos=qpos, qvel=qvel, action=action, measured=measured, points={"block": track})


def starting_model(scene: SceneName, recording: Recording, seed: int) -> Model:
    """Return the model to fit: spheres of a size that is wrong, with dents."""
    drawn = Scene(recording.scene)
    count = 130 if scene == "insertion" else 64
    geometry = ContactGeometryCfg(count=count, radius=0.003, seed=seed).build(drawn)
    rng = np.random.default_rng([seed, 7])
    growth = offset_directions(geometry, drawn)
    # A peg that is too large, or a hole that is too tight, does not go in: that is the honest start there.
    size = rng.uniform(8e-4, 2e-3) * (1 if scene in ("insertion", "tumble") else rng.choice([-1, 1]))
    every = np.ones(len(geometry), dtype=bool)
    dents = DENT * Perturbation(geometry, every, "gaussian_process", 0.02).sample(1, 3, rng)[0]
    wrong: ContactGeometry = replace(geometry, position=geometry.position + size * growth + dents)
    return Model(drawn, wrong, ContactParameters())
