"""Machines that fall without their controller: small errors grow in any replay, by equations written here."""

from __future__ import annotations

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

STEP, PERIOD, NOISE = 2e-4, 0.01, 3e-4
"""Step of the equations and period of the controller [s], and noise of the encoder [rad]."""
INERTIA, WEIGHT, DAMPING = 0.03, 1.1, 0.02
"""Moment of inertia of a pole about its hinge [kg m^2], weight times lever [N m], and damping [N m s/rad]."""
POLE = f"""<mujoco><worldbody><body name="pole"><joint name="hinge" axis="0 1 0" damping="{DAMPING}"/>
<inertial pos="0 0 {WEIGHT / 9.81:.6f}" mass="1" diaginertia=".02 {INERTIA - (WEIGHT / 9.81) ** 2:.6f} .02"/></body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator>
<sensor><jointpos name="encoder" joint="hinge"/></sensor></mujoco>"""


def balanced(delay: float, seconds: float = 10.0) -> Recording:
    """Return a recording of a pole that a controller keeps upright; the motor obeys its commands after a delay [s]."""
    rng, late = np.random.default_rng(5), round(delay / STEP)
    time = np.arange(round(seconds / PERIOD)) * PERIOD
    target = 0.25 * np.sign(np.sin(1.1 * time)) * np.sin(2.6 * time)
    angle, speed, rows, commands, every = 0.02, 0.0, [], [], round(PERIOD / STEP)
    for k in range(len(time) * every):
        if k % every == 0:
            rows.append(angle)
            commands.append(4.0 * (target[k // every] - angle) - 0.45 * speed)
        obeyed = commands[max(k - late, 0) // every] if k >= late else commands[0]
        speed += STEP * (WEIGHT * 1.004 * np.sin(angle) - 0.97 * DAMPING * speed + 0.997 * obeyed) / INERTIA
        angle += STEP * speed
    seen = np.array(rows)[:, None] + rng.normal(0, NOISE, (len(rows), 1))
    action = {"motor": Channel(time, np.array(commands)[:, None])}
    return Recording(POLE, (Demonstration("d", action=action, measured={"encoder": Channel(time, seen, NOISE)}),))


def test_windows_of_a_machine_that_falls_end_before_its_errors_have_grown_by_much():
    windows = observe(Model(Scene(POLE)), balanced(0.012))
    lengths = np.array([w.end - w.start for w in windows[:-1]])
    # Errors grow by exp(rate t): over the second half of a window by at most six times, of any other little more.
    rate = np.sqrt(WEIGHT / INERTIA)
    assert 1.5 < rate * np.median(lengths) / 2 < 2.2
    assert lengths.max() <= 1.5 * np.median(lengths) + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "verdicts"), [(0.0, {"none_needed"}), (0.012, {"effect", "group"})])
def test_a_late_command_of_a_balanced_pole_is_told_from_errors_of_nominal_values(delay, verdicts):
    effects = ("actuator_delay", "latency", "joint_damping")
    found = cw.diagnose(Model(Scene(POLE)), balanced(delay), cw.DiagnoseCfg(effects=effects, jobs=1, explain=False))
    assert found.verdict in verdicts
    assert found.ratio[-1] < 1.1
    if delay:  # late commands and late readings are the same where initial states are not known
        assert set(found.groups[0]) <= {"actuator_delay", "latency"}
        (effect,) = found.accepted
        (value,) = effect.parameters
        assert value.low < delay < value.high
        assert value.value == pytest.approx(delay, abs=2e-3)
