"""Diagnoses of recordings that no engine of the library made, without stated noise, as folders of CSV files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.recording.formats.csv import read_csv
from concent_warp.recording.recording import Recording
from tests.scenes.foreign import BALL, PUSHER, pusher, swing_up, thrown_ball, write_csv

RIVALS_OF_DELAY = ("joint_damping", "actuator_delay", "joint_friction", "actuator_gain", "latency")
"""Effects that an arm on position drives could lack."""
RIVALS_OF_DRAG = ("air_drag", "wind", "gravity_tilt", "time_base", "length_scale", "latency", "contact_compliance")
"""Effects that a thrown ball could lack."""


def read(make: Any, folder: Any) -> Recording:
    return read_csv(write_csv(make(), folder / make.__name__))


def diagnosed(recording: Recording, **settings: Any) -> Diagnosis:
    return cw.diagnose(cw.Model.from_recording(recording), recording, cw.DiagnoseCfg(jobs=1, explain=False, **settings))


def values(found: Diagnosis) -> dict[str, float]:
    """Return the parameters of all accepted effects."""
    return {p.name: p.value for f in found.accepted for p in f.parameters}


def check_saved(found: Diagnosis, recording: Recording, tmp_path: Any) -> None:
    """Check that finding and saved model are one set of numbers, and that a comparison shows no more than noise."""
    found.model.save(tmp_path / "model.toml")
    saved = cw.Model.load(tmp_path / "model.toml")
    added = {p.name: v for a in saved.effects for p, v in zip(parameters(a, saved), a.values, strict=True)}
    assert added == pytest.approx(values(found), rel=1e-6)
    intervals = [pair for a in saved.effects for pair in a.intervals]
    assert np.ravel(intervals) == pytest.approx(
        [e for f in found.accepted for p in f.parameters for e in (p.low, p.high)]
    )
    compared = cw.compare(saved, recording)
    for channel in compared.channels:
        ratio = compared.summarise("model", channel).ratio
        assert ratio is not None
        assert ratio < 1.5


def parameters(added: Any, model: cw.Model) -> Any:
    return added.effect.parameters(model.scene.model)


@pytest.mark.parametrize(
    ("effects", "seconds"),  # all of them are candidates where nothing is missing, below
    [pytest.param((), 6.0, marks=pytest.mark.slow, id="all"), pytest.param(RIVALS_OF_DELAY, 3.0, id="rivals")],
)
def test_damping_and_delay_of_an_arm_are_found_where_noise_is_not_stated(tmp_path, effects, seconds):
    recording = read_csv(write_csv(pusher(seconds=seconds), tmp_path / "arm"))
    assert all(c.noise_std is None for d in recording.demonstrations for c in d.measured.values())
    found = diagnosed(recording, effects=effects)
    assert found.verdict in ("effect", "group")
    assert {f.name for f in found.accepted} == {"joint_damping", "actuator_delay"}
    assert all(len(group) <= 2 for group in found.groups)
    known = values(found)
    assert known["delay"] == pytest.approx(0.02, rel=0.05)
    assert known["damping[elbow]"] == pytest.approx(0.15, rel=0.07)
    assert any("Noise that is not stated" in issue for issue in found.issues)
    check_saved(found, recording, tmp_path)


def test_nothing_is_missing_from_an_arm_but_a_shorter_time_step(tmp_path):
    recording = read_csv(write_csv(pusher(damping=0.05, delay=0.0), tmp_path / "arm"))
    found = diagnosed(recording)
    assert found.verdict == "none_needed"
    assert not found.accepted
    assert found.ratio[0] > 1.5
    assert found.ratio[-1] == pytest.approx(1.0, abs=0.1)
    assert found.time_step is not None
    assert found.time_step.given == 0.002
    assert found.time_step.used <= 0.0005
    assert found.model.scene.model.opt.timestep == found.time_step.used
    assert any("time step of 2 ms is too long" in sentence for sentence in found.sentences())
    assert found.to_json()["time_step"]["gain"]["value"] > 0.5


def test_damping_that_is_off_by_no_more_than_friction_varies_is_not_missing(tmp_path):
    recording = read_csv(write_csv(pusher(damping=0.15, delay=0.0, noise=2e-4, seconds=4.0), tmp_path / "arm"))
    recording = replace(recording, scene=PUSHER.replace('damping="0.05"', 'damping="0.14"'))
    found = diagnosed(recording, effects=("joint_damping", "joint_friction", "actuator_gain", "actuator_delay"))
    assert found.verdict == "none_needed"
    assert not found.accepted
    assert {p.name: p.value for p in found.nominal_values}["damping[elbow]"] > 1.02


def test_one_encoder_that_is_late_is_named(tmp_path):
    recording = read_csv(write_csv(pusher(damping=0.05, delay=0.0, late=0.02, seconds=3.0), tmp_path / "arm"))
    found = diagnosed(recording, effects=("latency", "actuator_delay", "joint_damping", "sensor_gain"))
    assert found.verdict == "effect"
    assert [(f.name, f.target) for f in found.accepted] == [("latency(elbow_position)", ("elbow_position",))]
    assert values(found)["delay"] == pytest.approx(0.02, rel=0.05)


def test_nothing_is_missing_from_a_swung_up_pendulum_but_a_shorter_time_step(tmp_path):
    found = diagnosed(read_csv(write_csv(swing_up(coulomb=0.0, viscous=0.0, seconds=5.0), tmp_path / "pendulum")))
    assert found.verdict == "none_needed"
    assert not found.accepted


@pytest.mark.slow
def test_friction_and_damping_of_a_swung_up_pendulum_are_found(tmp_path):
    recording = read(swing_up, tmp_path)
    found = diagnosed(recording)
    assert found.verdict == "effect"
    assert {f.name for f in found.accepted} == {"joint_damping", "joint_friction"}
    assert values(found)["damping[hinge]"] == pytest.approx(0.01, rel=0.1)
    assert values(found)["torque[hinge]"] == pytest.approx(0.03, rel=0.1)


@pytest.mark.parametrize(
    ("effects", "throws"),
    [pytest.param((), 3, marks=pytest.mark.slow, id="all"), pytest.param(RIVALS_OF_DRAG, 2, id="rivals")],
)
def test_drag_of_a_ball_that_is_tracked_by_position_is_found(tmp_path, effects, throws):
    recording = read_csv(write_csv(thrown_ball(throws=throws), tmp_path / "ball"))
    assert recording.scene.count("framequat") == BALL.count("framequat") == 0
    found = diagnosed(recording, effects=effects)
    assert found.groups == (("air_drag",),)
    check_saved(found, recording, tmp_path)


def test_no_drag_is_found_where_there_is_none(tmp_path):
    found = diagnosed(read_csv(write_csv(thrown_ball(drag=0.0), tmp_path / "ball")))
    assert found.verdict == "none_needed"
    assert found.ratio[0] == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_heights_alone_tell_of_drag(tmp_path):
    found = diagnosed(read_csv(write_csv(thrown_ball(heights_only=True), tmp_path / "ball")), max_additions=1)
    assert any("air_drag" in group for group in found.groups)
