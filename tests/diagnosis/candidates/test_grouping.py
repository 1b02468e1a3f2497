"""Which fit of a group is polished and profiled, with fits that are made up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest

from concent_warp.diagnosis.candidates import grouping
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.tasks import TaskRunner
from tests.diagnosis.candidates.made_up_fit import base_of, made

ANY: Any = None


@dataclass(frozen=True)
class Judged:
    """The evidence of a made-up fit."""

    name: str
    accepted: bool
    reason: str


@pytest.mark.parametrize(
    ("windows", "wider", "better"), [(16, True, True), (17, True, False), (16, False, False), (16, True, False)]
)
def test_the_first_of_a_group_is_polished_and_near_equals_get_a_profile(monkeypatch, windows, wider, better):
    done, cfg = [], DiagnoseCfg(jobs=1)
    fits = [made(n, 0.5) for n in "abcde"]
    pairs: Any = [(c, Judged(c.name, True, "")) for c in fits]

    def judge(c: Any) -> Any:
        return Judged(c.name, False, "no")

    def indistinguishable(_base, accepted, _search, slack=1.0):
        done.append(("group", slack, len(accepted)))
        return list(accepted) if slack > 1 and wider else list(accepted)[:2]

    def refine(_base, c, _runner, _cfg):
        done.append(("profile", c.name))
        return replace(c, gain=c.gain + 0.1, std="known")

    def polish(_base, c, _search, *, thorough):
        done.append(("polish", c.name, thorough))
        return replace(c, cost=c.cost - 1.0, std=None) if better else c

    monkeypatch.setattr(grouping, "indistinguishable", indistinguishable)
    monkeypatch.setattr(grouping, "refine_by_profile", refine)
    monkeypatch.setattr(grouping, "polish_candidate", polish)
    group: Any = grouping.group_indistinguishable(
        base_of(windows),
        pairs,
        judge,
        TaskRunner(),
        cfg,
    )
    profiled = wider and windows == 16
    near = [("profile", n) for n in "abc"] if profiled else []
    size = 5 if wider else 2
    assert done == [("group", 1.25, 5), ("group", 1.0, 5), *near, ("group", 1.0, size), ("polish", "a", True)]
    assert [(f.name, f.accepted, f.reason) for _, f in group] == [("a", True, ""), ("b", True, "")]
    assert group[0][0].gain == pytest.approx(0.6 if profiled else 0.5)
    assert group[0][0].std == ("known" if profiled and not better else None)
