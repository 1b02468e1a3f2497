"""Effects weighed against errors of impacts, with fits that are made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis import procedure as procedure_module
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search import impact_errors as module
from concent_warp.diagnosis.search.impact_errors import stand, with_errors_of_impacts
from tests.diagnosis.made_up import finding, node, procedure


@pytest.mark.parametrize(
    ("ratio", "left", "factor", "stands"),
    [
        (1.0, 960.0, 1.0, True),  # 4 % of the error, and 20 in log likelihood
        (1.0, 981.0, 1.0, False),
        (1.0, 960.0, 1.5, False),  # 8.9, with noise as large as it may be
        (1.0, 870.0, 3.0, True),  # 13 % of the error
        (1.2, 960.0, 1.0, False),  # where more than noise is left, 5 % of the error are needed
        (1.2, 949.0, 1.0, True),
    ],
)
def test_a_small_effect_stands_beside_errors_of_impacts_by_its_likelihood(ratio, left, factor, stands):
    rough, refitted = node(ratio, 1000.0), node(ratio, left, effects=1)
    assert stand(rough, refitted, 1, {"angle": factor}, DiagnoseCfg()) == [stands]


@pytest.mark.parametrize(
    ("family", "gain", "asked"), [("world", 0.1, True), ("world", 0.2, False), ("contact", 0.1, False)]
)
def test_a_small_effect_of_any_family_but_contacts_must_stand_beside_errors_of_impacts(
    monkeypatch, family, gain, asked
):
    made, given, after = procedure(), node(1.05, 1000.0), node(1.0, 900.0, effects=1)
    made.record.findings.append(replace(finding("effect", gain), family=family))
    refitted = []
    monkeypatch.setattr(made, "_refitted", lambda model, _windows: refitted.append(model) or after)
    assert made._stand(given, [given, after], node(1.0, 1000.0))
    assert bool(refitted) is asked


@pytest.mark.parametrize(
    ("family", "ratio", "asked"),
    [("measurement", 1.0, True), ("measurement", 1.2, False), ("contact", 1.0, False)],
)
def test_an_effect_of_any_family_but_contacts_must_stand_where_errors_of_impacts_alone_explain_the_data(
    monkeypatch, family, ratio, asked
):
    made, given, after = procedure(), node(1.2, 1000.0), node(1.0, 700.0, effects=1)
    made.record.findings.append(replace(finding("effect", 0.3), family=family))
    refitted = []
    monkeypatch.setattr(
        made, "_refitted", lambda model, _windows: refitted.append(model) or node(0.98, 990.0, effects=1)
    )
    assert made._stand(given, [given, after], node(ratio, 1000.0)) is not asked
    assert bool(refitted) is asked


@pytest.mark.parametrize(
    ("p", "gain", "found", "answer"),
    [
        (0.0025, 0.06, "wind", "rough"),
        (0.0025, 0.06, "", "given"),
        (0.01, 0.06, "wind", "given"),  # nothing that errors of impacts may hide
        (0.0025, 0.04, "wind", "given"),
    ],
)
def test_what_was_refused_is_looked_for_beside_errors_of_impacts(monkeypatch, p, gain, found, answer):
    made, nodes = procedure(), {"given": node(1.0), "rough": node(1.0), "added": node(0.98, effects=1)}
    monkeypatch.setattr(procedure_module, "has_touchable_free_body", lambda _m: True)
    monkeypatch.setattr(procedure_module, "with_errors_of_impacts", lambda *_: nodes["rough"])

    def search(base):
        if base is nodes["given"]:
            made.record.findings.append(replace(finding("wind", gain, accepted=False), p=p))
            return [base], ("first",)
        if found:
            made.record.findings.append(finding(found, 0.1))
        return [base, *([nodes["added"]] if found else [])], ("second",)

    monkeypatch.setattr(made, "search", search)
    base, fitted, _ = made.search_beside_impacts(nodes["given"])
    assert base is nodes[answer]
    assert fitted == ([nodes["rough"], nodes["added"]] if answer == "rough" else [nodes["given"]])
    assert [f.name for f in made.record.accepted()] == ([found] if answer == "rough" else [])
    assert made.impacts_left is (answer == "rough")


@pytest.mark.parametrize(
    ("gain", "first", "then", "answer"),
    [
        (0.1, True, ("time_base",), "rough"),  # a small one: those errors decide between it and others
        (0.1, True, (), "given"),
        (0.1, True, ("time_base", "wind"), "given"),
        (0.1, False, (), "rough"),  # it does not stand
        (0.2, True, ("time_base",), "given"),
    ],
)
def test_beside_a_small_effect_that_stands_a_single_one_beside_errors_of_impacts_is_the_answer(
    monkeypatch, gain, first, then, answer
):
    made, given, rough = procedure(), node(1.05), node(1.0)
    after = [node(0.98, effects=k + 1) for k in range(2)]
    monkeypatch.setattr(procedure_module, "with_errors_of_impacts", lambda *_: rough)
    monkeypatch.setattr(made, "_stand", lambda *_: first)

    def search(base):
        found = ("length_scale",) if base is given else then
        kept = gain if base is given else 0.1
        made.record.findings += [
            replace(finding(name, kept, step=k), family="measurement") for k, name in enumerate(found)
        ]
        return [base, *after[: len(found)]], ()

    monkeypatch.setattr(made, "search", search)
    base, _, _ = made.search_beside_impacts(given)
    assert base is {"rough": rough, "given": given}[answer]
    assert [f.name for f in made.record.accepted()] == list(then if answer == "rough" else ("length_scale",))


@pytest.mark.parametrize("far", [True, False])
def test_where_what_was_found_leaves_far_more_than_such_errors_there_is_no_second_search(monkeypatch, far):
    made, given, last, rough = procedure(), node(3.0), node(2.0, effects=1), node(2.5)
    for one in (given, last):
        one.fit, one.windows[0].spread = SimpleNamespace(offsets=[np.zeros(2)]), np.ones(2)
        one.engine, one.model.compile = "mujoco", lambda: None
    monkeypatch.setattr(module, "flying_bodies", lambda _m: ["ball"])
    monkeypatch.setattr(module, "without_defects", lambda one: one)
    monkeypatch.setattr(module, "with_scatter", lambda *_: ["scattered"])
    monkeypatch.setattr(module, "_directions", lambda w: int(w == "scattered"))
    monkeypatch.setattr(module, "_followed", lambda *_: [last])

    def refit(model, *_) -> Any:
        return rough if model is given.model else "refitted"

    monkeypatch.setattr(made.context, "is_far_off", lambda one, _first: one is last or (far and one == "refitted"))
    assert with_errors_of_impacts(made.context, given, [given, last], refit) is (None if far else rough)
