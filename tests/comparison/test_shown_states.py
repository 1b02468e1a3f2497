"""Replays of a model whose instruments show a wrong initial state start in the true one, shown or true as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.comparison import initial_states
from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.initial_states import with_initial_states
from concent_warp.effects.library.joints import JointDamping
from concent_warp.effects.library.measurement import FrameOffset, Latency, LengthScale, TimeBase
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
GRAVITY = np.array([0.0, 0.0, -9.81])


def state(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the true state at a true time [s]."""
    place, speed = PLACE + time * SPEED + time**2 / 2 * GRAVITY, SPEED + time * GRAVITY
    return np.array([*place, 1, 0, 0, 0, 0]), np.array([*speed, 0, 0, 0, 0])


def seen(
    qpos: np.ndarray | None = None,
    qvel: np.ndarray | None = None,
    *,
    large: float = SCALE,
    fast: float = 0,
    late: float = 0,
) -> Recording:
    """Return a flight that is seen 5 % too large, or by a clock that runs fast [-] or is late [s]."""
    time = np.arange(late, 0.5, 0.01)
    place = np.array([state(t / (1 + fast) - late)[0][:3] for t in time])
    noise = np.random.default_rng(0).normal(0, NOISE, (len(time), 3))
    measured = {
        "place": Channel(time, (1 + large) * place + noise, noise_std=NOISE),
        "angle": Channel(time, np.zeros((len(time), 1)), noise_std=NOISE),
    }
    return Recording(BALL, (Demonstration("flight", qpos=qpos, qvel=qvel, measured=measured),))


def scaled() -> Model:
    """Return the model with the true length scale."""
    return MODEL.add(LengthScale("place"), [SCALE])


def start(model: Model, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the state in which a replay starts."""
    (found,) = starts(model, recording)
    return found


def starts(model: Model, recording: Recording) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the state in which the replay of each demonstration starts."""
    found = [(d.qpos, d.qvel) for d in with_initial_states(model, recording).demonstrations]
    return [(qpos, qvel) for qpos, qvel in found if qpos is not None and qvel is not None]


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
    recording = seen(qpos=TRUE[0], qvel=TRUE[1], large=0)
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


CASES = pytest.mark.parametrize(
    ("model", "instrument", "shown"),
    [
        (scaled(), {}, SHOWN),
        (MODEL.add(TimeBase("place", "angle"), [0.05]), {"large": 0, "fast": 0.05}, (TRUE[0], TRUE[1] / 1.05)),
        (MODEL.add(Latency("place", "angle"), [0.02]), {"large": 0, "late": 0.02}, state(-0.02)),
    ],
    ids=["length_scale", "time_base", "latency"],
)
"""Models with the effect of an instrument, and the state that it shows at the start."""


@CASES
def test_a_stated_state_that_readings_show_to_be_true_is_kept(model, instrument, shown):  # noqa: ARG001
    recording = seen(*TRUE, **instrument)
    for found, true in zip(start(model, recording), TRUE, strict=True):
        np.testing.assert_array_equal(found, true)
    found = compare_replays({"model": model}, recording, "mujoco")
    assert found.summarise("model", "place").rms == pytest.approx(np.sqrt(3) * NOISE, rel=0.15)


@CASES
def test_each_demonstration_decides_for_itself(model, instrument, shown):
    (first,), (second,) = (seen(*stated, **instrument).demonstrations for stated in (shown, TRUE))
    recording = Recording(BALL, (replace(first, name="shown"), replace(second, name="true")))
    (qpos, qvel), kept = starts(model, recording)
    np.testing.assert_array_equal(np.concatenate(kept), np.concatenate(TRUE))
    np.testing.assert_allclose(qpos, TRUE[0], atol=0.003)  # moved along its velocity, without gravity
    np.testing.assert_allclose(qvel, shown[1] if "late" in instrument else TRUE[1], atol=1e-12)


def test_readings_that_do_not_depend_on_the_start_leave_what_is_stated_corrected():
    recording = seen(*SHOWN)
    (d,) = recording.demonstrations
    unseen = replace(recording, demonstrations=(replace(d, measured={"angle": d.measured["angle"]}),))
    np.testing.assert_allclose(np.concatenate(start(scaled(), unseen)), np.concatenate(TRUE), atol=1e-12)


def test_nothing_is_decided_where_no_effect_misleads_the_start(monkeypatch):
    def decided(*_: object) -> bool:
        raise AssertionError("readings were asked")

    monkeypatch.setattr(initial_states, "_first_window", decided)
    recording = seen(*TRUE)
    for model in (MODEL, MODEL.add(JointDamping("hinge"), [0.1])):
        assert with_initial_states(model, recording) is recording
    without = MODEL.add(LengthScale("place"), [0.0])
    np.testing.assert_array_equal(np.concatenate(start(without, recording)), np.concatenate(TRUE))
    with pytest.raises(AssertionError, match="asked"):
        with_initial_states(scaled(), recording)
