"""Springs in joints are told from weight, gains and damping, in logs that no engine of the library made."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import concent_warp as cw
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.recording.recording import Channel, Demonstration, Recording

DOOR = """
<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="door">
  <joint name="hinge" axis="0 0 1" damping="0.6"/>
  <geom type="box" pos="0.4 0 1" size="0.4 0.02 1" mass="12" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor name="hand" joint="hinge"/></actuator>
<sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>"""
"""A door without a drive; what a hand exerts was measured."""
DOOR_INERTIA = 12 * (0.8**2 + 0.04**2) / 12 + 12 * 0.4**2
ARM = """
<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="link">
  <joint name="elbow" axis="0 1 0" damping="0.05"/>
  <inertial pos="0 0 -0.15" mass="1.2" diaginertia="0.012 0.012 0.012"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" contype="0" conaffinity="0"/></body></worldbody>
<actuator><position name="servo" joint="elbow" kp="12" kv="0.8"/></actuator>
<sensor><jointpos name="angle" joint="elbow"/></sensor></mujoco>"""
"""A link on a servo, which hangs down at zero."""
ARM_INERTIA, WEIGHT = 0.012 + 1.2 * 0.15**2, 1.2 * 9.81 * 0.15
PERIOD, NOISE = 0.02, 5e-4
RIVALS = ("joint_stiffness", "joint_damping", "gravity_compensation", "actuator_gain")


def recorded(scene: str, actuator: str, command: np.ndarray, torque: Any, inertia: float, seed: int) -> Recording:
    """Return a recording of a joint that a torque moves from rest at zero, a function of angle, rate and command."""
    state, rows = np.zeros(2), [np.zeros(2)]
    for u in command[:-1]:
        moved = solve_ivp(lambda _, y, u=u: [y[1], torque(*y, u) / inertia], (0, PERIOD), state, rtol=1e-8, atol=1e-10)
        state = moved.y[:, -1]
        rows.append(state)
    time, rng = PERIOD * np.arange(len(command)), np.random.default_rng(seed)
    angle = np.array(rows)[:, :1] + rng.normal(0, NOISE, (len(time), 1))
    demonstration = Demonstration(
        "demo_0",
        qpos=np.zeros(1),
        qvel=np.zeros(1),
        action={actuator: Channel(time, command)},
        measured={"angle": Channel(time, angle, NOISE)},
    )
    return Recording(scene, (demonstration,))


def door(stiffness: float, preload: float, damping: float = 0.6) -> Recording:
    """Return a door that is pushed and pulled by hand."""
    time = np.arange(0, 4, PERIOD)
    pushes = 9 * np.sin(np.pi * time) ** 2 * np.sign(np.sin(0.5 * np.pi * time)) - preload
    return recorded(DOOR, "hand", pushes, lambda q, v, u: u - damping * v - stiffness * q + preload, DOOR_INERTIA, 1)


def arm(
    stiffness: float = 0.0,
    share: float = 0.0,
    kp: float = 1.0,
    kv: float = 1.0,
    reach: float = 0.8,
    seconds: float = 2.4,
) -> Recording:
    """Return an arm that swings; a share of its weight is held up, and the servo's gains are off by factors."""
    time = np.arange(0, seconds, PERIOD)
    command = reach * (0.6 * np.sin(2.2 * time) + 0.4 * np.sin(5 * time))

    def torque(q: float, v: float, u: float) -> float:
        return kp * 12 * (u - q) - kv * 0.8 * v - 0.05 * v - stiffness * q - (1 - share) * WEIGHT * np.sin(q)

    return recorded(ARM, "servo", command, torque, ARM_INERTIA, 2)


def diagnosed(recording: Recording) -> Diagnosis:
    cfg = cw.DiagnoseCfg(effects=RIVALS, jobs=1, explain=False, max_additions=1)
    return cw.diagnose(cw.Model.from_recording(recording), recording, cfg)


def intervals(found: Diagnosis) -> dict[str, tuple[float, float]]:
    return {p.name: (p.low, p.high) for f in found.accepted for p in f.parameters}


@pytest.mark.parametrize(("stiffness", "preload"), [(2.2, 0.0), (1.5, -1.0)])
def test_a_spring_in_a_door_is_found_with_its_values(stiffness, preload):
    found = diagnosed(door(stiffness, preload))
    assert found.groups == (("joint_stiffness",),)
    known = intervals(found)
    assert known["stiffness[hinge]"][0] <= stiffness <= known["stiffness[hinge]"][1]
    assert known["preload[hinge]"][0] <= preload <= known["preload[hinge]"][1]
    assert known["stiffness[hinge]"] == pytest.approx((stiffness, stiffness), rel=0.1)


def test_a_door_without_a_spring_needs_none_and_damping_stays_damping():
    assert diagnosed(door(0.0, 0.0)).verdict == "none_needed"
    assert diagnosed(door(0.0, 0.0, damping=1.6)).groups == (("joint_damping",),)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"stiffness": 2.2}, "joint_stiffness"),
        ({"share": 0.3}, "gravity_compensation"),
        ({"kp": 0.8, "kv": 0.8}, "actuator_gain(servo)"),
        ({"kp": 0.75}, "actuator_gain(servo, kp)"),
        ({"kv": 0.7}, "actuator_gain(servo, kv)"),
        ({"kv": 1.3}, "joint_damping"),
    ],
)
def test_wide_swings_tell_a_spring_from_weight_and_gain(changes, name):
    assert diagnosed(arm(**changes)).groups == ((name,),)


def test_a_spring_in_small_swings_is_named_together_with_weight_that_pulls_the_same_way():
    found = diagnosed(arm(stiffness=0.6, reach=0.1, seconds=4.0))
    assert found.verdict == "group"
    assert [set(group) for group in found.groups] == [{"joint_stiffness", "gravity_compensation"}]
