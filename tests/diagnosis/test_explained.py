"""When a model with effects explains the data, when it stays as given, and what a diagnosis then says."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg, SearchCfg
from concent_warp.diagnosis.result import Diagnosis, UnknownForceFound
from concent_warp.diagnosis.search import additions, context, revision
from concent_warp.diagnosis.search.adequacy import is_adequate, least_ratio
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.diagnosis.made_up import FINER, finding, force_is, node, procedure
from tests.scenes.swinging import swing_scene


def test_the_least_ratio_is_the_residual_over_the_noise_as_large_as_it_may_be():
    one = node(1.2)
    assert least_ratio(one, {}) == pytest.approx(1.2)
    assert least_ratio(one, {"angle": 1.5}) == pytest.approx(0.8)
    assert least_ratio(one, {"rate": 1.5}) == pytest.approx(1.2)
    scaled = node(0.6)
    scaled.noise_scale = 2.0  # residuals are in units of twice the noise
    assert least_ratio(scaled, {"angle": 1.5}) == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("left", "first", "factor", "added", "explains"),
    [
        (1.25, 9.0, 1.0, False, True),
        (1.26, 9.0, 1.0, False, False),
        (1.09, 1.5, 1.0, True, True),  # little beside the noise, 15 % of the discrepancy
        (1.11, 1.5, 1.0, True, False),  # an imitation: more than a little, and 19 %
        (1.24, 1.5, 1.0, True, False),
        (1.24, 3.0, 1.0, True, True),  # 7 %: an error in a formula
        (1.24, 2.5, 1.0, True, False),  # 10 %
        (1.9, 9.0, 1.0, True, True),
        (2.01, 17.0, 1.0, True, False),
        (2.01, 18.0, 1.0, True, True),  # 0.9 %
        (4.9, 50.0, 1.0, True, True),
        (4.9, 47.0, 1.0, True, False),  # 1.04 %
        (5.1, 500.0, 1.0, True, False),
        (1.3, 1.7, 1.2, True, True),  # 1.08 x the largest noise
        (1.34, 1.7, 1.2, True, False),
    ],
)
def test_an_effect_that_leaves_more_than_little_noise_and_more_than_an_error_of_form_explains_nothing(
    left, first, factor, added, explains
):
    made = procedure()
    made.context.noise_factors = {"angle": factor}
    assert made.context.explains(node(left), node(first), added=added) is explains
    if added and not explains and left < 1.25:
        assert is_adequate(node(left), made.context.noise_factors, made.context.cfg)


def test_the_ratio_up_to_which_an_effect_is_an_explanation_is_a_setting():
    made = procedure(search=replace(SearchCfg(), explained_ratio=1.2))
    assert made.context.explains(node(1.19), node(1.5), added=True)
    assert not made.context.explains(node(1.21), node(1.5), added=True)


def test_an_imitation_makes_the_verdict_none_of_these(monkeypatch):
    force_is(monkeypatch, lambda *_: pytest.fail("more than that is missing"))
    made = procedure()
    made.record.findings, made.record.groups = [finding("a", 0.5)], [("a",)]
    found = made.conclude(node(1.5), [node(1.5), node(1.2, effects=1)], (), ())
    assert (found.verdict, found.form_error) == ("none_of_these", None)
    assert found.unexplained == pytest.approx(0.44 / 1.25)
    assert found.explains


@pytest.mark.parametrize(
    ("refused", "found", "verdict"),
    [
        (True, False, "none_of_these"),
        (True, True, "none_needed"),
        (True, None, "none_needed"),
        (False, False, "none_needed"),
    ],
)
def test_a_force_of_no_known_form_decides_where_no_effect_explains_enough_of_little(
    monkeypatch, refused, found, verdict
):
    force = None if found is None else UnknownForceFound("a force", 0.2, 0.0025, 0.5, None, form_error=found)
    force_is(monkeypatch, lambda *_: force)
    made, given = procedure(), node(1.2)
    made.record.findings, made.record.part_refused = [finding("a", 0.1, accepted=False)], refused
    concluded = made.conclude(given, [given], (), ())
    assert concluded.verdict == verdict
    assert (concluded.unexplained, concluded.explains) == ((1.0, False) if verdict == "none_of_these" else (0.0, True))


@pytest.mark.parametrize(("error", "verdict"), [(0.02, "none_needed"), (None, "none_of_these")])
def test_what_may_be_an_error_of_the_models_own_friction_needs_no_effect(monkeypatch, error, verdict):
    force_is(monkeypatch, lambda *_: None)
    made, given, asked = procedure(), node(9.0), []
    made._error_of_own_friction = lambda one: asked.append(one) or error
    made.record.findings = [finding("a", 0.1, accepted=False)]
    last = node(1.4, nominal=1)
    concluded = made.conclude(given, [last], (), ())
    assert (concluded.verdict, asked) == (verdict, [last])
    said = [sentence for sentence in concluded.issues if "2 % of what the model's own dry friction does" in sentence]
    assert bool(said) is (error is not None)


def test_where_what_is_left_may_be_an_error_of_a_formula_one_more_effect_is_tried(monkeypatch):
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    for left, explained in ((1.09, True), (1.2, True), (1.9, True), (2.1, False)):
        made, asked = procedure(), []

        def find(_base, step, *, explained, asked=asked, left=left, **_):
            asked.append(explained)
            return (None if step else node(left, effects=1)), ()

        monkeypatch.setattr(made.additions.finder, "find", find)
        made.additions.add_effects([node(9.0)], ())
        # An effect must then be established beside the others; beside the model as given it need not be.
        assert asked == [False, explained]


def test_a_search_ends_with_a_shorter_time_step_that_leaves_no_more_than_noise(monkeypatch):
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "time_step_finding", lambda *_: "found")
    given, asked = node(3.0, 100.0), []
    for ratio, factor, more in ((1.02, 1.0, False), (1.03, 1.0, True), (1.4, 1.4, False), (1.5, 1.4, True)):
        made, finer = procedure(), node(ratio, 10.0, timestep=FINER)
        made.context.noise_factors = {"angle": factor}
        monkeypatch.setattr(made.additions, "_finer", lambda one, _step, finer=finer: finer if one is given else None)
        monkeypatch.setattr(made.additions.finder, "find", lambda base, *_, **_k: asked.append(base) or (None, ()))
        asked.clear()
        assert made.additions.add_effects([given], ())[0] == [finer]
        assert made.record.time_step == "found"
        assert bool(asked) is more


def test_a_model_that_leaves_no_more_than_noise_stays_as_given_where_no_effect_was_accepted(monkeypatch):
    for name in ("at_given_step", "without_nominal_values"):
        monkeypatch.setattr(revision, name, lambda one, *_: one)
    for ratio, found, stays in (
        (1.02, [], True),
        (1.02, [finding("a", 0.5, accepted=False)], True),
        (1.03, [], False),  # what is left is more than an effect must remove
        (1.02, [finding("a", 0.5)], False),
    ):
        made, given = procedure(), node(ratio, 100.0)
        made.record.time_step, made.record.findings = "found", list(found)
        last = node(1.0, 90.0, timestep=FINER, nominal=2)
        fitted = made.revision.restore_given([given, last], given)
        assert fitted == ([given] if stays else [given, last])
        assert made.record.time_step == (None if stays else "found")
        if stays:
            found_values = made.revision.final_values(fitted)
            assert found_values == [given]
            assert made.record.nominal_values == ()
            assert made.conclude(given, fitted, (), ()).changes_model is False


@pytest.mark.parametrize(("left", "explains"), [(1.7, True), (1.84, True), (1.85, False), (2.1, False)])
def test_the_model_stays_as_given_where_accepted_effects_explain_less_than_a_fifth(left, explains):
    made, given, last = procedure(), node(2.0, name="given"), node(left, effects=1, name="last")
    made.record.findings, made.record.groups = [finding("a", 0.06)], [("a",)]
    found = made.conclude(given, [given, last], (), ())
    assert found.verdict == "none_of_these"
    assert found.unexplained == pytest.approx(min((left**2 - 1) / 3, 1.0))
    assert (found.explains, found.changes_model) == (explains, explains)
    assert found.model is (last.delivered if explains else given.delivered)
    assert [f.name for f in found.accepted] == ["a"]


def test_without_an_accepted_effect_the_model_is_as_given():
    given = node(3.0, name="given")
    found = procedure().conclude(given, [given], (), ())
    assert (found.verdict, found.unexplained, found.model) == ("none_of_these", 1.0, given.delivered)
    assert not found.changes_model


def test_the_least_share_that_effects_must_explain_is_a_setting():
    for least, explains in ((0.1, True), (0.2, False), (0.0, True)):
        made, given = procedure(min_explained=least), node(2.0)
        made.record.findings, made.record.groups = [finding("a", 0.06)], [("a",)]
        assert made.conclude(given, [given, node(1.9, effects=1)], (), ()).explains is explains
    assert DiagnoseCfg().min_explained == SearchCfg().far_min_gain


def test_effects_that_are_named_are_in_the_model_however_much_they_leave(monkeypatch):
    """The share of a discrepancy that is itself hardly above the noise means little."""
    force_is(monkeypatch, lambda *_: None)
    made, given = procedure(), node(1.04)
    made.record.findings, made.record.groups = [finding("a", 0.2)], [("a",)]
    found = made.conclude(given, [given, node(1.035, effects=1)], (), ())
    assert found.unexplained > 0.8
    assert (found.verdict, found.explains, found.changes_model) == ("effect", True, True)


def said_of(**changes: Any) -> Diagnosis:
    """Return a diagnosis whose last model has an effect that explains little."""
    given = Model(Scene(swing_scene()))
    last = given.add_effect("joint_damping", ["hinge"])
    found = Diagnosis(
        "none_of_these", (finding("joint_damping", 0.1),), (("joint_damping",),), (), 0.9, (4.0, 3.9), (), None, (),
        (given, last), explains=False,
    )  # fmt: skip
    return replace(found, **changes)


SENTENCE = "The effects above explain too little to be added: the model stays as given."


def test_a_diagnosis_says_that_the_model_stays_as_given():
    said = said_of().sentences()
    assert said[1:] == ["90 % of the discrepancy stays unexplained by any effect in the library.", SENTENCE]
    assert SENTENCE not in said_of(explains=True).sentences()
    # Without an accepted effect there are none above.
    assert SENTENCE not in said_of(effects=(finding("joint_damping", 0.1, accepted=False),)).sentences()


def test_the_model_of_a_diagnosis_that_explains_too_little_is_that_as_given():
    found = said_of()
    assert found.model is found.models[0]
    assert found.model.effects == ()
    assert not found.changes_model
    named = replace(found, explains=True)
    assert [a.effect.name for a in named.model.effects] == ["joint_damping"]
    assert named.changes_model
    assert json.loads(json.dumps(found.to_json(), allow_nan=False))["effects"][0]["accepted"] is True
