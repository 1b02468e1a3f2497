"""Searches whose time ends after some candidates of an addition are fitted, with fits that are made up."""

from __future__ import annotations

from typing import Any

import pytest

from concent_warp.diagnosis.candidates import fit_promising
from concent_warp.diagnosis.search import additions, context
from concent_warp.simulate.time_limit import TimeUpError
from tests.diagnosis.candidates.made_up_fit import made
from tests.diagnosis.candidates.test_choices import fits_of, screened
from tests.diagnosis.made_up import finding, force_is, node, procedure


def test_parts_that_there_is_no_time_to_fit_leave_the_fits_of_the_others(monkeypatch):
    def fit(_base: Any, candidate: Any) -> Any:
        if candidate.name != "whole":
            raise TimeUpError
        return made("whole", 0.9, ratio=1.05)

    monkeypatch.setattr(fit_promising, "fit_candidate", fit)
    search = fits_of([])
    whole = search._fit_in_batches([screened("whole", 0.8)])
    assert search._fit_in_batches([screened("part", 0.7), screened("poor part", 0.2)]) == []
    assert [c.name for c in search.fits] == ["whole"]
    assert [s.name for s in whole] == ["whole"]
    assert [s.name for s in search.left] == ["part"]  # the poor one promises too little beside the fitted one


@pytest.mark.parametrize("in_time", [True, False])
def test_an_effect_found_as_the_time_ends_is_added_with_the_errors_of_the_time_step_as_they_were(monkeypatch, in_time):
    first, best, renewed = node(3.0), node(1.0, effects=1), node(1.0, effects=1)

    def find(_base: Any, step: int, **_: Any) -> Any:
        search.record.groups.append(("drag",))
        search.record.findings.append(finding("drag", 0.6, step=step))
        return best, ()

    def renew(*_: Any) -> Any:
        if not in_time:
            raise TimeUpError
        return renewed

    search = procedure()
    monkeypatch.setattr(search.additions.finder, "find", find)
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, one: one)
    monkeypatch.setattr(additions, "renew_defects", renew)
    fitted, _ = search.additions.add_effects([first], ())
    assert fitted[-1] is (renewed if in_time else best)
    said = ["Not computed again beside the last effect: what a shorter time step changes."]
    assert search.context.budget.unsettled == ([] if in_time else said)


@pytest.mark.parametrize(
    ("late", "said"),
    [
        ("_failures", "Left out: where the model as given fails."),
        ("_suggested_experiment", "Left out: the next experiment."),
        ("_replayed", "Left out: a replay in one piece."),
    ],
)
def test_only_what_was_left_out_is_said_to_be(monkeypatch, late, said):
    force_is(monkeypatch, lambda *_: None)

    def no_time(*_: Any) -> Any:
        raise TimeUpError

    search = procedure(explain=True)
    search.record.findings, search.record.groups = [finding("drag", 0.6)], [("drag",)]
    done: dict[str, Any] = {"_failures": (), "_suggested_experiment": None, "_replayed": None}
    for name, result in done.items():
        monkeypatch.setattr(search, name, no_time if name == late else lambda *_, result=result: result)
    found = search.conclude(node(3.0), [node(3.0), node(1.0, effects=1)], (), [])
    assert found.unsettled == (said,)
