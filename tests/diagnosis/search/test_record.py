"""What a search has recorded, as data that are made up."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from concent_warp.diagnosis.search.record import SearchRecord
from tests.diagnosis.made_up import MODEL, finding


def test_a_copy_of_a_record_has_all_of_it_and_does_not_change_with_it():
    made_up: Any = ("rival",), "a shorter time step", ("value",), ["a model"], {0: ("a model", "a fit")}, ("joints",)
    rivals, time_step, values, models, unprofiled, holding = made_up
    record = SearchRecord(
        [finding("a", 0.5)], [("a",)], [{"a": MODEL}], {0: np.ones(1)}, unprofiled, {0: rivals},
        {0: {"b": MODEL}}, time_step, values, 1, True, models, True, holding, 1, True,
    )  # fmt: skip
    assert all(getattr(record, f.name) for f in fields(SearchRecord))
    copied = record.copy()
    assert copied == record
    before = [(f.name, f.accepted) for f in copied.findings], list(copied.groups), dict(copied.rivals)
    record.refuse(lambda _: True, "no better than chance")
    record.findings.append(finding("b", 0.1))
    record.groups[0], record.rivals[1] = ("a", "b"), rivals
    record.hypotheses.append({})
    record.widening[1] = np.ones(2)
    record.unprofiled.pop(0)
    record.with_unestablished.append(models[0])
    assert ([(f.name, f.accepted) for f in copied.findings], copied.groups, copied.rivals) == before
    assert (len(copied.hypotheses), list(copied.widening), copied.with_unestablished) == (1, [0], ["a model"])
    assert copied.unprofiled == {0: ("a model", "a fit")}


def test_an_effect_that_takes_the_place_of_an_accepted_one_is_recorded_once():
    old, new = finding("a", 0.5), finding("b", 0.6)
    record = SearchRecord([old, finding("b", 0.4, accepted=False)], [("a",)], [{}], {0: np.full(1, 3.0)})
    better: Any = type("Candidate", (), {"model": MODEL})()
    record.exchange(old, [(better, new)])
    assert [(f.name, f.accepted) for f in record.findings] == [("a", False), ("b", True)]
    assert (record.groups, record.hypotheses) == ([("b",)], [{"b": MODEL}])
    assert record.accepted() == [new]


def test_what_another_answer_has_in_the_place_of_an_effect_stays_in_its_group_beside_what_is_exchanged():
    old, new = finding("a", 0.5), finding("b", 0.6)
    better: Any = type("Candidate", (), {"model": MODEL})()
    for equal, group in (("c", ("b", "c")), ("b", ("b",))):
        record = SearchRecord([old], [("a",)], [{}], {0: np.full(1, 3.0)}, equals={0: {equal: MODEL}})
        record.exchange(old, [(better, new)])
        assert record.groups == [group]
        assert list(record.hypotheses[0]) == list(group)
