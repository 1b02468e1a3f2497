"""Encoders that begin anew after each turn."""

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.load import load_recording
from concent_warp.recording.logs.cfg import PlausibilityCfg
from concent_warp.recording.logs.numbers import Numbers
from concent_warp.recording.logs.plausibility import check_numbers
from concent_warp.recording.logs.targets import Target
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.unwind import unwound

SCENE = """<mujoco><worldbody><body><joint name="wheel" axis="0 0 1" {range}/><geom size="0.1" mass="1"/></body>
</worldbody>
<actuator><position name="servo" joint="wheel" kp="5"/></actuator>
<sensor><jointpos name="encoder" joint="wheel"/></sensor></mujoco>"""
TIME = np.arange(0, 6, 0.01)
ANGLE = 2.0 + 9 * np.sin(0.9 * TIME)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def turning(value, *, time=TIME, command=None, limits="", qpos=None):
    action = {} if command is None else {"servo": Channel(time, command)}
    demonstration = Demonstration(
        "demo_0", action=action, measured={"encoder": Channel(time, value[:, None])}, qpos=qpos
    )
    return Recording(SCENE.format(range=limits), (demonstration,))


def test_angles_go_on_where_an_encoder_begins_anew():
    reading = wrapped(ANGLE)
    reading[40:60] = np.nan
    with pytest.warns(UserWarning, match=r"continued over the jumps: measured/encoder, action/servo"):
        found = unwound(turning(reading, command=wrapped(ANGLE + 2.0)))[0]
    seen = np.isfinite(reading)
    np.testing.assert_allclose(found.measured["encoder"].value[seen, 0], ANGLE[seen], atol=1e-9)
    assert np.isnan(found.measured["encoder"].value[~seen]).all()
    np.testing.assert_allclose(found.action["servo"].value, ANGLE + 2.0, atol=1e-9)


def test_angles_begin_at_the_turn_that_the_initial_state_states():
    with pytest.warns(UserWarning, match="measured/encoder"):
        found = unwound(turning(wrapped(ANGLE), qpos=np.array([2.0 + 4 * np.pi])))[0]
    np.testing.assert_allclose(found.measured["encoder"].value[:, 0], ANGLE + 4 * np.pi, atol=1e-9)


@pytest.mark.parametrize(
    ("value", "time", "limits"),
    [
        (ANGLE, TIME, ""),  # not wrapped
        (np.clip(np.random.default_rng(2).normal(0, 1, len(TIME)), -3, 3), TIME, ""),  # noise
        (np.where(TIME < 3, -2.5, 2.5), np.where(TIME < 3, TIME, TIME + 5), ""),  # it turned while nothing was read
        (np.where(TIME < 3, -2.5, 2.5), TIME, 'range="-3 3" limited="true"'),  # no way round
        (np.where(TIME == 3.0, 0.0, 4.5 + 0.1 * np.sin(TIME)), TIME, ""),  # a reading that dropped out
        (np.where(TIME < 3, 1.6 * TIME, 0.0), TIME, ""),  # put back by hand while nothing was written
    ],
)
def test_other_angles_stay(value, time, limits):
    recording = turning(value, time=time, limits=limits)
    assert unwound(recording) is recording


@pytest.mark.parametrize(
    ("command", "time"),
    [
        (np.where(TIME % 2 < 1, 2.4, -2.4), TIME),
        (np.where(TIME % 2 < 1, 2.4, -2.4) + 0.02 * np.sin(9 * TIME), TIME),
        (np.repeat(np.random.default_rng(0).uniform(-2.9, 2.9, 12), 50), TIME),
        (np.array([2.6, -2.6]), np.array([0.0, 3.0])),
    ],
    ids=["square", "square and sine", "at random", "two"],
)
def test_set_points_that_step_stay(command, time):
    recording = turning(0.5 * np.sin(TIME))
    action = {"servo": Channel(time, command)}
    recording = Recording(recording.scene, (replace(recording[0], action=action),))
    assert unwound(recording) is recording


def test_commands_that_are_held_between_changes_go_on():
    held = np.repeat(ANGLE[::10], 10)  # of a policy at 10 Hz
    with pytest.warns(UserWarning, match="action/servo"):
        found = unwound(turning(ANGLE, command=wrapped(held)))[0]
    np.testing.assert_allclose(found.action["servo"].value, held, atol=1e-9)


def test_a_command_that_is_beyond_the_end_of_a_turn_all_the_time_goes_with_what_was_measured():
    angle = 3.0 + 0.2 * np.minimum(TIME, 2.5)
    with pytest.warns(UserWarning, match=r"jumps: measured/encoder, action/servo"):
        found = unwound(turning(wrapped(angle), command=wrapped(angle + 0.3)))[0]
    np.testing.assert_allclose(found.measured["encoder"].value[:, 0], angle, atol=1e-9)
    np.testing.assert_allclose(found.action["servo"].value, angle + 0.3, atol=1e-9)


def test_a_far_set_point_that_was_reached_stays():
    angle = 9.0 * (1 - np.exp(-2 * TIME))
    with pytest.warns(UserWarning, match=r"jumps: measured/encoder$"):
        found = unwound(turning(wrapped(angle), command=np.full(len(TIME), 9.0)))[0]
    np.testing.assert_allclose(found.measured["encoder"].value[:, 0], angle, atol=1e-9)
    np.testing.assert_allclose(found.action["servo"].value, 9.0)


def test_a_recording_is_unwound_on_reading_and_wrapped_degrees_are_refused(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE.format(range=""))
    for unit, scale in (("rad", 1.0), ("deg", 180 / np.pi)):
        rows = "".join(f"{t:.3f},{a * scale:.6f}\n" for t, a in zip(TIME, wrapped(ANGLE), strict=True))
        (tmp_path / "measured_encoder.csv").write_text("time,angle\n" + rows)
        if unit == "rad":
            with pytest.warns(UserWarning, match="begin anew"):
                value = load_recording(tmp_path)[0].measured["encoder"].value
            np.testing.assert_allclose(value[:, 0], ANGLE, atol=1e-5)
        else:
            with pytest.raises(RecordingError, match=r"measured/encoder.*look like degrees.*jumps of 360"):
                load_recording(tmp_path)


def test_an_import_does_not_take_an_angle_that_begins_anew_for_one_against_its_command():
    encoder = Target("encoder", False, 1, "angle", None, "wheel", position=True)
    servo = Target("servo", True, 1, "angle", None, "wheel", position=True)
    angle = np.pi + 0.4 * np.sin(2 * TIME)
    channels = [
        Numbers(target, target.name, target.name, TIME, value[:, None], None)
        for target, value in ((encoder, wrapped(angle)), (servo, angle))
    ]
    assert not list(check_numbers(channels, PlausibilityCfg()))
