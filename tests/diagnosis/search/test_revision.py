"""What becomes of the accepted effects after a search, with fits that are made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg, NominalCfg, SearchCfg
from concent_warp.diagnosis.search import additions, context, revision
from concent_warp.diagnosis.search.reconsider import Reconsidered, Rival
from concent_warp.simulate.time_limit import TimeUpError
from tests.diagnosis.made_up import CLEAR, FINER, GIVEN, OPEN, finding, interval, node, procedure


def test_time_step_and_nominal_values_are_restored_where_they_explain_no_more_at_the_end(monkeypatch):
    for errors, nominal_errors, timestep, nominal in (
        (104.0, 104.0, GIVEN, 0), (104.0, 120.0, GIVEN, 2), (120.0, 104.0, FINER, 0), (120.0, 120.0, FINER, 2),
    ):  # fmt: skip
        made = procedure()
        made.record.time_step, made.record.findings = "found", [finding("a", 0.5)]
        last = node(1.0, 100.0, effects=1, timestep=FINER, nominal=2)
        monkeypatch.setattr(
            revision,
            "at_given_step",
            lambda one, *_, errors=errors: node(1.0, errors, 1, nominal=len(one.model.effects) - 1),
        )
        monkeypatch.setattr(
            revision,
            "without_nominal_values",
            lambda one, errors=nominal_errors: node(1.0, errors * one.errors.sum() / 100, 1, timestep=one.timestep),
        )
        first = node(3.0)
        after = made.revision.restore_given([first, last], first)
        assert after[0] is first
        assert (after[1].timestep, len(after[1].model.effects) - 1) == (timestep, nominal)
        assert made.record.time_step == ("found" if timestep == FINER else None)
    plain = procedure()
    for name in ("at_given_step", "without_nominal_values"):
        monkeypatch.setattr(revision, name, lambda *_: pytest.fail("nothing to restore"))
    nodes = [node(3), node(1.0, effects=1)]
    assert plain.revision.restore_given(nodes, nodes[0]) == nodes


def test_friction_as_given_is_restored_where_one_that_holds_explains_no_more_at_the_end(monkeypatch):
    for errors, left in ((104.0, ()), (120.0, ("joints",))):
        made, first, last = procedure(), node(3.0), node(1.0, 100.0, effects=1)
        made.record.holding, made.record.findings = ("joints",), [finding("a", 0.5)]
        asked = []
        monkeypatch.setattr(revision, "with_scene", lambda *args, e=errors, a=asked: a.append(args) or node(1.0, e, 1))
        after = made.revision.restore_given([first, last], first)
        assert (after[-1] is last, made.record.holding) == (bool(left), left)
        assert asked == [(last, first.model.scene, made.context.cfg.time_step)]


def test_an_effect_beside_an_error_of_form_stays_if_it_explains_that_or_makes_another_superfluous(monkeypatch):
    # Errors of the model without the first effect; noise ratio with all three.
    # 15.4 % and 14.7 % of what was left beside the noise.
    for errors, ratio, left in ((104.0, 1.0245, 5), (104.0, 1.0235, 5), (200.0, 1.0245, 3), (200.0, 1.0235, 4)):
        made = procedure()
        nodes = [node(50, effects=0), node(7, effects=1), node(1.15, effects=2), node(ratio, 100.0, effects=3)]
        names, reduced = iter("abc"), node(ratio, errors, effects=2)

        def find(_base, step, made=made, nodes=nodes, names=names, **_):
            name = next(names)
            made.record.groups.append((name,))
            made.record.hypotheses.append({})
            made.record.findings.append(finding(name, 0.9, step=step))
            return nodes[step + 1], ()

        monkeypatch.setattr(made.additions.finder, "find", find)
        monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
        monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
        monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
        worse = node(9, 900.0, effects=2)

        def refit(last, k, nodes=nodes, reduced=reduced, worse=worse):
            return reduced if last is nodes[3] and not k else worse

        monkeypatch.setattr(revision, "refit_without_effect", refit)
        fitted, _ = made.additions.add_effects(nodes[:1], ())
        assert fitted == nodes
        after = made.revision.simplified(fitted)
        kept = {5: "bc", 4: "abc", 3: "ab"}[left]
        assert after == ([*nodes, reduced] if left == 5 else nodes[:left])
        assert made.record.groups == [(name,) for name in kept]
        assert [f.name for f in made.record.findings if f.accepted] == list(kept)
        reasons = {f.name: f.reason for f in made.record.findings if not f.accepted}
        assert (
            reasons
            == {
                5: {"a": "made superfluous by effects added later"},
                4: {},
                3: {"c": "explains no more than errors in the formulas of the others"},
            }[left]
        )
        assert len(made.record.hypotheses) == (2 if left == 3 else 3)


def test_a_dropped_addition_leaves_the_effects_that_were_reconsidered_beside_it(monkeypatch):
    made, swapped, left = procedure(), node(1.0, effects=2), node(1.3, effects=1)
    nodes = [node(5.0), node(1.3, effects=1), node(1.2, effects=2)]
    made.record.provisional, made.record.groups, made.record.hypotheses = 1, [("b",), ("c",)], [{}, {}]
    made.record.findings = [finding("b", 0.5), finding("c", 0.2, step=1)]
    monkeypatch.setattr(made.revision, "reconsidered", lambda fitted: [*fitted[:-1], swapped])
    monkeypatch.setattr(made.revision, "remove_superfluous", lambda fitted: fitted)
    asked: list[Any] = []
    monkeypatch.setattr(revision, "refit_without_effect", lambda last, effect: asked.append((last, effect)) or left)
    assert made.revision.simplified(nodes) == [nodes[0], left]
    assert asked == [(swapped, 1)]
    assert [f.name for f in made.record.findings if f.accepted] == ["b"]


def test_profile_likelihoods_of_accepted_effects_are_evaluated_after_the_search(monkeypatch):
    asked: list[Any] = []

    def refine(base, c, runner, cfg, *, restarts):
        asked.append((base, c.name, runner, cfg, restarts))
        if c.name == "late":
            raise TimeUpError
        return SimpleNamespace(name=f"{c.name} refined", fit=SimpleNamespace(cost=c.fit.cost - c.fall))

    monkeypatch.setattr(revision, "refine_by_profile", refine)
    monkeypatch.setattr(revision, "profile_widening", lambda base, c: f"{c.name} at {base}")
    monkeypatch.setattr(revision, "add_candidate", lambda base, c: f"{base} with {c.name}")
    monkeypatch.setattr(revision, "renew_defects", lambda one, _cfg: one)
    first, last = node(5.0, 50.0), node(1.0, 10.0, effects=2)
    for name, fall, fit, left, widths in (
        ("b", 1.0, last.fit, "base b with b refined", {0: "a refined at base a", 1: "b refined at base b"}),
        ("b", 0.0, last.fit, last, {0: "a refined at base a", 1: "b refined at base b"}),
        # Fitted again since, with nominal values say: a lower cost beside the earlier fit is none beside this one.
        ("b", 1.0, SimpleNamespace(cost=11.0), last, {0: "a refined at base a", 1: "b refined at base b"}),
        ("late", 1.0, last.fit, last, {0: "a refined at base a", 1: "late at base b"}),
    ):
        made, asked[:] = procedure(), []
        made.record.findings = [
            finding("a", 0.5),
            finding(name, 0.4, step=1),
            finding("c", 0.1, accepted=False, step=2),
        ]
        fits: Any = [SimpleNamespace(name="a", fit=first.fit, fall=1.0), SimpleNamespace(name=name, fit=fit, fall=fall)]
        made.record.unprofiled = {k: (f"base {n}", c) for k, (n, c) in enumerate(zip("ab", fits, strict=True))}
        made.record.unprofiled[2] = ("base c", "not accepted")
        assert made.revision.profiled([first, last]) == [first, left]
        assert made.record.widening == widths
        shared = made.context.runner, made.context.cfg.profile
        assert asked == [("base a", "a", *shared, False), ("base b", name, *shared, fit is last.fit)]
        late = ["Interval of late from the linear fit, not from its profile likelihood."]
        assert made.context.budget.unsettled == (late if name == "late" else [])


def rivals(*names: str, step: int = 0) -> tuple[Rival, ...]:
    """Return effects that explained nearly as much as each other."""
    added: Any = "added"
    fit: Any = "fit"
    return tuple(Rival(finding(n, 0.5, step=step), added, fit) for n in names)


def test_earlier_additions_are_reconsidered_beside_later_ones(monkeypatch):
    asked: list[Any] = []
    parameters: Any = ("p", "q")
    for winners, accepted, widths in (
        (["b", "c"], ["d", "b"], {0: [1.0, 1.0], 1: [7.0]}),  # another one explains more
        (["a", "c"], ["a", "d"], {0: [7.0], 1: [7.0]}),  # the same one, with another group
        (None, ["a", "d"], {0: [7.0], 1: [7.0]}),
    ):
        made, asked[:] = procedure(), []
        made.record.findings = [
            finding("a", 0.5), finding("b", 0.4, accepted=False, reason="another one explains more"),
            finding("d", 0.3, step=1), finding("b", 0.2, accepted=False, step=1),
        ]  # fmt: skip
        made.record.groups, made.record.hypotheses = [("a",), ("d",)], [{"a": "model a"}, {"d": "model d"}]
        made.record.widening = {0: np.array([7.0]), 1: np.array([7.0])}
        made.record.rivals = {0: rivals("a", "b"), 1: rivals("d", "b", step=1)}
        group: Any = tuple(
            (SimpleNamespace(model=f"model {n}"), replace(finding(n, 0.45), parameters=parameters))
            for n in winners or ()
        )
        other = node(1.0, 90.0, effects=4)
        answer = Reconsidered(other, group) if winners else None

        def answered(*args, answer=answer):
            asked.append(args)
            return answer

        monkeypatch.setattr(revision, "reconsider", answered)
        nodes = [node(5), node(3, effects=3), node(1.0, 100.0, effects=4)]  # two of its own
        after = made.revision.reconsidered(list(nodes))
        assert asked == [
            (nodes[-1], 2, made.record.rivals[0], made.context.cfg)
        ]  # the last one has been compared beside all others
        assert after == ([*nodes[:-1], other] if winners else nodes)
        assert made.record.groups == [tuple(winners or ["a"]), ("d",)]
        assert made.record.hypotheses[0] == {n: f"model {n}" for n in winners or ["a"]}
        assert [f.name for f in made.record.findings if f.accepted] == accepted
        assert {k: w.tolist() for k, w in made.record.widening.items()} == widths
        assert sum(f.name == "b" and f.step == 0 for f in made.record.findings) == 1
        assert [f.accepted for f in made.record.findings if f.name == "b" and f.step == 1] == [False]
        if accepted[-1] == "b":
            replaced = next(f for f in made.record.findings if f.name == "a")
            assert replaced.reason == "another one explains more beside the others"
            assert made.record.findings[-1].parameters == parameters


@pytest.mark.parametrize(
    ("last", "again"),
    [
        ({}, []),
        ({"timestep": FINER}, ["a"]),
        ({"nominal": 2}, ["a"]),
    ],
)
def test_the_last_addition_is_reconsidered_where_time_step_or_nominal_values_came_after_it(monkeypatch, last, again):
    asked: list[Any] = []
    made = procedure()
    made.record.findings, made.record.groups = [finding("a", 0.5)], [("a",)]
    made.record.rivals = {0: rivals(*"ab")}
    monkeypatch.setattr(revision, "reconsider", lambda *args: asked.append(args))
    made.revision.reconsidered([node(5), node(1.0, 100.0, effects=1, **last)])
    assert [args[2][0].finding.name for args in asked] == again
    assert [args[1] for args in asked] == [last.get("nominal", 0)] * len(again)


def test_what_came_before_the_last_addition_is_no_reason_to_reconsider_it(monkeypatch):
    monkeypatch.setattr(revision, "reconsider", lambda *_: pytest.fail("it has been compared beside all others"))
    made = procedure()
    made.record.findings, made.record.rivals = [finding("a", 0.5)], {0: rivals(*"ab")}
    nodes = [node(5, timestep=FINER, nominal=2), node(1.0, 100.0, effects=1, timestep=FINER, nominal=2)]
    assert made.revision.reconsidered(nodes) is nodes


def test_no_more_rivals_are_reconsidered_than_asked_for(monkeypatch):
    asked: list[Any] = []
    made = procedure()
    made.context.cfg = replace(made.context.cfg, search=SearchCfg(reconsidered=2))
    made.record.findings, made.record.rivals = [finding("a", 0.5), finding("d", 0.3, step=1)], {0: rivals(*"abc")}
    monkeypatch.setattr(revision, "reconsider", lambda *args: asked.append(args))
    made.revision.reconsidered([node(5), node(3, effects=3), node(1.0, 100.0, effects=4)])
    assert [r.finding.name for r in asked[0][2]] == ["a", "b"]


def test_an_addition_without_rivals_is_not_reconsidered(monkeypatch):
    monkeypatch.setattr(revision, "reconsider", lambda *_: pytest.fail("there is no rival"))
    made = procedure()
    made.record.findings = [finding("a", 0.5), finding("d", 0.3, step=1)]
    made.record.groups, made.record.hypotheses = [("a",), ("d",)], [{}, {}]
    made.record.rivals = {0: rivals("a"), 1: rivals("d", "b", step=1)}
    nodes = [node(5), node(3, effects=1), node(1.0, 100.0, effects=2)]
    assert made.revision.reconsidered(nodes) is nodes
    made.record.rivals = {}
    assert made.revision.reconsidered(nodes) is nodes


def test_an_effect_that_may_be_at_its_null_values_is_removed_where_the_data_are_explained_without_it():
    for established, ratios, removed in (
        ("c", (1.2, 1.2, 1.2), "b"),  # the one with the smaller gain
        ("bc", (1.2, 1.2, 1.2), "a"),
        ("c", (1.2, 2.4, 1.2), "a"),  # the data need the other one
        ("c", (1.2, 1.9, 1.2), "b"),  # an error in the formulas of the others
        ("c", (2.4, None, 1.2), None),  # there was no time for the model without the other one
        ("abc", (1.0, 1.0, 1.0), None),
    ):
        made, sure = procedure(), [name in established for name in "abc"]
        # Their own intervals, which a rough cost widens, have no say.
        made.record.findings = [
            replace(finding(name, gain, step=step), parameters=(OPEN if is_sure else CLEAR,))
            for name, gain, step, is_sure in zip("abc", (0.5, 0.3, 0.2), (0, 1, 2), sure, strict=True)
        ] + [finding("x", 0.1, accepted=False, reason="no better than chance")]
        made.record.groups = [("a",), ("b", "y"), ("c",)]
        made.record.hypotheses = [{"a": 1}, {}, {"b": 2, "y": 3}, {"c": 4}]  # one was superfluous
        made.context.cfg = replace(made.context.cfg, nominal=NominalCfg(enabled=False))
        fitted = [node(9), node(5, effects=1), node(3, effects=2), node(1.0, effects=3)]
        without = [r and node(r, 1.0, 2) for r in ratios]
        after = made.revision.remove_unestablished(fitted, without, sure)
        if removed is None:
            assert after is None
            assert [f.accepted for f in made.record.findings] == [True] * 3 + [False]
            continue
        assert after == [*fitted, without["abc".index(removed)]]
        dropped = next(f for f in made.record.findings if f.name == removed)
        assert (dropped.accepted, dropped.reason) == (
            False,
            "its parameters may be at their null values beside the others",
        )
        assert [f.name for f in made.record.accepted()] == [name for name in "abc" if name != removed]
        assert made.record.groups == [g for g in (("a",), ("b", "y"), ("c",)) if g[0] != removed]
        assert made.record.hypotheses == [h for h in ({"a": 1}, {"b": 2, "y": 3}, {"c": 4}) if removed not in h]


def test_an_effect_beside_another_is_not_established_without_time_for_errors_of_nominal_values(monkeypatch):
    def late(*_):
        raise TimeUpError

    for errors, sure in ((late, [True, False]), (lambda *_: "nominal", [True, True])):
        made, last = procedure(), node(1.0, effects=2)
        monkeypatch.setattr(made.revision, "_joint", lambda _, last=last: last)
        monkeypatch.setattr(revision, "joint_parameters", lambda *_: [(CLEAR,), (CLEAR,)])
        monkeypatch.setattr(revision, "established_effects", lambda *_: [True, True])
        monkeypatch.setattr(revision, "nominal_errors", errors)
        monkeypatch.setattr(revision, "refit_without_effect", lambda *_: node(1.2, effects=1))
        monkeypatch.setattr(revision, "joint_finding", lambda f, *_: f)
        monkeypatch.setattr(revision, "with_intervals", lambda last, *_: last)
        monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
        made.record.findings = [finding(name, 0.5, step=k) for k, name in enumerate("ab")]
        made.record.groups, made.record.hypotheses = [("a",), ("b",)], [{"a": 1}, {"b": 2}]
        made.record.widening = {0: "wide", 1: "wide"}
        fitted, without, established = made.revision._fitted_together([node(9), last])
        assert established == sure
        made.revision.remove_unestablished(fitted, without, established)
        dropped = made.record.findings[1]
        assert dropped.accepted is sure[1]
        assert dropped.reason == ("" if sure[1] else "there was no time to tell it from errors of nominal values")


def test_an_only_effect_that_may_be_at_its_null_value_leaves_the_model_as_given(monkeypatch):
    for ratio, nominal, left in ((1.2, None, "given"), (1.3, None, None), (1.3, 1.2, "nominal")):
        made, given, reduced = procedure(), node(ratio), node(ratio, 150.0)
        instead = None if nominal is None else node(nominal, 104.0, nominal=1)
        monkeypatch.setattr(context, "with_nominal_values", lambda *_, instead=instead: instead)
        monkeypatch.setattr(context, "stays_within", lambda *_: True)
        made.record.findings = [replace(finding("a", 0.1), parameters=(OPEN,))]
        made.record.groups, made.record.hypotheses = [("a",)], [{"a": 1}]
        after = made.revision.remove_unestablished([given, node(1.0, 100.0, effects=1)], [reduced], [False])
        # Beside no other effect, more than noise is no error of form.
        assert after == {"given": [given], "nominal": [instead], None: None}[left]
        assert made.record.groups == ([] if left else [("a",)])
        reason = "its parameters may be at their null values" if left else ""
        assert [(f.accepted, f.reason) for f in made.record.findings] == [(not left, reason)]


def test_effects_are_established_by_intervals_that_the_profile_likelihood_does_not_widen(monkeypatch):
    narrow = [(CLEAR,), (OPEN,), (OPEN, CLEAR), (interval(0.5, np.inf),), (OPEN, OPEN)]
    wide, asked = [(CLEAR,), *[(OPEN,)] * 4], []

    def intervals(last, widening, nominal):
        asked.append((last, widening, nominal))
        return narrow if widening is None else wide

    def any_excludes(_last, parameters, share, widening, nominal):
        assert (share, widening, nominal) == (DiagnoseCfg().search.dependent_share, None, "nominal")
        return [any(p.excludes_null for p in group) for group in parameters]

    made, last = procedure(), node(1.0, effects=5)  # one effect of its own, four added
    monkeypatch.setattr(made.revision, "_joint", lambda _: last)
    monkeypatch.setattr(revision, "joint_parameters", intervals)
    monkeypatch.setattr(revision, "established_effects", any_excludes)
    monkeypatch.setattr(revision, "nominal_errors", lambda *_: "nominal")
    monkeypatch.setattr(revision, "refit_without_effect", lambda _, k: f"without {k}")
    monkeypatch.setattr(revision, "joint_finding", lambda f, parameters, *_: replace(f, parameters=parameters))
    monkeypatch.setattr(revision, "with_intervals", lambda _, parameters, *__: parameters)
    made.record.findings = [finding(name, 0.5, step=k) for k, name in enumerate("abcd")]
    made.record.widening = {k: f"width of {k}" for k in range(4)}
    found, without, established = made.revision._fitted_together(["given", "all"])
    # One parameter is enough; a limit that is infinite by default and finite here excludes it.
    assert established == [False, True, True, False]
    assert without == [f"without {k}" for k in range(1, 5)]
    # What the answer states has the wider intervals.
    assert found == ["given", wide]
    assert [f.parameters for f in made.record.findings] == wide[1:]
    assert asked == [(last, {k + 1: f"width of {k}" for k in range(4)}, "nominal"), (last, None, "nominal")]
    assert procedure().revision._fitted_together([node(1.0)])[1:] == ([], [])
