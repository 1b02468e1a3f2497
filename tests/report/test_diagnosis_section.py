import re
from html import unescape

import pytest

from concent_warp.comparison.compare import compare_replays
from concent_warp.report.diagnosis_section import NOISE_REACHED, _bars, _headline, diagnosis_section
from concent_warp.report.report import write_report


def effect(name, gain, p, **rest):
    low, high = gain - 0.1, gain + 0.1
    parameter = {"name": "torque[hinge]", "value": 0.02134, "interval": [0.0195, 0.0231], "unit": "N m"}
    return {
        "name": name,
        "family": "joints",
        "gain": {"value": gain, "interval": [low, high]},
        "p": p,
        "p_smallest": 1 / 401,
        "accepted": p < 0.05,
        "parameters": [parameter],
        **rest,
    }


NAMED = {
    "verdict": "effect",
    "effects": [effect("joint_friction", 0.62, 1 / 401), effect("armature", 0.04, 0.4)],
    "groups": [],
    "where": [{"sentence": "hinge position, free phase, 1.20-2.50 s, against motion"}],
    "unexplained": 0.043,
    "detectable": [{"name": "armature", "parameter": "armature[hinge]", "size": 2e-4, "unit": "kg m^2"}],
    "next_experiment": None,
}


def words_of(section):
    return " ".join(unescape(re.sub(r"<[^>]*>", " ", section)).split())


def test_an_effect_is_named_with_its_gain_interval_p_and_parameter():
    text = words_of(diagnosis_section(NAMED))
    assert "The model lacks joint friction (joints and drives)." in text
    assert "it removes 62 % [52, 72] of the error (p <= 0.0025)" in text
    assert "4 % of the error stays unexplained" in text
    assert "torque[hinge] 0.02134 0.0195 to 0.0231 N m" in text
    assert "hinge position, free phase, 1.20-2.50 s, against motion" in text
    assert "armature[hinge] 0.0002 kg m^2" in text
    assert "Next experiment" not in text


def test_a_size_that_the_intervals_leave_open_is_said_to_be_unknown():
    bare, known = effect("sensor_gain", 0.6, 0.01), effect("armature", 0.5, 0.01)
    for null, unknown in ((0.0, False), (0.02, True), (None, False)):
        bare["parameters"][0]["null"] = null
        text = _headline({**NAMED, "effects": [bare]})
        assert ("Its size is not known: each interval includes no change." in text) is unknown
    bare["parameters"][0] |= {"interval": [0.0195, None], "null": None}  # a limit that may not be there
    assert "The size of sensor gain is not known" in _headline({**NAMED, "effects": [bare, known]})


def test_numbers_of_ordinary_size_have_no_exponent():
    stiff = effect("joint_stiffness", 0.5, 0.001)
    stiff["parameters"][0] |= {"value": 23456.7, "interval": [23321.0, 23590.2], "unit": "N/m"}
    assert "23457 23321 to 23590 N/m" in words_of(diagnosis_section({**NAMED, "effects": [stiff]}))


def test_smallest_sizes_say_what_they_mean_and_are_shares_where_they_have_no_unit():
    limits = [{"name": "inertia", "parameter": "inertia", "size": 0.032, "unit": "-", "null": 1.0}]
    text = words_of(diagnosis_section({**NAMED, "detectable": limits}))
    assert "(from there on an effect would be noticed, were nothing else wrong;" in text
    assert "inertia 3.2 % of the model's" in text
    assert "inertia inertia" not in text


def test_scatter_that_counts_as_noise_is_said_beside_the_residuals():
    quiet = {"verdict": "none_needed", "ratio": [0.78]}
    assert "down to their noise." in _headline(quiet)
    said = _headline({**quiet, "rests_on_scatter": True})
    assert "residuals are 0.78 x noise; the scatter of simulated contacts over a time step counts as noise" in said


def test_what_formulas_leave_is_named_as_their_error():
    text = words_of(diagnosis_section({**NAMED, "form_error": 0.043}))
    assert "What is left, 4 % of the error, is no more than errors in the formulas of the effects." in text
    assert "stays unexplained" not in text


def test_a_remainder_that_was_not_searched_is_said_to_be_open():
    sentence = "Whether something smaller is missing too was not settled in this time."
    text = words_of(diagnosis_section({**NAMED, "form_error": 0.043, "remainder_searched": False}))
    assert f"errors in the formulas of the effects. {sentence}" in text
    assert sentence not in words_of(diagnosis_section({**NAMED, "remainder_searched": True}))


def test_several_accepted_effects_are_all_named():
    both = {**NAMED, "effects": [effect("joint_friction", 0.4, 0.005), effect("load_friction", 0.3, 0.01)]}
    text = _headline(both)
    assert "lacks joint friction (joints and drives) and load friction (joints and drives)." in text
    assert "joint friction removes 40 % [30, 50] of the error (p = 0.005), load friction removes 30 %" in text


def test_a_group_is_never_told_as_one_winner():
    tied = {**NAMED, "verdict": "group", "groups": [["sliding_friction", "mass"]]}
    tied["next_experiment"] = {"sentence": "Push the block empty and loaded."}
    text = words_of(diagnosis_section(tied))
    assert "cannot distinguish between sliding friction and mass" in text
    assert "These data cannot distinguish between sliding friction and mass." in text
    assert "Next experiment Push the block empty and loaded." in text
    assert "The model lacks joint friction" not in text


@pytest.mark.parametrize(
    ("verdict", "said"), [("none_needed", "No discrepancy was detected"), ("none_of_these", "none of the effects")]
)
def test_no_effect_is_reported_in_words(verdict, said):
    section = diagnosis_section({"verdict": verdict, "effects": [], "detectable": NAMED["detectable"]})
    assert said in words_of(section)
    assert ("<details open>" in section) == (verdict == "none_needed")


def test_without_an_effect_noise_is_what_is_left_only_where_no_more_is():
    for ratio, said in ((1.25, "down to their noise"), (1.36, "residuals are 1.36 x noise")):
        section = diagnosis_section({"verdict": "none_needed", "effects": [], "ratio": [9.0, ratio]})
        assert said in words_of(section)


def test_what_the_model_has_besides_effects_is_named():
    besides = "The model's limits of joints give way to a load."
    said = words_of(diagnosis_section({"verdict": "none_needed", "ratio": [9.0, 1.0], "changes_besides": [besides]}))
    assert f"{NOISE_REACHED}, with what is named below." in said
    assert besides in said
    assert "below" not in words_of(diagnosis_section({"verdict": "none_needed", "ratio": [1.0]}))


def test_what_was_found_is_named_beside_what_no_effect_explains():
    partly = {**NAMED, "verdict": "none_of_these", "groups": [["joint_friction", "mass"], ["drag"]], "unexplained": 0.3}
    partly["effects"] = [effect("joint_friction", 0.5, 0.005), effect("drag", 0.2, 0.01), effect("wind", 0.1, 0.3)]
    text = _headline(partly)
    assert (
        "none of the effects in the library explains, beside what joint friction or mass and drag can account" in text
    )
    assert "lacks joint friction" not in text
    assert "joint friction removes 50 % [40, 60] of the error (p = 0.005), drag removes 20 %" in text
    assert "wind" not in text
    assert "30 % of the error stays unexplained" in text


def test_bars_span_from_zero_to_the_gain_and_whiskers_the_interval():
    drawn = _bars([effect("joint_friction", 0.8, 0.001), effect("drag", -0.1, 1.0)])
    first, second = re.findall(r'class="effect (\w+)"(.*?)</div>', drawn)
    assert (first[0], second[0]) == ("accepted", "rejected")
    low, span = -0.2, 1.1
    zero, gain, whisker = re.findall(r"left:([\d.]+)%", first[1])
    assert float(zero) == float(gain) == pytest.approx(100 * -low / span, abs=0.01)
    assert float(whisker) == pytest.approx(100 * (0.7 - low) / span, abs=0.01)
    assert float(re.search(r'class="gain"[^>]*width:([\d.]+)%', first[1])[1]) == pytest.approx(80 / span, abs=0.01)
    assert float(re.search(r'class="gain" style="left:([\d.]+)%', second[1])[1]) == pytest.approx(10 / span, abs=0.01)


def test_entries_that_are_missing_are_left_out():
    section = diagnosis_section({"verdict": "none_of_these"})
    assert "none of the effects in the library explains." in section
    assert "<h3>" not in section
    assert diagnosis_section(None) == ""


def test_a_limit_that_is_not_there_is_infinite():
    limit = effect("actuator_saturation", 0.5, 0.001)
    limit["parameters"][0]["interval"] = [0.1, None]
    assert "0.1 to ∞" in words_of(diagnosis_section({**NAMED, "effects": [limit]}))


def test_names_of_a_diagnosis_cannot_become_markup():
    bad = effect("<b>x</b>", 0.5, 0.001)
    bad["parameters"][0]["name"] = "<i>"
    section = diagnosis_section(
        {**NAMED, "effects": [bad], "where": [{"sentence": "<u>"}], "next_experiment": {"sentence": "<s>"}}
    )
    for tag in ("<b>x", "<i>", "<u>", "<s>"):
        assert tag not in section.replace('<i class="', "")


def test_the_section_stands_in_the_report(case, tmp_path):
    models = {"model": case.after}
    path = tmp_path / "r.html"
    found = compare_replays(models, case.recording, "mujoco")
    write_report(path, case.recording, found, diagnosis=NAMED)
    assert "The model lacks joint friction" in path.read_text()
    assert "<title>Diagnosis" in path.read_text()
    write_report(path, case.recording, found)
    assert 'id="diagnosis"' not in path.read_text()
    assert "<title>Model against measurement" in path.read_text()
