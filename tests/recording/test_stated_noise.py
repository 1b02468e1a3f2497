"""Noise that a user states: in a CSV folder, by a method, and by an option of commands."""

from __future__ import annotations

import numpy as np
import pytest

from concent_warp.cli.given_recording import given_recording
from concent_warp.errors import RecordingError
from concent_warp.recording.formats.csv import read_csv
from tests.scenes.foreign import pusher, thrown_ball, write_csv


@pytest.fixture
def arm(tmp_path):
    return write_csv(pusher(seconds=0.5), tmp_path / "arm")


def stated(recording) -> list[dict[str, float | None]]:
    return [{name: c.noise_std for name, c in d.measured.items()} for d in recording.demonstrations]


def test_noise_beside_the_scene_holds_for_all_demonstrations(tmp_path):
    folder = write_csv(thrown_ball(), tmp_path / "ball")
    assert stated(read_csv(folder)) == [{"ball_position": None}] * 3
    (folder / "noise.csv").write_text("sensor,noise_std\nball_position,0.002\n")
    assert stated(read_csv(folder)) == [{"ball_position": 0.002}] * 3


def test_noise_in_a_demonstration_holds_for_it_alone(arm):
    (arm / "demo_0" / "noise.csv").write_text("elbow_position, 1e-3\n")
    assert stated(read_csv(arm)) == [{"elbow_position": 1e-3, "shoulder_position": None}]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("wrist,0.1\n", "noise of a channel that was not measured; expected some of"),
        ("elbow_position,-1\n", "line 1: noise makes no sense; expected a number above 0, found -1"),
        ("elbow_position,nan\n", "noise makes no sense"),
        ("elbow_position,small\n", "is not a number"),
        ("elbow_position,1,2\n", "line 1: not a row of noise"),
        ("elbow_position,1\nelbow_position,1\n", "line 2: not a row of noise"),
    ],
)
def test_noise_that_makes_no_sense_is_refused(arm, text, words):
    (arm / "noise.csv").write_text(text)
    with pytest.raises(RecordingError, match=words):
        read_csv(arm)


def test_an_option_states_noise_by_name_or_pattern(arm):
    assert stated(given_recording(arm, (), ("*_position=0.002", "elbow_position=0.003"))) == [
        {"elbow_position": 0.003, "shoulder_position": 0.002}
    ]
    assert stated(given_recording(arm)) == [{"elbow_position": None, "shoulder_position": None}]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("elbow_position", "noise is not stated so; expected --noise CHANNEL=NUMBER, found 'elbow_position'"),
        ("elbow_position=x", "noise is not stated so"),
        ("=1", "noise is not stated so"),
        ("wrist=1", "noise of a channel that was not measured"),
        ("elbow_position=0", "noise of 'elbow_position' makes no sense; expected a number above 0"),
        ("elbow_position=nan", "makes no sense"),
    ],
)
def test_an_option_that_makes_no_sense_is_refused(arm, text, words):
    with pytest.raises(RecordingError, match=words):
        given_recording(arm, (), (text,))


def test_stating_noise_changes_nothing_else():
    recording = thrown_ball()
    after = recording.with_noise({"ball*": 0.1})
    for d, e in zip(recording.demonstrations, after.demonstrations, strict=True):
        assert np.array_equal(d.measured["ball_position"].value, e.measured["ball_position"].value)
        assert e.measured["ball_position"].noise_std == 0.1
    assert recording.with_noise({}) == recording
