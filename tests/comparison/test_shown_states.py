"""Replays of a model whose instruments show a wrong initial state start in the true one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.initial_states import with_initial_states
from concent_warp.effects.library.joints import JointDamping
from concent_warp.effects.library.measurement import FrameOffset, Latency, LengthScale
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

BALL = """
<mujoco>
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body name="ball" pos="0 0 1"><freejoint/><geom size="0.05" mass="0.1"/></body>
    <body name="arm" pos="3 0 1"><joint name="hinge" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.2" mass="0.1"/></body>
  </worldbody>
  <sensor>
    <framepos name="place" objtype="xbody" objname="ball"/><jointpos name="angle" joint="hinge"/>
  </sensor>
</mujoco>"""
MODEL = Model(Scene(BALL))
SCALE, NOISE = 0.05, 1e-3
"""Error of the length scale [-], and standard deviation of a position [m]."""
PLACE, SPEED = np.array([1.0, 0.5, 1.5]), np.array([1.0, -0.5, 2.0])
"""True position [m] and velocity [m/s] of the ball at the start."""
TRUE, SHOWN = ((np.array([*(k * PLACE), 1, 0, 0, 0, 0]), np.array([*(k * SPEED), 0, 0, 0, 0])) for k in (1, 1 + SCALE))


def seen(qpos: np.ndarray | None = None, qvel: np.ndarray | None = None) -> Recording:
    """Return a flight that is seen 5 % too large."""
    time = np.arange(0.0, 0.5, 0.01)
    place = PLACE + time[:, None] * SPEED + time[:, None] ** 2 / 2 * np.array([0.0, 0.0, -9.81])
    noise = np.random.default_rng(0).normal(0, NOISE, (len(time), 3))
    measured = {
        "place": Channel(time, (1 + SCALE) * place + noise, noise_std=NOISE),
        "angle": Channel(time, np.zeros((len(time), 1)), noise_std=NOISE),
    }
    return Recording(BALL, (Demonstration("flight", qpos=qpos, qvel=qvel, measured=measured),))


def scaled() -> Model:
    """Return the model with the true length scale."""
    return MODEL.add(LengthScale("place"), [SCALE])


def start(model: Model, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the state in which a replay starts."""
    (d,) = with_initial_states(model, recording).demonstrations
    assert d.qpos is not None
    assert d.qvel is not None
    return d.qpos, d.qvel


def test_a_stated_state_is_corrected_for_a_length_scale():
    recording = seen(qpos=SHOWN[0], qvel=SHOWN[1])
    for found, true in zip(start(scaled(), recording), TRUE, strict=True):
        np.testing.assert_allclose(found, true, atol=1e-12)
    for model in (MODEL, MODEL.add(JointDamping("hinge"), [0.1])):
        assert with_initial_states(model, recording) is recording


def test_a_compared_model_with_the_length_scale_leaves_no_more_than_noise():
    recording = seen(qpos=SHOWN[0], qvel=SHOWN[1])
    found = compare_replays({"plain": MODEL, "scaled": scaled()}, recording, "mujoco")
    assert found.summarise("scaled", "place").rms == pytest.approx(np.sqrt(3) * NOISE, rel=0.15)
    # Gravity is too large beside the lengths that are shown.
    assert found.summarise("plain", "place").rms > 10 * NOISE


def test_a_state_that_is_stated_in_part_is_corrected_and_the_rest_is_fitted():
    plain, placed, moving = (start(scaled(), one) for one in (seen(), seen(qpos=SHOWN[0]), seen(qvel=SHOWN[1])))
    np.testing.assert_allclose(placed[0], TRUE[0], atol=1e-12)
    np.testing.assert_allclose(moving[1], TRUE[1], atol=1e-12)
    for qpos, qvel in (plain, placed, moving):
        np.testing.assert_allclose(qpos[:3], PLACE, atol=2 * NOISE)
        np.testing.assert_allclose(qvel[:3], SPEED, atol=0.02)


def test_a_stated_state_is_moved_to_the_time_at_which_a_replay_starts():
    recording = seen(qpos=TRUE[0], qvel=TRUE[1])
    late, _ = start(MODEL.add(Latency("place", "angle"), [0.02]), recording)
    np.testing.assert_allclose(late[:3], PLACE + 0.02 * SPEED)
    elsewhere, _ = start(MODEL.add(FrameOffset("place"), [0.1, 0, 0, 0, 0, 0]), recording)
    np.testing.assert_allclose(elsewhere[:3], PLACE - [0.1, 0, 0])


def test_too_few_readings_leave_what_is_stated_corrected():
    recording = seen(qpos=SHOWN[0])
    (d,) = recording.demonstrations
    few = replace(recording, demonstrations=(replace(d, measured={}),))
    (d,) = with_initial_states(scaled(), few).demonstrations
    assert d.qpos is not None
    np.testing.assert_allclose(d.qpos, TRUE[0], atol=1e-12)
    assert d.qvel is None
