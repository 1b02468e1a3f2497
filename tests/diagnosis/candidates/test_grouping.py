"""Which fit of a group is polished and profiled, with fits that are made up."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates import grouping
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.tasks import TaskRunner
from tests.diagnosis.candidates.made_up_fit import base_of, made
from tests.diagnosis.made_up import finding

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


@dataclass(frozen=True)
class Left:
    """A fit or a baseline of which that is left."""

    name: str
    gain: float
    errors: np.ndarray = field(default_factory=lambda: np.ones(2), compare=False)
    ratio: float = 2.0
    noise_scale: float = 1.0
    pieces: Any = field(default_factory=lambda: [SimpleNamespace(residual=np.ones(50))])
    effect: Any = field(default_factory=lambda: SimpleNamespace(name="effect"))

    def share(self, base: Any) -> float:
        """Return the share of the baseline's error that is gone."""
        return 1 - float(self.errors.sum() / base.errors.sum())


def test_candidates_are_compared_by_other_errors_than_their_own_where_these_are_given(monkeypatch):
    first, second, third = fits = [Left(n, gain) for n, gain in (("a", 0.9), ("b", 0.6), ("c", 0.5))]
    base, seen = Left("base", 0.0), []
    # Beside something else the second explains most, and the third nearly as much.
    left = {id(base): 1.0, id(first): 0.8, id(second): 0.1, id(third): 0.12}

    def indistinguishable(against, pairs, _search, _slack=1.0):
        seen.append([(c.name, float(c.errors.sum()), round(f.gain, 2), c.ratio) for c, f in pairs])
        assert against.errors.sum() == 1.0
        return sorted(pairs, key=lambda pair: -pair[1].gain)[:1]

    monkeypatch.setattr(Left, "windows", (), raising=False)

    def at_noise(against, group, pairs, _search):
        assert against.errors.sum() == 1.0
        return [*group, next(pair for pair in pairs if pair[0].name == "c")]

    monkeypatch.setattr(grouping, "indistinguishable", indistinguishable)
    monkeypatch.setattr(grouping, "equal_at_noise", at_noise)
    monkeypatch.setattr(grouping, "polish_candidate", lambda _base, c, _search, **_: c)

    def judged(c: Any) -> Any:
        return finding(c.name, c.gain)

    pairs: Any = [(c, judged(c)) for c in fits]
    given: Any = base
    group: Any = grouping.group_indistinguishable(
        given, pairs, judged, TaskRunner(), DiagnoseCfg(jobs=1), compare=lambda one: np.full(2, left[id(one)] / 2)
    )
    assert [(c, f.gain) for c, f in group] == [(second, 0.6), (third, 0.5)]  # the evidence stays what it was
    assert [entry[:3] for entry in seen[0]] == [("a", 0.8, 0.2), ("b", 0.1, 0.9), ("c", 0.12, 0.88)]
    assert seen[0][1][3] == pytest.approx(np.sqrt(0.1 / 50))
