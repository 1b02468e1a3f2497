"""Couplings and stops that give way by MuJoCo's default constants, on rigid motions by equations written here."""

from __future__ import annotations

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.parallel import limit_simulations

STEP, NOISE = 1e-4, 3e-4
"""Step of the equations [s], and noise of the encoders [rad or m]."""
ROTOR, ARM, LEVER, RATIO, KP, KV, DAMPING = 0.02, 0.06, 0.9, 0.5, 30.0, 1.0, 0.05
"""Inertias of a pulley and of the arm that its belt turns [kg m^2], weight times lever of the arm [N m], its angle over
that of the pulley, gains of the servo [N m/rad, N m s/rad], and damping of the arm [N m s/rad]."""
BELT = f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="pulley"><joint name="motor" axis="0 1 0"/>
<inertial pos="0 0 0" mass="1" diaginertia="{ROTOR} {ROTOR} {ROTOR}"/></body>
<body name="arm" pos="0.5 0 0"><joint name="shoulder" axis="0 1 0" damping="{DAMPING}"/>
<inertial pos="{LEVER / 9.81} 0 0" mass="1" diaginertia=".04 {ARM - (LEVER / 9.81) ** 2} .04"/></body></worldbody>
<equality><joint joint1="shoulder" joint2="motor" polycoef="0 {RATIO} 0 0 0"{{own}}/></equality>
<actuator><position name="servo" joint="motor" kp="{KP}" kv="{KV}"/></actuator>
<sensor><jointpos name="of_motor" joint="motor"/><jointpos name="of_shoulder" joint="shoulder"/></sensor></mujoco>"""
FINGER, STOP, DRAG = 0.04, 0.03, 60.0
"""Mass of a finger [kg], where its stop is [m], and its damping [N s/m]."""
STOPPED = f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="finger">
<joint name="slide" type="slide" axis="1 0 0" limited="true" range="-.05 {STOP}" damping="{DRAG}"/>
<inertial pos="0 0 0" mass="{FINGER}" diaginertia="1e-5 1e-5 1e-5"/></body></worldbody>
<actuator><motor name="force" joint="slide"/></actuator>
<sensor><jointpos name="of_slide" joint="slide"/></sensor></mujoco>"""
CABIN, COUNTERWEIGHT, SHEAVE, RADIUS, SPEED_GAIN = 30.0, 36.0, 1.0, 0.2, 100.0
"""Masses of a lift [kg], inertia of its sheave [kg m^2], its radius [m], and gain of the drive [N m s/rad]."""
LIFT = f"""<mujoco><option timestep="0.002"/><worldbody>
<body name="sheave"><joint name="sheave" axis="0 1 0" damping="1"/>
<inertial pos="0 0 0" mass="5" diaginertia="{SHEAVE} {SHEAVE} {SHEAVE}"/></body>
<body name="cabin" pos=".2 0 0"><joint name="cabin" type="slide" axis="0 0 1"/>
<inertial pos="0 0 0" mass="{CABIN}" diaginertia="1 1 1"/></body>
<body name="counterweight" pos="-.2 0 0"><joint name="counterweight" type="slide" axis="0 0 1"/>
<inertial pos="0 0 0" mass="{COUNTERWEIGHT}" diaginertia="1 1 1"/></body></worldbody>
<equality><joint joint1="cabin" joint2="sheave" polycoef="0 {-RADIUS} 0 0 0"/>
<joint joint1="counterweight" joint2="sheave" polycoef="0 {RADIUS} 0 0 0"/></equality>
<actuator><velocity name="drive" joint="sheave" kv="{SPEED_GAIN}"/></actuator>
<sensor><jointpos name="of_sheave" joint="sheave"/><jointpos name="of_cabin" joint="cabin"/></sensor></mujoco>"""
CFG = cw.DiagnoseCfg(jobs=1, explain=False)


def turned(seconds: float = 4.0) -> Recording:
    """Return a recording of the servo, whose belt does not give way."""
    rng = np.random.default_rng(2)
    time = np.arange(round(seconds / 0.01)) * 0.01
    command = 1.2 * np.sin(0.8 * np.pi * time) + 0.5 * np.sin(2.2 * np.pi * time)
    q, v, rows = 0.0, 0.0, []
    inertia = ROTOR + RATIO**2 * ARM
    for k in range(round(seconds / STEP)):
        if k % 100 == 0:
            rows.append((q, RATIO * q))
        torque = KP * (command[k // 100] - q) - KV * v + RATIO * (LEVER * np.cos(RATIO * q) - DAMPING * RATIO * v)
        v += STEP * torque / inertia
        q += STEP * v
    seen = np.array(rows) + rng.normal(0, NOISE, (len(rows), 2))
    measured = {name: Channel(time, seen[:, [k]]) for k, name in enumerate(("of_motor", "of_shoulder"))}
    demo = Demonstration("d", action={"servo": Channel(time, command[:, None])}, measured=measured)
    return Recording(BELT.format(own=""), (demo,))


def pressed(seconds: float = 4.0) -> Recording:
    """Return a recording of the finger, which comes to rest at a stop that does not give way."""
    rng = np.random.default_rng(4)
    time = np.arange(round(seconds / 0.01)) * 0.01
    command = np.select([time % 2 < 0.7, time % 2 < 1.2], [8.0 + 4.0 * (time > 2), 2.0], -0.4)
    x, v, rows = 0.0, 0.0, []
    for k in range(round(seconds / STEP)):
        if k % 100 == 0:
            rows.append(x)
        force = command[k // 100] - DRAG * v
        v += STEP * force / FINGER
        x += STEP * v
        if x >= STOP:
            x, v = STOP, min(v, 0.0)
    seen = np.array(rows)[:, None] + rng.normal(0, 5e-5, (len(rows), 1))
    measured = {"of_slide": Channel(time, seen)}
    demo = Demonstration("d", action={"force": Channel(time, command[:, None])}, measured=measured)
    return Recording(STOPPED, (demo,))


def lifted(seconds: float = 8.0) -> Recording:
    """Return a recording of the lift, whose ropes are not stretched; its masses are 0.4 % off."""
    rng = np.random.default_rng(6)
    time = np.arange(round(seconds / 0.01)) * 0.01
    command = np.interp(time, [0, 0.5, 1, 3, 3.5, 4, 6, 6.5], [0, 0, 2, 2, 0, -2.5, -2.5, 0])
    cabin, counterweight, angle, speed, rows = 1.004 * CABIN, 0.996 * COUNTERWEIGHT, 0.0, 0.0, []
    inertia = SHEAVE + (cabin + counterweight) * RADIUS**2
    for k in range(round(seconds / STEP)):
        if k % 100 == 0:
            rows.append((angle, -RADIUS * angle))
        torque = SPEED_GAIN * (command[k // 100] - speed) - speed + (cabin - counterweight) * 9.81 * RADIUS
        speed += STEP * torque / inertia
        angle += STEP * speed
    seen = np.array(rows) + rng.normal(0, (NOISE, 5e-4), (len(rows), 2))
    measured = {name: Channel(time, seen[:, [k]]) for k, name in enumerate(("of_sheave", "of_cabin"))}
    demo = Demonstration("d", action={"drive": Channel(time, command[:, None])}, measured=measured)
    return Recording(LIFT, (demo,))


@pytest.mark.slow
def test_ropes_that_hold_are_found_beside_wrong_masses_and_a_long_step():
    found = cw.diagnose(Model(Scene(LIFT)), lifted(), CFG)
    assert (found.verdict, found.accepted) == ("none_needed", ())
    assert [one.where for one in found.holding] == ["equalities"]
    assert found.ratio[-1] < 1.1


@pytest.mark.parametrize(("recording", "where"), [(turned(), "equalities"), (pressed(), "limits")])
def test_what_does_not_give_way_is_no_missing_effect(recording, where):
    with limit_simulations(1):
        found = cw.diagnose(Model(Scene(recording.scene)), recording, CFG)
    assert (found.verdict, found.accepted) == ("none_needed", ())
    assert where in [one.where for one in found.holding]
    assert found.ratio[-1] < 1.25
    (said,) = (one.sentence for one in found.holding if one.where == where)
    assert "give way" in said
    assert said in found.to_json()["changes_besides"]
