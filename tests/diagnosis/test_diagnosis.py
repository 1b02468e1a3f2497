import json
from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.experiment.suggested import SuggestedExperiment, SuggestedMotion, TimeSeries
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import (
    STEP_TOO_LONG,
    VERDICTS,
    Detectable,
    Diagnosis,
    Finding,
    FinerTimeStep,
    UnknownForceFound,
    _joined,
    _number,
)
from concent_warp.fit.effects.intervals import FittedParameter
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import drawing, swing_scene, swung

FRICTION = FittedParameter("torque[hinge]", 0.03, 0.029, 0.031, "N m", 0.0)
EXPERIMENT = SuggestedExperiment(
    "chirp", "swing faster: a and b then differ by 4.0 x noise (angle).", 4.0, ("a", "b"), "angle", {("a", "b"): 4.0},
    SuggestedMotion(1.0, {"servo": TimeSeries(np.arange(2.0), np.arange(2.0), "rad")}, {}, {}), {},
)  # fmt: skip
LIMIT = FittedParameter("limit", 2.0, 1.9, np.inf, "N m", np.inf)


def finding(name, gain, *, accepted=True, step=0, reason="", parameters=(FRICTION,), p=0.01):
    return Finding(
        name, ("hinge",), "joints", parameters, gain, gain - 0.1, gain + 0.1, p, 0.002, accepted, step,
        (("angle", 0.9),), reason, 1 / 401,
    )  # fmt: skip


def diagnosis(**changes):
    model = Model(Scene(swing_scene()))
    base = Diagnosis(
        "effect",
        (finding("joint_friction", 0.8), finding("joint_damping", 0.3, accepted=False, reason="no better than chance")),
        (("joint_friction",),),
        (),
        0.0,
        (4.0, 1.0),
        (Detectable("joint_friction", "torque[hinge]", 0.002, "N m"),),
        None,
        (),
        (model, model),
    )
    return replace(base, **changes)


def test_an_effect_is_named_with_value_interval_gain_and_chance():
    (sentence,) = diagnosis().sentences()
    assert sentence == (
        "Missing: joint_friction (torque[hinge] 0.03 [0.029, 0.031] N m). "
        "Held-out error falls by 80 % [70, 90], p = 0.01."
    )


def test_an_effect_whose_intervals_include_no_change_is_said_to_rest_on_the_error_alone():
    friction = finding("joint_friction", 0.8)
    wide = replace(friction.parameters[0], low=-0.01)
    for parameters, said in (((wide,), True), ((wide, friction.parameters[0]), False)):
        sentences = diagnosis(effects=(replace(friction, parameters=parameters),)).sentences()
        sentence = (
            "Each interval of joint_friction includes no change, as errors of nominal values within their tolerance, "
            "or of the fit, may be as large: the fall of the error speaks for it."
        )
        assert (sentence in sentences) is said


def test_the_headline_claims_no_size_that_the_intervals_leave_open():
    friction, mass = finding("joint_friction", 0.8), finding("mass", 0.3, step=1)
    wide = (replace(FRICTION, low=-0.01),)
    open_friction = replace(friction, parameters=wide)
    assert diagnosis(effects=(open_friction,)).headline == f"{VERDICTS['effect']}, but not its size"
    both = diagnosis(effects=(open_friction, mass), groups=(("joint_friction",), ("mass",)))
    assert both.headline == f"{VERDICTS['effect']}, but not the size of joint_friction"
    for other in (diagnosis(effects=(friction,)), diagnosis(effects=(open_friction,), verdict="group")):
        assert other.headline == VERDICTS[other.verdict]


def test_parameters_that_may_have_no_change_are_counted_beside_others():
    stiff = FittedParameter("stiffness[pad]", 1101.2, 1096.1, 1106.4, "N/m", 0.0)
    none = [FittedParameter(f"{name}[pad]", 0.1, -4.98, 4.8, "N", 0.0) for name in ("preload", "offset")]
    (said,) = diagnosis(effects=(finding("joint_stiffness", 0.8, parameters=(none[0], stiff, none[1])),)).sentences()
    assert said.startswith(
        "Missing: joint_stiffness (stiffness[pad] 1101 [1096, 1106] N/m, 2 more include no change). "
    )
    (said,) = diagnosis(effects=(finding("joint_stiffness", 0.8, parameters=(stiff, none[0])),)).sentences()
    assert "N/m, 1 more includes no change)." in said
    (said,) = diagnosis(effects=(finding("joint_stiffness", 0.8, parameters=(stiff,) * 6),)).sentences()
    assert said.count("stiffness[pad]") == 4
    assert "N/m, 2 more)." in said
    shown = diagnosis(effects=(finding("joint_stiffness", 0.8, parameters=(stiff,)),))._repr_html_()
    assert "<td>1101</td><td>1096 to 1106</td>" in shown


def test_indistinguishable_effects_are_named_together():
    found = diagnosis(verdict="group", groups=(("joint_friction", "joint_damping", "backlash"),))
    assert found.sentences()[1] == "The data cannot distinguish it from joint_damping or backlash."


def test_a_second_effect_follows_the_first():
    both = (finding("joint_friction", 0.8), finding("mass", 0.2, step=1))
    found = diagnosis(effects=both, groups=(("joint_friction",), ("mass",)))
    assert [s.split(" (")[0] for s in found.sentences()] == ["Missing: joint_friction", "Then missing: mass"]
    assert [f.name for f in found.accepted] == ["joint_friction", "mass"]


def test_nothing_found_comes_with_what_would_have_been_seen():
    said = diagnosis(verdict="none_needed", effects=(), ratio=(1.02,)).sentences()
    assert said[0] == "No discrepancy detected: residuals are 1.02 x noise."
    assert "joint_friction torque[hinge] 0.002 N m" in said[1]


def test_smallest_sizes_repeat_no_name_and_have_a_unit_or_a_share():
    found = (
        Detectable("inertia", "inertia", 0.032, "-", 1.0),
        Detectable("mass(pusher)", "mass", 0.0021, "-", 1.0),
        Detectable("sliding_friction", "coefficient", 0.0036, "-", 0.36),
        Detectable("sensor_gain", "scale[encoder]", 0.02, "-", 0.0),
        Detectable("length_scale", "scale", 9e-4, "-", 0.0),
        Detectable("center_of_mass", "z", 2.1e-4, "m", 0.0),
    )
    _, said = diagnosis(verdict="none_needed", effects=(), detectable=found).sentences()
    assert said == (
        "Smallest detectable sizes (from there on an effect would be noticed, were nothing else wrong; not how exactly "
        "its size would be known): inertia 3.2 % of the model's; mass(pusher) 0.21 % of the model's; sliding_friction "
        "coefficient 1 % of the model's; sensor_gain scale[encoder] 0.02 (no unit); length_scale 0.0009 "
        "(no unit); center_of_mass z 0.00021 m."
    )
    assert diagnosis(detectable=found).to_json()["detectable"][2] == {
        "name": "sliding_friction", "parameter": "coefficient", "size": 0.0036, "unit": "-", "null": 0.36,
    }  # fmt: skip


def test_scatter_that_counts_as_noise_is_said_beside_the_residuals():
    clause = (
        "x noise; the scatter of simulated contacts over a time step counts as noise here; `compare` counts it as "
        "error, and may show more."
    )
    for verdict, effects in (("none_needed", ()), ("effect", diagnosis().effects), ("none_of_these", ())):
        for rests in (True, False):
            found = diagnosis(verdict=verdict, effects=effects, rests_on_scatter=rests)
            assert any(s.endswith(clause) for s in found.sentences()) is (rests and verdict != "none_of_these")
            assert found.to_json()["rests_on_scatter"] is rests


def test_what_no_effect_explains_is_reported_with_its_share():
    said = diagnosis(verdict="none_of_these", unexplained=0.4, next_experiment=EXPERIMENT).sentences()
    assert said[0].startswith("Explains a part: joint_friction")
    assert any(s.startswith("40 % of the discrepancy stays unexplained") for s in said)
    assert said[-1] == "Next experiment: swing faster: a and b then differ by 4.0 x noise (angle)."
    little = diagnosis(verdict="none_of_these", unexplained=0.004).sentences()
    assert any(s.startswith("Less than 1 % of the discrepancy stays unexplained") for s in little)


def test_what_is_left_and_taken_for_errors_in_formulas_is_named_with_its_size():
    force = UnknownForceFound("a force on rail that depends on its position", 0.4, 0.002, 0.02, form_error=True)
    plain, with_form = diagnosis(), diagnosis(form_error=0.0287, ratio=(5.0, 1.3), unexplained=0.0287)
    assert not any("formulas" in s for s in plain.sentences())
    (said,) = (s for s in with_form.sentences() if "formulas" in s)
    assert said == (
        "What is left, 1.30 x noise, is 2.9 % of the discrepancy: no more than errors in the formulas of the accepted "
        "effects."
    )
    both = replace(with_form, unknown_force=force, next_experiment=EXPERIMENT).sentences()
    assert [k for k, s in enumerate(both) if "formulas" in s] == [1, 2]  # after the effects, before the experiment
    assert both[0].startswith("Missing: joint_friction")
    assert both[2].startswith("A force on rail that depends on its position explains 2.0 % of the discrepancy besides")
    assert both[3].startswith("Next experiment")
    assert with_form.headline == VERDICTS["effect"]


def test_a_remainder_that_was_not_searched_is_said_to_be_open():
    named = diagnosis(form_error=0.0287, ratio=(5.0, 1.3), unexplained=0.0287, remainder_searched=False)
    said = named.sentences()
    assert said[said.index("Whether something smaller is missing too was not settled in this time.") - 1].startswith(
        "What is left, 1.30 x noise, is 2.9 % of the discrepancy"
    )
    assert named.to_json()["remainder_searched"] is False
    for searched in (True, None):
        other = replace(named, remainder_searched=searched)
        assert not any("smaller" in s for s in other.sentences())
        assert other.to_json()["remainder_searched"] is searched


def test_json_has_the_share_of_errors_in_formulas_and_null_where_there_is_none():
    document = json.loads(json.dumps(diagnosis(form_error=0.0287).to_json(), allow_nan=False))
    assert document["form_error"] == 0.0287
    found = diagnosis().to_json()
    assert found["form_error"] is None
    keys = list(found)
    assert keys.index("form_error") == keys.index("unknown_force") + 1 == keys.index("remainder_searched") - 1


def test_nominal_values_are_told_as_factors_and_latencies_with_their_unit():
    values = (
        FittedParameter("mass[arm]", 1.0124, 1.0101, 1.0149, "-", 1.0),
        FittedParameter("delay[angle]", 4.2e-4, 3.1e-4, 5.3e-4, "s", 0.0),
    )
    found = diagnosis(nominal_values=values, issues=("a gap of 1 s.",))
    assert found.sentences()[:2] == [
        "a gap of 1 s.",
        "Nominal values were fitted within their tolerances: mass[arm] x 1.012 [1.010, 1.015], "
        "delay[angle] 0.00042 [0.00031, 0.00053] s.",
    ]
    assert [(p["name"], p["unit"], p["null"]) for p in found.to_json()["nominal_values"]] == [
        ("mass[arm]", "-", 1.0),
        ("delay[angle]", "s", 0.0),
    ]
    assert replace(found, effects=()).changes_model
    assert not replace(found, effects=(), nominal_values=()).changes_model


def test_nominal_values_that_did_not_change_are_only_counted():
    same = FittedParameter("length[arm]", 1.0002, 0.998, 1.003, "-", 1.0)
    narrow = FittedParameter("gain[arm]", 1.00042, 1.0002, 1.0007, "-", 1.0)
    late = FittedParameter("delay[angle]", 1e-6, -1e-4, 1e-4, "s", 0.0)
    lead = "Nominal values were fitted within their tolerances"
    assert diagnosis(nominal_values=(same, narrow, late)).sentences()[0] == (
        f"{lead}: gain[arm] x 1.0004 [1.0002, 1.0007]; 2 others did not change visibly."
    )
    moved = replace(same, value=0.9991)
    assert diagnosis(nominal_values=(moved, late)).sentences()[0] == (
        f"{lead}: length[arm] x 0.999 [0.998, 1.003]; 1 other did not change visibly."
    )
    assert diagnosis(nominal_values=(same, late)).sentences()[0] == f"{lead}; none of 2 changed visibly."


def test_the_headline_names_effects_beside_what_none_explains():
    assert diagnosis().headline == VERDICTS["effect"]
    assert diagnosis(verdict="none_of_these", effects=()).headline == VERDICTS["none_of_these"]
    partly = diagnosis(verdict="none_of_these").headline
    assert partly == "the library explains a part; something is missing that none of its effects explains"


def test_doubts_about_the_data_come_first():
    assert diagnosis(issues=("a gap of 1 s.",)).sentences()[0] == "a gap of 1 s."


def test_json_has_plain_types_and_no_infinity():
    found = diagnosis(effects=(finding("actuator_saturation", 0.5, parameters=(LIMIT,)),), versions={"concent": "1"})
    document = json.loads(json.dumps(found.to_json(), allow_nan=False))
    (parameter,) = document["effects"][0]["parameters"]
    assert parameter == {"name": "limit", "value": 2.0, "interval": [1.9, None], "unit": "N m", "null": None}
    assert document["effects"][0]["gain"] == {"value": 0.5, "interval": pytest.approx([0.4, 0.6])}
    assert document["effects"][0]["removes"] == [{"channel": "angle", "share": 0.9}]
    assert document["versions"] == {"concent": "1"}
    assert "reason" not in document["effects"][0]


def test_the_smallest_p_value_of_the_test_is_shown_as_a_bound():
    assert finding("joint_friction", 0.8, p=1 / 401).p_text == "p <= 0.0025"
    assert finding("joint_friction", 0.8, p=2 / 401).p_text == "p = 0.005"
    smallest = diagnosis(effects=(finding("joint_friction", 0.8, p=1 / 401),))
    assert smallest.sentences()[0].endswith("p <= 0.0025.")


def test_json_has_the_experiment_without_its_arrays():
    found = diagnosis(next_experiment=EXPERIMENT).to_json()["next_experiment"]
    assert found["separations"] == [{"pair": ["a", "b"], "separation": 4.0}]
    assert "motion" not in found
    motion = json.loads(json.dumps(EXPERIMENT.to_json()))["motion"]
    assert motion["commands"]["servo"] == {"time": [0.0, 1.0], "value": [0.0, 1.0], "unit": "rad"}


def test_html_shows_verdict_and_accepted_effects_and_escapes_them():
    shown = diagnosis(effects=(finding("<joint>", 0.8, p=1 / 401),), groups=(("<joint>",),))._repr_html_()
    assert shown.startswith("<div><p><b>An effect is missing, and the data identify it</b></p><table>")
    for cell in ("&lt;joint&gt;", "0.03", "0.029 to 0.031", "N m", "80 % [70, 90]", "p &lt;= 0.0025"):
        assert f"<td>{cell}</td>" in shown
    assert "<joint>" not in shown
    assert "<table>" not in diagnosis(verdict="none_needed", effects=())._repr_html_()


def test_every_verdict_has_words():
    assert set(VERDICTS) == {"effect", "group", "none_needed", "none_of_these", "unsettled"}


def test_an_interval_that_holds_the_null_value_does_not_exclude_it():
    assert FRICTION.excludes_null
    assert not replace(FRICTION, low=-0.001).excludes_null
    assert not LIMIT.excludes_null
    assert replace(LIMIT, high=2.1).excludes_null


def test_numbers_and_lists_of_names():
    assert _number(np.float64(1.5)) == 1.5
    assert _number(np.inf) is None
    assert [_joined(["a"]), _joined(["a", "b"]), _joined(["a", "b", "c"])] == ["a", "a or b", "a, b or c"]


def test_the_suggested_experiment_is_written_with_its_motion(tmp_path, monkeypatch):
    recording = swung(seconds=0.5)
    monkeypatch.setattr(Procedure, "run", lambda _: diagnosis(next_experiment=EXPERIMENT))
    found = diagnose(drawing(recording), recording, out=tmp_path / "kept")
    assert found.next_experiment is EXPERIMENT
    document = json.loads((tmp_path / "kept" / "next_experiment.json").read_text())
    assert document == json.loads(json.dumps(EXPERIMENT.to_json()))


def test_a_time_step_that_is_too_long_for_a_verdict_is_named_as_the_reason():
    step = FinerTimeStep(2e-3, 2.5e-4, 102.0, 0.98, 0.97, 0.99, too_long=True)
    found = diagnosis(verdict="unsettled", effects=(), groups=(), time_step=step)
    assert found.headline == STEP_TOO_LONG
    assert "predictions change by 102 x noise" in found.sentences()[0]
    assert diagnosis(verdict="unsettled", effects=()).headline == VERDICTS["unsettled"]
