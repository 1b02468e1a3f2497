from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.effects.registry import effect_class
from concent_warp.errors import ModelError, RecordingError
from concent_warp.model import Model
from concent_warp.recording.recording import Channel
from concent_warp.scene.scene import Scene
from tests.diagnosis.same_results import assert_same
from tests.scenes.swinging import DAMPING, NOISE, drawing, swing_scene, swung

FEW = ("joint_damping", "joint_friction", "armature", "actuator_gain", "sensor_bias")
CFG = DiagnoseCfg(effects=FEW, jobs=1, explain=False)


@pytest.fixture(scope="module")
def found():
    recording = swung()
    return diagnose(drawing(recording), recording, CFG)


def with_angle(recording, channel):
    (d,) = recording.demonstrations
    return replace(recording, demonstrations=(replace(d, measured={"angle": channel}),))


def test_the_missing_effect_is_named_with_its_value(found):
    assert found.verdict == "effect"
    (finding,) = found.accepted
    assert finding.name == "joint_damping"
    (damping,) = finding.parameters
    assert damping.value == pytest.approx(DAMPING, rel=0.01)
    assert damping.low < damping.value < damping.high < 1.1 * DAMPING
    assert finding.p < 0.05
    assert 0.8 < finding.low <= finding.gain <= finding.high <= 1.0
    assert finding.removes[0][0] == "angle"
    assert found.ratio[-1] == pytest.approx(1.0, abs=0.1)
    assert [a.effect.name for a in found.model.effects] == ["joint_damping"]


def test_rejected_effects_come_with_a_reason(found):
    rejected = [f for f in found.effects if not f.accepted]
    assert rejected
    assert all(f.reason for f in rejected)
    assert {f.step for f in rejected} <= set(range(CFG.max_additions))


def test_a_complete_model_is_reported_with_what_would_have_been_detected():
    recording = swung(damping=0.0)
    found = diagnose(drawing(recording), recording, CFG)
    assert found.verdict == "none_needed"
    assert not found.accepted
    sizes = {d.name: d.size for d in found.detectable}
    assert 0 < sizes["joint_damping"] < DAMPING


def test_what_the_candidates_cannot_explain_is_none_of_these():
    recording = swung()
    found = diagnose(drawing(recording), recording, replace(CFG, effects=("sensor_bias",)))
    assert found.verdict == "none_of_these"
    assert found.unexplained > 0.8


def test_an_effect_that_the_model_has_is_fitted_along(found):
    recording = swung()
    model = drawing(recording).add(effect_class("joint_damping")("hinge"), [0.5 * DAMPING])
    again = diagnose(model, recording, CFG)
    assert again.verdict == "none_needed"
    assert again.models[0].effects[0].values[0] == pytest.approx(found.model.effects[0].values[0], rel=0.02)


def test_the_same_seed_finds_the_same(found):
    recording = swung()
    again = diagnose(drawing(recording), recording, CFG)
    assert_same(again.to_json(), found.to_json())


def test_a_model_that_diverges_is_an_error():
    recording = swung()
    wild = Model(Scene(swing_scene().replace('damping="0.0"', 'stiffness="-1e8"')))
    with pytest.raises(ModelError, match="does not stay finite"):
        diagnose(wild, recording, CFG)


def test_one_sample_is_an_error():
    recording = swung()
    channel = recording.demonstrations[0].measured["angle"]
    short = with_angle(recording, Channel(channel.time[:1], channel.value[:1], NOISE))
    with pytest.raises(RecordingError, match="too little"):
        diagnose(drawing(recording), short, CFG)


@pytest.mark.parametrize("stated", [True, False])
def test_readings_that_are_all_noise_are_reported_to_be(stated):
    recording = swung()
    channel = recording.demonstrations[0].measured["angle"]
    value = np.random.default_rng(5).normal(0, 1.0, channel.value.shape)
    noise = with_angle(recording, Channel(channel.time, value, NOISE if stated else None))
    found = diagnose(drawing(recording), noise, CFG)
    if stated:  # noise far beyond what is stated is not a missing effect
        assert found.verdict == "none_of_these"
    assert found.issues[0] == "demo_0, angle: the readings scatter like noise, no motion shows in them."
    assert [issue.startswith("Noise that is not stated") for issue in found.issues[1:]] == [True] * (not stated)


def test_progress_rises_and_says_what_is_done():
    seen = []
    recording = swung(damping=0.0)
    diagnose(drawing(recording), recording, CFG, progress=lambda share, text: seen.append((share, text)))
    # It falls only where a further addition begins, which was not known before.
    falls = [text for (before, _), (after, text) in pairwise(seen) if after < before]
    assert all(text.startswith("screening, 1 of") for text in falls)
    assert len(falls) < len([text for _, text in seen if text.startswith("screening, 1 of")])
    assert seen[-1] == (1.0, "done")
    assert max(share for share, _ in seen[:-1]) < 1.0
    assert any(text.startswith("screening, 1 of") for _, text in seen)
