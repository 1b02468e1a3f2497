"""Accepted effects that others, nominal values or a shorter time step make superfluous, with fits that are made up."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest

from concent_warp.diagnosis import procedure as module
from concent_warp.diagnosis.search import context, revision
from tests.diagnosis.made_up import FINER, finding, node, procedure


def test_a_shorter_time_step_after_an_effect_may_make_it_superfluous(monkeypatch):
    made = procedure()
    made.record.groups, made.record.hypotheses, made.record.findings = [("a",)], [{}], [finding("a", 0.5)]
    monkeypatch.setattr(revision, "refit_without_effect", lambda *_: node(1.0, 104.0, timestep=FINER))
    fitted = made.revision.remove_superfluous([node(3), node(1.0, 100.0, effects=1, timestep=FINER)])
    assert len(fitted) == 3
    assert not made.record.groups
    assert not made.record.findings[0].accepted
    kept = procedure()
    kept.record.groups, kept.record.hypotheses, kept.record.findings = [("a",)], [{}], [finding("a", 0.5)]
    monkeypatch.setattr(
        revision, "refit_without_effect", lambda *_: pytest.fail("nothing has changed beside the effect")
    )
    nodes = [node(3), node(1.0, 100.0, effects=1)]
    assert kept.revision.remove_superfluous(nodes) is nodes


def test_superfluous_effects_are_removed_the_least_needed_first(monkeypatch):
    made = procedure()
    fitted = [node(3), node(2), node(1.5), node(1.1, 100.0, effects=5)]  # two of its own, three added
    made.record.groups = [("a", "b"), ("c",), ("d",)]
    made.record.hypotheses = [{"a": 1}, {"c": 2}, {"d": 3}]
    made.record.findings = [finding("a", 0.5, step=0), finding("c", 0.4, step=1), finding("d", 0.3, step=2)]
    made.record.findings.append(finding("x", 0.1, step=1, accepted=False, reason="no better than chance"))
    left: dict[tuple[int, ...], Any] = {
        (5, 2): node(1.2, 120.0, 4), (5, 3): node(1.2, 104.0, 4), (4, 2): node(1.3, 110.0, 3),
    }  # fmt: skip
    asked = []

    def without(last, effect):
        asked.append((len(last.model.effects), effect))
        return left[len(last.model.effects), effect]

    monkeypatch.setattr(revision, "refit_without_effect", without)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    after = made.revision.remove_superfluous(list(fitted))
    assert asked == [(5, 2), (5, 3), (4, 2)]
    assert after == [*fitted, left[5, 3]]
    assert made.record.groups == [("a", "b"), ("d",)]
    assert made.record.hypotheses == [{"a": 1}, {}, {"d": 3}]
    assert [(f.name, f.accepted, f.reason) for f in made.record.findings] == [
        ("a", True, ""), ("c", False, "made superfluous by effects added later"), ("d", True, ""),
        ("x", False, "no better than chance"),
    ]  # fmt: skip
    assert [text for _, text in made.seen].count("removing one effect at a time") == 2


def test_an_effect_that_removes_the_least_gain_stays(monkeypatch):
    # Held-out errors and cost of the model without it.
    for errors, cost, kept in (
        (100 / 0.951, 100.0, False),
        (100 / 0.949, 100.0, True),
        (100.0, 100 / 0.951, False),
        (100.0, 100 / 0.949, True),
    ):
        made, reduced = procedure(), node(1.2, errors, 1)
        reduced.fit.cost = cost
        made.record.groups, made.record.hypotheses = [("a",), ("b",)], [{}, {}]
        monkeypatch.setattr(revision, "refit_without_effect", lambda *_, reduced=reduced: reduced)
        monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
        after = made.revision.remove_superfluous([node(3), node(2), node(1.1, 100.0, 2)])
        assert (len(after) == 3) == kept
        assert made.record.groups == ([("a",), ("b",)] if kept else [("b",)])
    alone = procedure()
    monkeypatch.setattr(revision, "refit_without_effect", lambda *_: pytest.fail("nothing to remove"))
    nodes = [node(3), node(2)]
    assert alone.revision.remove_superfluous(nodes) is nodes


def test_an_effect_that_takes_up_a_part_of_what_may_be_an_error_in_formulas_is_superfluous(monkeypatch):
    for first, ratio, errors, kept in (
        (100.0, 4.0, 100 / 0.22, False),  # 78 % of 0.15 % of the discrepancy, 80 % are needed
        (100.0, 4.0, 100 / 0.18, True),
        (100.0, 6.0, 150.0, True),  # too much beside the noise for such an error
        (30.0, 4.0, 150.0, True),  # too much beside the discrepancy
        (100.0, 1.9, 150.0, True),  # so little beside the noise that additions have been judged by it
    ):
        made, reduced = procedure(), node(ratio, errors, 1)
        made.record.groups, made.record.hypotheses = [("a",), ("b",)], [{}, {}]
        monkeypatch.setattr(revision, "refit_without_effect", lambda *_, reduced=reduced: reduced)
        monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
        after = made.revision.remove_superfluous([node(first), node(2), node(1.1, 100.0, 2)])
        assert (len(after) == 3) == kept


def test_an_effect_is_superfluous_where_nominal_values_explain_as_much(monkeypatch):
    for errors, found, dropped in ((150.0, 104.0, True), (150.0, 106.0, False), (104.0, None, True)):
        made, last = procedure(), node(1.1, 100.0, 2)
        reduced, instead = node(1.3, errors, 1), None if found is None else node(1.12, found, 1, nominal=2)
        made.record.groups, made.record.hypotheses = [("a",), ("b",)], [{}, {}]
        without = {id(last): reduced}  # the second one is needed
        refit = partial(lambda known, one, _k: known.get(id(one), node(9.0, 900.0)), without)
        monkeypatch.setattr(revision, "refit_without_effect", refit)

        def nominal(one, *_, reduced=reduced, instead=instead):
            if one.ratio == 9.0:
                return None
            assert one is reduced
            return instead if instead is not None else pytest.fail("the effect is superfluous without them")

        monkeypatch.setattr(context, "with_nominal_values", nominal)
        monkeypatch.setattr(context, "stays_within", lambda *_: True)
        after = made.revision.remove_superfluous([node(3), node(2), last])
        assert made.record.groups == ([("b",)] if dropped else [("a",), ("b",)])
        assert after[-1] is (last if not dropped else reduced if instead is None else instead)


def test_effects_are_removed_one_at_a_time_and_the_rest_fitted_together(monkeypatch):
    made, asked = procedure(), []
    answers = iter([["first", "second"], ["third"], None])

    def together(fitted):
        asked.append(list(fitted))
        return [*fitted[:-1], f"joint {fitted[-1]}"], ["without"], ["established"]

    def remove(fitted, without, established):
        assert (fitted[-1][:5], without, established) == ("joint", ["without"], ["established"])
        return next(answers)

    monkeypatch.setattr(made.revision, "_fitted_together", together)
    monkeypatch.setattr(made.revision, "remove_unestablished", remove)
    assert made.revision.final_values(["given", "all"]) == ["joint third"]
    assert asked == [["given", "all"], ["first", "second"], ["third"]]
    # What the removed ones explain needs no force of unknown form.
    assert made.record.with_unestablished == ["given", "joint all"]
    tested = []
    monkeypatch.setattr(module, "beyond_effects", lambda nodes, *_, **__: tested.append(nodes))
    made.record.findings, made.record.with_unestablished = [finding("a", 0.1)], [node(3), node(1.2), node(1.0)]
    given, last = node(3), node(1.1)
    assert made.conclude(given, [given, last], (), ()).verdict == "effect"
    made.record.with_unestablished, second = [], list(made.record.with_unestablished)
    made.conclude(given, [given, last], (), ())
    assert tested == [[given, *second[1:]], [given, last]]


def test_the_last_effect_is_superfluous_too_where_nominal_values_in_place_of_another_explain_as_much(monkeypatch):
    made, last = procedure(), node(1.0, 100.0, 2)
    made.record.groups, made.record.hypotheses = [("a",), ("b",)], [{}, {}]
    made.record.findings += [finding("a", 0.5), finding("b", 0.5, step=1)]
    instead, alone = node(1.0, 101.0, 1, nominal=2), node(1.0, 102.0, 0, nominal=2)
    monkeypatch.setattr(revision, "refit_without_effect", lambda one, _k: instead if one is last else alone)
    assert made.revision.simplified([node(30, 9e4), node(20, 4e4, 1), last]) == [alone]
    assert made.record.groups == []
    assert [f.accepted for f in made.record.findings] == [False, False]
