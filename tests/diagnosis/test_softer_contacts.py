"""Contacts of bodies on joints that are softer, harder or bouncier than the model's, and one moment of inertia."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.fit.effects.fit import fit_effects
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

G = 9.81
BALL = """
<mujoco><option timestep="0.001"/><worldbody><geom type="plane" size="1 1 0.1" solref="0.02 0.2"/>
  <body name="ball" pos="0 0 0.03"><joint name="height" type="slide" axis="0 0 1"/>
    <geom size="0.03" mass="0.05" solref="0.02 0.2"/></body></worldbody>
<sensor><jointpos name="height" joint="height"/></sensor></mujoco>"""
"""A ball of which the height alone is seen, on a floor from which it rebounds at 57 % of its speed."""
DOOR = """
<mujoco><option timestep="0.001"/><default><geom solref="{time} 1"/></default><worldbody>
  <body name="finger" pos="0.3 -0.1 0"><joint name="finger" type="slide" axis="0 1 0" damping="1"/>
    <geom type="capsule" size="0.012 0.05" mass="0.3"/></body>
  <body name="door"><joint name="door" axis="0 0 1" stiffness="2" damping="0.05"/>
    <geom type="box" pos="0.2 0 0" size="0.2 0.01 0.15" mass="0.8"/></body></worldbody>
<actuator><position name="push" joint="finger" kp="200" kv="20"/></actuator>
<sensor><jointpos name="finger" joint="finger"/><jointpos name="door" joint="door"/></sensor></mujoco>"""
"""A finger on a servo presses on a door with a spring."""
SPINNING = """
<mujoco><option timestep="0.002"/><worldbody><body name="thing" pos="0 0 1"><freejoint/>
  <inertial pos="0 0 0" mass="0.4" diaginertia="4e-4 9e-4 12e-4"/>
  <geom size="0.05" contype="0" conaffinity="0" mass="0"/></body></worldbody>
<sensor><framequat name="turn" objtype="xbody" objname="thing"/></sensor></mujoco>"""


def diagnosed(scene: str, recorded: Demonstration | tuple[Demonstration, ...], *effects: str) -> Diagnosis:
    """Return the diagnosis of one demonstration, or several, with some candidates."""
    cfg = replace(DiagnoseCfg(), effects=effects, jobs=1, null_samples=100, explain=False)
    demonstrations = recorded if isinstance(recorded, tuple) else (recorded,)
    return diagnose(Model(Scene(scene)), Recording(scene, demonstrations), cfg)


def bounces(restitution: float, time: np.ndarray) -> np.ndarray:
    """Return heights [m] of a ball that is dropped from 0.4 m and keeps a share of its speed in each impact."""
    height, begun, up = np.zeros(len(time)), -np.sqrt(2 * 0.4 / G), np.sqrt(2 * 0.4 * G)
    while up > 0.05:
        lasting = 2 * up / G
        within = (time >= begun) & (time < begun + lasting)
        height[within] = up * (time[within] - begun) - G / 2 * (time[within] - begun) ** 2
        begun, up = begun + lasting, restitution * up
    return height


def test_a_ball_that_rebounds_less_than_the_models_is_seen_by_its_height_alone():
    time = np.arange(0, 1.2, 1 / 100)
    seen = bounces(0.35, time) + np.random.default_rng(0).normal(0, 1e-3, len(time))
    recorded = Demonstration("demo_0", measured={"height": Channel(time, seen[:, None], 1e-3)})
    found = diagnosed(BALL, recorded, "contact_compliance", "sensor_bias", "sensor_gain", "joint_offset")
    assert found.verdict == "effect"
    (effect,) = found.accepted
    assert effect.name == "contact_compliance"


PUCK = """
<mujoco><option timestep="0.001" gravity="0 0 0"/><default><geom solref="0.04 0.15" friction="0"/></default><worldbody>
  <geom type="plane" size="1 1 0.1" pos="-0.4 0 0" euler="0 90 0"/>
  <geom type="plane" size="1 1 0.1" pos="0.4 0 0" euler="0 -90 0"/>
  <body name="puck"><joint name="x" type="slide" axis="1 0 0" damping="0.001"/>
    <joint name="y" type="slide" axis="0 1 0" damping="0.001"/><joint name="heading" axis="0 0 1"/>
    <geom size="0.05" mass="0.1"/></body></worldbody>
<sensor><framepos name="place" objtype="body" objname="puck"/><jointpos name="heading" joint="heading"/></sensor>
</mujoco>"""
"""A puck that glides between cushions; a camera reads its place, a gyroscope that is integrated its heading."""


def shot(number: int, qpos: list[float], qvel: list[float]) -> Demonstration:
    """Return what a camera and a gyroscope see of a puck from a state on, between cushions with twice the damping."""
    m = mujoco.MjModel.from_xml_string(PUCK.replace('solref="0.04 0.15"', 'solref="0.04 0.3"'))
    m.opt.timestep = 0.0005
    d, rng, time, states = mujoco.MjData(m), np.random.default_rng(number), np.arange(0, 2.5, 1 / 50), []
    d.qpos[:], d.qvel[:] = qpos, qvel
    for _ in time:
        states.append(d.qpos.copy())
        for _ in range(40):
            mujoco.mj_step(m, d)
    seen, height = np.array(states), np.full((len(time), 1), np.nan)
    place = np.hstack([seen[:, :2] + rng.normal(0, 5e-4, (len(time), 2)), height])
    heading = seen[:, 2:] + rng.normal(0, 5e-3, (len(time), 1))
    channels = {"place": Channel(time, place, 5e-4), "heading": Channel(time, heading, 5e-3)}
    return Demonstration(f"demo_{number}", measured=channels)


def test_cushions_from_which_a_puck_rebounds_less_than_the_models_are_seen_by_a_camera_alone():
    shots = shot(0, [-0.1, -0.06, 0.0], [0.6, 0.05, 0.3]), shot(1, [0.2, 0.03, 1.0], [-0.9, -0.02, -0.5])
    found = diagnosed(PUCK, shots, "contact_compliance", "joint_friction", "wind")
    assert found.verdict == "effect"
    (effect,) = found.accepted
    assert effect.name == "contact_compliance"
    damping = effect.parameters[1]
    assert 0.2 < damping.low < 0.3 < damping.high < 0.4
    assert found.ratio[-1] < 1.2


def pressed(time_constant: float) -> Demonstration:
    """Return a finger that presses on the door and lets go of it, in contacts of a time constant [s]."""
    m = mujoco.MjModel.from_xml_string(DOOR.format(time=time_constant))
    m.opt.timestep = 0.0005
    d, rows = mujoco.MjData(m), []
    clock = np.arange(0, 2, 0.02)
    command = 0.1 - 0.06 * np.cos(4 * clock) + 0.03 * np.sign(np.sin(7 * clock))
    for u in command:
        rows.append(d.qpos.copy())
        d.ctrl[0] = u
        mujoco.mj_step(m, d, 40)
    seen = np.array(rows) + np.random.default_rng(1).normal(0, 3e-4, (len(clock), 2))
    measured = {name: Channel(clock, seen[:, [k]], 3e-4) for k, name in enumerate(("finger", "door"))}
    return Demonstration("demo_0", qpos=np.zeros(2), qvel=np.zeros(2), action={"push": Channel(clock, command)},
                         measured=measured)  # fmt: skip


def test_a_softer_contact_of_a_finger_and_a_door_is_a_candidate_that_explains_what_encoders_read():
    scene, recorded = DOOR.format(time=0.02), pressed(0.08)
    model, (effect,) = Model(Scene(scene)), candidates(Model(Scene(scene)), recorded.measured, ["contact_compliance"])
    assert effect.target == ("finger", "door")
    fit = fit_effects(model.add(effect), Recording(scene, (recorded,)))
    assert fit.before > 10
    assert fit.after < 1.1
    ((time, ratio),) = fit.parameters
    assert time.value == pytest.approx(0.08, rel=0.05)
    assert ratio.value == pytest.approx(1.0, rel=0.1)


def test_one_moment_of_inertia_of_a_body_that_spins_in_flight_is_named_by_its_axis():
    moments, rng = np.array([4e-4, 12e-4, 12e-4]), np.random.default_rng(2)

    def motion(_: float, state: np.ndarray) -> np.ndarray:
        (x, y, z, w), spin = state[:4], state[4:]
        turn = 0.5 * np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]]) @ spin
        return np.concatenate([turn, np.cross(moments * spin, spin) / moments])

    time = np.arange(0, 0.8, 0.01)
    spun = solve_ivp(motion, (0, 0.8), [0, 0, 0, 1, 2.0, 6.0, -3.0], t_eval=time, rtol=1e-9, atol=1e-12)
    seen = Rotation.from_quat(spun.y[:4].T) * Rotation.from_rotvec(rng.normal(0, 3e-3, (len(time), 3)))
    recorded = Demonstration("demo_0", measured={"turn": Channel(time, seen.as_quat(scalar_first=True), 3e-3)})
    found = diagnosed(SPINNING, recorded, "inertia", "center_of_mass")
    assert found.verdict == "effect"
    (effect,) = found.accepted
    assert (effect.name, effect.target) == ("inertia(thing, axis_y)", ("thing", "axis_y"))
    assert abs(effect.parameters[0].value - 12 / 9) < 0.06
