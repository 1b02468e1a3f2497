"""What was commanded before a recording that begins with a jump of the command."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from concent_warp.effects.library.drives import ActuatorDelay, ActuatorLag
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.simulate.replay import acting_commands, commands, resting_commands

KP, MASS, G = 400.0, 2.0, 9.81
LIFT = f"""
<mujoco><option timestep="0.002"/><worldbody><body><joint name="z" type="slide" axis="0 0 1"/>
  <geom size="0.05" mass="{MASS}"/></body></worldbody>
<actuator><position name="drive" joint="z" kp="{KP}" kv="40" gear="{{gear}}"/></actuator>
<sensor><jointpos name="z" joint="z"/></sensor></mujoco>"""
"""A weight on a servo, which sags by 49 mm."""
DELAY = 0.05


def recorded(command: np.ndarray, delay: float = DELAY, gear: float = 1.0, start: int = 0, bias: float = 0.0):
    """Return a second of a servo that begins at rest at the command 0, at 100 Hz, from a reading on."""
    m = mujoco.MjModel.from_xml_string(LIFT.format(gear=gear))
    d, read = mujoco.MjData(m), []
    d.qpos[0] = -MASS * G / KP / gear**2
    late = np.r_[np.zeros(round(delay * 100)), command]
    for u in late[: len(command)]:
        read.append(d.qpos[0] + bias)
        d.ctrl[0] = u
        mujoco.mj_step(m, d, 5)
    time = 0.01 * np.arange(len(command) - start)
    measured = {"z": Channel(time, np.array(read[start:])[:, None])}
    return Demonstration("d", action={"drive": Channel(time, command[start:])}, measured=measured)


STEP = np.full(100, 0.2)
SINE = 0.2 * np.sin(0.08 * np.arange(200))


@pytest.mark.parametrize("gear", [1.0, 2.0])
def test_a_servo_at_rest_that_follows_a_step_was_held_where_it_was(gear):
    model, d = Model(Scene(LIFT.format(gear=gear))), recorded(STEP, gear=gear)
    m = model.compile()
    assert resting_commands(m, d) == {0: pytest.approx(0.0, abs=1e-9)}
    assert commands(m, d, 3, -0.002)[:, 0] == pytest.approx([0.0, 0.2, 0.2], abs=1e-9)
    late = acting_commands(model.add(ActuatorDelay("drive"), [DELAY]), m, d, 100)[:, 0]
    assert late[:25] == pytest.approx(0.0, abs=1e-9)
    assert late[26:] == pytest.approx(0.2)
    slow = acting_commands(model.add(ActuatorLag("drive"), [DELAY]), m, d, 100)[:, 0]
    assert slow[0] < 0.01
    assert slow[25] == pytest.approx(0.2 * (1 - np.exp(-1)), rel=0.03)
    assert acting_commands(model, m, d, 10)[:, 0] == pytest.approx(0.2)


def test_commands_before_the_first_are_like_it_where_nothing_jumps():
    m = Model(Scene(LIFT.format(gear=1.0))).compile()
    for d in (
        recorded(STEP, delay=0.0),  # moves at once
        recorded(SINE),  # begins where it was
        recorded(SINE, start=30),  # is moving
        recorded(0.3 * SINE, bias=0.004),  # reads too much
        Demonstration("d", action={"drive": Channel(np.zeros(1), np.ones(1))}),
    ):
        assert resting_commands(m, d) == {}
        assert commands(m, d, 3, -0.002)[0, 0] == d.action["drive"].value[0]
