import json
from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.suggestion.cfg import SuggestCfg
from concent_warp.diagnosis.suggestion.hypotheses import fitted_hypotheses, open_question, read_diagnosis
from concent_warp.effects.library.joints import JointDamping, JointFriction
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.diagnosis.suggestion.carts import one_speed, open_group

RECORDING = one_speed(friction=0.2)
MODEL = Model(Scene(RECORDING.scene))
CFG = SuggestCfg()


def alone(low, high):
    document = open_group(verdict="effect", groups=[["joint_friction"]])
    document["effects"][0]["parameters"][0]["interval"] = [low, high]
    return document


def test_each_effect_of_a_group_is_a_hypothesis_fitted_to_the_data():
    question = open_question(MODEL, open_group(), CFG)
    assert list(question.models) == ["joint_friction", "joint_damping"]
    found = fitted_hypotheses(question, RECORDING, CFG, "mujoco")
    assert [h.model.effects[0].effect.name for h in found] == ["joint_friction", "joint_damping"]
    assert found[0].model.effects[0].values[0] == pytest.approx(0.2, rel=0.1)
    assert all(0 < h.std[0] < 1 for h in found)


def test_other_accepted_effects_stay_beside_those_of_a_group():
    document = open_group()
    document["groups"].append(["armature"])
    parameters = [{"name": "inertia[rail]", "value": 0.1, "interval": [0.09, 0.11], "null": 0.0}]
    document["effects"].append(
        {"name": "armature", "target": ["rail"], "accepted": True, "step": 1, "parameters": parameters}
    )
    models = open_question(MODEL, document, CFG).models
    assert [[a.effect.name for a in m.effects] for m in models.values()] == [
        ["armature", "joint_friction"],
        ["armature", "joint_damping"],
    ]


def test_a_wide_interval_is_open_between_its_ends():
    question = open_question(MODEL, alone(0.1, 0.3), CFG)
    assert question.sentence == "Open: torque[rail] of joint_friction is known to 50 % only."
    low, high = fitted_hypotheses(question, RECORDING, CFG, "mujoco", lambda model: model)
    assert (low.model.effects[0].values, high.model.effects[0].values) == ((0.1,), (0.3,))
    assert low.std.tolist() == high.std.tolist() == [0.0]
    assert question.narrowed(0.0) == pytest.approx(0.5)
    assert question.narrowed(question.needed(0.25)) == pytest.approx(0.25)


def test_nothing_is_open_where_an_effect_is_known_well():
    assert not open_question(MODEL, alone(0.19, 0.21), CFG).models
    assert open_question(MODEL, alone(0.19, 0.21), replace(CFG, max_interval=0.01)).models


@pytest.mark.parametrize("verdict", ["none_needed", "none_of_these"])
def test_nothing_is_open_where_no_effect_was_accepted(verdict):
    question = open_question(MODEL, {"verdict": verdict, "effects": [], "groups": []}, CFG)
    assert not question.models
    assert question.sentence


def test_nominal_values_are_open_within_their_tolerance():
    question = open_question(MODEL, open_group(), CFG)
    hypothesis = fitted_hypotheses(question, RECORDING, CFG, "mujoco", lambda model: model)[0]
    wider = hypothesis.with_nominal_values(CFG)
    assert wider.nominal == len(wider.std) - len(hypothesis.std) > 0
    assert np.all(wider.std > 0)
    masses = [a for a in wider.model.effects if a.effect.name == "nominal_mass"]
    assert masses
    assert wider.std[0] == pytest.approx(0.01)


def test_saved_diagnoses_are_read(tmp_path):
    path = tmp_path / "diagnosis.json"
    path.write_text(json.dumps(open_group()))
    for given in (path, tmp_path):
        found = open_question(MODEL, read_diagnosis(given, MODEL), CFG)
        assert list(found.models) == ["joint_friction", "joint_damping"]
    better = MODEL.add(JointFriction("rail"), [0.2])
    better = replace(better, effects=(replace(better.effects[0], intervals=((0.1, 0.3),)),))
    better.save(tmp_path / "better.toml")
    question = open_question(MODEL, read_diagnosis(tmp_path / "better.toml", MODEL), CFG)
    assert question.parameter == (0, 0, 0.1, 0.3)
    known = MODEL.add(JointFriction("rail"), [0.4])
    known = replace(known, effects=(replace(known.effects[0], intervals=((0.399, 0.401),)),))
    known.save(tmp_path / "known.toml")
    question = open_question(MODEL, read_diagnosis(tmp_path / "known.toml", MODEL), CFG)
    assert not question.models
    assert "data identify" not in question.sentence
    assert "does not say what the data may confuse with that" in question.sentence


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "not a diagnosis"),
        ("[1]", "not a diagnosis"),
        ('{"verdict": "group", "groups": [["a", "b"]], "effects": [{"name": "a"}]}', "the diagnosis is damaged"),
        ("{", "JSON"),
    ],
)
def test_what_is_no_diagnosis_is_refused(tmp_path, text, words):
    path = tmp_path / "found.json"
    path.write_text(text)
    with pytest.raises(ModelError, match=words):
        read_diagnosis(path, MODEL)


def test_a_diagnosis_of_another_model_is_refused():
    document = open_group()
    document["effects"][0]["target"] = ["knee"]
    with pytest.raises(ModelError, match="knee"):
        open_question(MODEL, document, CFG)
    with pytest.raises(ModelError, match="already has joint_damping"):
        open_question(MODEL.add(JointDamping("rail"), [1.0]), open_group(), CFG)
