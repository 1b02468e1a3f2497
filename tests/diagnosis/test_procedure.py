"""The procedure of a diagnosis step by step, with fits that are made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis import procedure as module
from concent_warp.diagnosis.cfg import DiagnoseCfg, NominalCfg
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import Finding, UnknownForceFound
from concent_warp.diagnosis.search.adequacy import discrepancies, is_adequate, is_lacking
from concent_warp.diagnosis.search.reconsider import Reconsidered, Rival
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.intervals import FittedParameter
from concent_warp.simulate.time_limit import TimeUpError
from tests.scenes.swinging import drawing, swung, windows_of

RECORDING = swung(seconds=0.5)
MODEL = drawing(RECORDING)


def finding(name: str, gain: float, *, accepted: bool = True, step: int = 0, reason: str = "") -> Finding:
    """Return the evidence of an effect."""
    return Finding(name, (), "", (), gain, gain, gain, 0.0, 0.0, accepted, step, (), reason)


GIVEN, FINER = 0.01, 0.002
"""Time step of the model as given and a shorter one [s]."""


def node(
    ratio: float, errors: float = 1.0, effects: int = 0, name: str = "", timestep: float = GIVEN, nominal: int = 0
) -> Any:
    """Return a fitted model: some nominal values come before its effects."""
    added = [
        SimpleNamespace(effect=SimpleNamespace(nominal=k < nominal, variables=())) for k in range(nominal + effects)
    ]
    model = SimpleNamespace(effects=added, name=name)
    # Residuals of one size, beyond the limit of the robust loss nowhere.
    piece = SimpleNamespace(residual=np.full(4, float(ratio)))
    window = SimpleNamespace(readings=[SimpleNamespace(channel="angle", rows=slice(0, 4))], defect=None)
    return SimpleNamespace(
        ratio=ratio, noise_ratio=10 * ratio, errors=np.array([errors / 2] * 2), model=model, windows=[window],
        fit=SimpleNamespace(offsets="o", cost=errors), pieces=[piece], cfg=EffectSolverCfg(), timestep=timestep,
        limit=1e9, noise_scale=1.0,
        delivered=SimpleNamespace(name=f"delivered {name}", timestep=timestep),
    )  # fmt: skip


def procedure(**changes: Any) -> Any:
    """Return a procedure, with settings."""
    made = Procedure(MODEL, RECORDING, replace(DiagnoseCfg(jobs=1, explain=False), **changes))
    made.seen = []  # pyright: ignore[reportAttributeAccessIssue]
    made.runner = TaskRunner(1, lambda share, text: made.seen.append((share, text)))  # pyright: ignore
    return made


def test_effects_are_added_until_none_is_accepted_or_little_is_left(monkeypatch):
    for ratios, answers, count, provisional in (
        ((3.0, 2.0, 1.5, 1.4), 9, 4, None),
        ((3.0, 2.0), 1, 2, None),
        ((1.27, 1.0246), 9, 2, None),
        ((1.27, 1.0248, 1.0), 9, 3, None),
        ((3.0, 1.24, 1.0), 9, 3, 1),  # adequate, but 7 % of the discrepancy is left: one more is tried
        ((2.4, 1.24, 1.0), 9, 3, None),
        ((5.0, 1.26, 1.0), 9, 3, 1),
        ((5.0, 1.26, 1.24, 1.0), 9, 3, 1),
        ((5.0, 4.0, 1.24, 1.0), 9, 4, 2),  # adequate after two: one may be superfluous
        ((19.0, 2.01, 2.0, 1.8), 9, 4, 2),  # beyond twice the noise it is no error of form
        ((5.0, 1.26), 1, 2, 1),
        ((1.0, 1.0), 9, 2, None),
    ):
        made, asked = procedure(), []
        nodes = [node(r) for r in ratios]

        def find(base, step, *, asked=asked, answers=answers, nodes=nodes, made=made, **_):
            asked.append((step, base, made.runner.share))
            return (nodes[step + 1] if step < answers else None), (f"size {step}",)

        concluded, renewed = [], []
        monkeypatch.setattr(made, "baseline", lambda nodes=nodes: nodes[0])
        monkeypatch.setattr(made, "find_addition", find)
        monkeypatch.setattr(module, "finer_time_step", lambda *_: None)
        monkeypatch.setattr(module, "with_nominal_values", lambda *_: None)
        monkeypatch.setattr(module, "add_candidate", lambda _base, best: best)
        monkeypatch.setattr(module, "renew_defects", lambda one, cfg, seen=renewed: seen.append((one, cfg)) or one)
        monkeypatch.setattr(made, "simplified", lambda fitted: fitted)
        monkeypatch.setattr(made, "restore_given", lambda fitted, _given: fitted)
        monkeypatch.setattr(made, "final_values", lambda fitted: fitted)
        monkeypatch.setattr(made, "conclude", lambda *args, concluded=concluded: concluded.append(args))
        made.run()
        ((given, fitted, detectable, issues),) = concluded
        assert given is nodes[0]
        assert fitted == nodes[:count]
        assert made.provisional == provisional
        assert renewed == [(one, made.cfg.time_step) for one in nodes[1:count]]
        assert detectable == ("size 0",)
        assert issues == []
        assert [a[1] for a in asked] == nodes[: len(asked)]
        assert [a[2] for a in asked] == pytest.approx([0.1 + 0.85 * k / 3 for k in range(len(asked))])
        assert made.seen[0] == (0.0, "cutting windows")
        assert made.seen[-1] == (1.0, "done")


def test_noise_that_may_be_larger_than_its_estimate_ends_the_search(monkeypatch):
    monkeypatch.setattr(module, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(module, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(module, "add_candidate", lambda _base, best: best)
    for ratios, factor, count in (
        ((3.0, 1.53, 1.0), 1.5, 2),  # 1.02 x the largest noise
        ((3.0, 1.55, 1.0), 1.5, 3),
        ((3.0, 1.53, 1.0), 1.0, 3),
        ((5.0, 1.26, 1.0), 1.01, 3),  # adequate beside it, but more than the noise may be
        ((1.5, 1.0), 1.5, 2),
    ):
        made, nodes = procedure(), [node(r) for r in ratios]
        made.noise_factors = {"angle": factor}
        monkeypatch.setattr(made, "find_addition", lambda _base, step, nodes=nodes, **_: (nodes[step + 1], ()))
        assert made.add_effects(nodes[:1], ())[0] == nodes[:count]
        assert is_lacking(node(1.02 * factor), made.noise_factors, made.cfg) is False
        assert is_lacking(node(1.03 * factor), made.noise_factors, made.cfg)


@pytest.mark.parametrize(
    ("corrected", "explains_more", "added", "form"),
    [
        (None, False, True, False),  # no formula to correct
        (0.5, True, True, False),
        (0.5, False, False, True),  # 1.3 x noise becomes 0.92
        (0.8, False, False, False),  # 1.16
    ],
)
def test_an_effect_beside_others_must_explain_more_than_a_correction_of_these(
    monkeypatch, corrected, explains_more, added, form
):
    made, nodes = procedure(), [node(3.0), node(1.3, effects=1), node(1.0, effects=2)]

    def find(_base, step, **_):
        made.groups.append((f"effect {step}",))
        made.hypotheses.append({})
        made.findings.append(finding(f"effect {step}", 0.6, accepted=True, step=step))
        return nodes[step + 1], ()

    monkeypatch.setattr(module, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(module, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(module, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(module, "renew_defects", lambda one, _cfg: one)
    monkeypatch.setattr(module, "with_interleaved_folds", lambda one: one)
    monkeypatch.setattr(made, "find_addition", find)
    errors = None if corrected is None else np.array([corrected / 2] * 2)
    monkeypatch.setattr(made, "_correction", lambda one, _first: None if one is nodes[0] else errors)
    monkeypatch.setattr(made, "_explains_more", lambda *_: explains_more)
    assert made.add_effects(nodes[:1], ())[0] == nodes[: 2 + added]
    assert made.form_corrected is form
    assert made.groups == [("effect 0",), ("effect 1",)][: 1 + added]
    first, second = made.findings
    assert first.accepted
    assert second.accepted is added
    assert second.reason == ("" if added else "explains no more than a flexible correction of the effects before it")


def test_a_force_in_the_variables_of_a_corrected_formula_is_its_error(monkeypatch):
    force = UnknownForceFound("a force", 0.3, 0.01, 0.2, None)
    monkeypatch.setattr(module, "unknown_force", lambda *_: force)
    for corrected, most, verdict in (
        (True, 0.25, "effect"),
        (True, 0.15, "none_of_these"),
        (False, 0.25, "none_of_these"),
    ):
        made = procedure(max_form_error=most)
        made.form_corrected = corrected
        made.findings, made.groups = [finding("effect", 0.6, accepted=True)], [("effect",)]
        found = made.conclude(node(3.0), [node(3.0), node(1.2, effects=1)], (), [])
        assert found.verdict == verdict
        assert (found.form_error is not None) is (verdict == "effect")


def test_a_shorter_time_step_is_used_where_no_effect_explains_more(monkeypatch):
    given, effect = node(3.0, 100.0), node(1.5, 40.0, effects=1)
    for errors, ratio, asked, left in (
        (35.0, 1.01, 0, [FINER]),  # it leaves nothing to explain
        (35.0, 1.4, 2, [FINER, "effect"]),  # more than the effect: the search goes on with it
        (40.7, 1.6, 2, [FINER, "effect"]),  # nearly as much as the effect
        (41.0, 1.6, 1, [GIVEN, "effect"]),  # less than the effect
    ):
        made, finer, calls = procedure(max_additions=1), node(ratio, errors, timestep=FINER), []
        rivals = {id(given): finer}

        def find(base, step, calls=calls, made=made, **_):
            calls.append(base)
            made.groups.append(("effect",))
            made.findings.append(finding("effect", 0.6, step=step))
            return effect, ()

        monkeypatch.setattr(made, "find_addition", find)
        monkeypatch.setattr(module, "finer_time_step", lambda one, _cfg, rivals=rivals: rivals.get(id(one)))
        monkeypatch.setattr(module, "with_nominal_values", lambda *_: None)
        monkeypatch.setattr(module, "time_step_finding", lambda *_: "found")
        monkeypatch.setattr(module, "add_candidate", lambda _base, best: best)
        fitted, _ = made.add_effects([given], ())
        assert len(calls) == asked
        assert [("effect" if one is effect else one.timestep) for one in fitted] == left
        assert made.groups == [("effect",)] * (len(fitted) - 1)
        assert len(made.findings) == len(fitted) - 1
        assert made.time_step == ("found" if left[0] == FINER else None)


def test_a_shorter_time_step_after_an_effect_may_make_it_superfluous(monkeypatch):
    made = procedure()
    made.groups, made.hypotheses, made.findings = [("a",)], [{}], [finding("a", 0.5)]
    monkeypatch.setattr(module, "refit_without_effect", lambda *_: node(1.0, 104.0, timestep=FINER))
    fitted = made.remove_superfluous([node(3), node(1.0, 100.0, effects=1, timestep=FINER)])
    assert len(fitted) == 3
    assert not made.groups
    assert not made.findings[0].accepted
    kept = procedure()
    kept.groups, kept.hypotheses, kept.findings = [("a",)], [{}], [finding("a", 0.5)]
    monkeypatch.setattr(module, "refit_without_effect", lambda *_: pytest.fail("nothing has changed beside the effect"))
    nodes = [node(3), node(1.0, 100.0, effects=1)]
    assert kept.remove_superfluous(nodes) is nodes


def test_over_short_windows_time_step_and_nominal_values_stay_as_given(monkeypatch):
    monkeypatch.setattr(module, "finer_time_step", lambda *_: pytest.fail("a shorter time step is tried"))
    monkeypatch.setattr(module, "with_nominal_values", lambda *_: pytest.fail("nominal values are fitted"))
    monkeypatch.setattr(module, "add_candidate", lambda _base, best: best)
    made, coarse, given = procedure(), [node(5.0), node(3.0), node(2.0)], node(30.0)
    monkeypatch.setattr(
        made, "find_addition", lambda _base, step, **_: (coarse[step + 1] if step < 2 else None, ("size",))
    )
    assert made.add_effects(coarse[:1], (), effects_alone=True) == (coarse, ("size",))
    asked: list[Any] = []

    def add(fitted, detectable, *, effects_alone=False):
        asked.append((fitted, detectable, effects_alone))
        return (coarse if effects_alone else ["long"]), (("size",) if effects_alone else ("other",))

    monkeypatch.setattr(made, "add_effects", add)
    monkeypatch.setattr(made, "coarse_baseline", lambda _given: coarse[0])
    monkeypatch.setattr(made, "carry_over", lambda base, found: [base, *found[1:]])
    assert made.search(given) == (["long"], ("size",))
    assert asked == [([coarse[0]], (), True), ([given, *coarse[1:]], ("size",), False)]


def test_nominal_values_are_fitted_with_the_shorter_time_step_where_both_explain_more(monkeypatch):
    given, finer = node(3.0, 100.0), node(2.0, 60.0, timestep=FINER)
    both, plain = node(1.0, 30.0, timestep=FINER, nominal=2), node(1.01, 30.0, nominal=1)
    monkeypatch.setattr(module, "finer_time_step", lambda one, _cfg: finer if one is given else None)
    monkeypatch.setattr(module, "time_step_finding", lambda base, one, seed: (base, one, seed))
    for answers, left, changed in (
        ({id(finer): both, id(given): plain}, both, True),
        ({id(given): plain}, plain, False),
        ({}, given, False),
    ):
        made = procedure(seed=5)
        monkeypatch.setattr(module, "with_nominal_values", lambda one, *_, answers=answers: answers.get(id(one)))
        monkeypatch.setattr(made, "find_addition", lambda *_, **_k: (None, ()))
        fitted, _ = made.add_effects([given], ())
        if answers:
            assert fitted == [left]
            assert made.time_step == ((given, finer, 5) if changed else None)
        else:  # then the shorter time step alone is the rival of the effects, of which none was accepted
            assert fitted == [finer]
    disabled = procedure(nominal=NominalCfg(enabled=False))
    monkeypatch.setattr(module, "with_nominal_values", lambda *_: pytest.fail("nominal values stay as given"))
    assert disabled._with_nominal([given], finer, given) is None


def test_time_step_and_nominal_values_are_restored_where_they_explain_no_more_at_the_end(monkeypatch):
    for errors, nominal_errors, timestep, nominal in (
        (104.0, 104.0, GIVEN, 0), (104.0, 120.0, GIVEN, 2), (120.0, 104.0, FINER, 0), (120.0, 120.0, FINER, 2),
    ):  # fmt: skip
        made = procedure()
        made.time_step, made.findings = "found", [finding("a", 0.5)]
        last = node(1.0, 100.0, effects=1, timestep=FINER, nominal=2)
        monkeypatch.setattr(
            module, "at_given_step", lambda one, errors=errors: node(1.0, errors, 1, nominal=len(one.model.effects) - 1)
        )
        monkeypatch.setattr(
            module,
            "without_nominal_values",
            lambda one, errors=nominal_errors: node(1.0, errors * one.errors.sum() / 100, 1, timestep=one.timestep),
        )
        first = node(3.0)
        after = made.restore_given([first, last], first)
        assert after[0] is first
        assert (after[1].timestep, len(after[1].model.effects) - 1) == (timestep, nominal)
        assert made.time_step == ("found" if timestep == FINER else None)
    plain = procedure()
    for name in ("at_given_step", "without_nominal_values"):
        monkeypatch.setattr(module, name, lambda *_: pytest.fail("nothing to restore"))
    nodes = [node(3), node(1.0, effects=1)]
    assert plain.restore_given(nodes, nodes[0]) == nodes


def test_the_answer_starts_with_the_model_as_given(monkeypatch):
    monkeypatch.setattr(module, "unknown_force", lambda *_: None)
    given, finer, added = node(3.0), node(1.2, timestep=FINER), node(1.0, timestep=FINER, effects=1)
    found = procedure().conclude(given, [finer, added], (), ())
    assert found.ratio == (30.0, 12.0, 10.0)
    assert found.models == (given.model, finer.delivered, added.delivered)
    assert procedure().conclude(given, [given], (), ()).ratio == (30.0,)


def test_an_effect_beside_an_error_of_form_stays_if_it_explains_that_or_makes_another_superfluous(monkeypatch):
    # Errors of the model without the first effect; noise ratio with all three.
    # 15.4 % and 14.7 % of what was left beside the noise.
    for errors, ratio, left in ((104.0, 1.0245, 5), (104.0, 1.0235, 5), (200.0, 1.0245, 3), (200.0, 1.0235, 4)):
        made = procedure()
        nodes = [node(50, effects=0), node(7, effects=1), node(1.15, effects=2), node(ratio, 100.0, effects=3)]
        names, reduced = iter("abc"), node(ratio, errors, effects=2)

        def find(_base, step, made=made, nodes=nodes, names=names, **_):
            name = next(names)
            made.groups.append((name,))
            made.hypotheses.append({})
            made.findings.append(finding(name, 0.9, step=step))
            return nodes[step + 1], ()

        monkeypatch.setattr(made, "find_addition", find)
        monkeypatch.setattr(module, "finer_time_step", lambda *_: None)
        monkeypatch.setattr(module, "with_nominal_values", lambda *_: None)
        monkeypatch.setattr(module, "add_candidate", lambda _base, best: best)
        worse = node(9, 900.0, effects=2)

        def refit(last, k, nodes=nodes, reduced=reduced, worse=worse):
            return reduced if last is nodes[3] and not k else worse

        monkeypatch.setattr(module, "refit_without_effect", refit)
        fitted, _ = made.add_effects(nodes[:1], ())
        assert fitted == nodes
        after = made.simplified(fitted)
        kept = {5: "bc", 4: "abc", 3: "ab"}[left]
        assert after == ([*nodes, reduced] if left == 5 else nodes[:left])
        assert made.groups == [(name,) for name in kept]
        assert [f.name for f in made.findings if f.accepted] == list(kept)
        reasons = {f.name: f.reason for f in made.findings if not f.accepted}
        assert (
            reasons
            == {
                5: {"a": "made superfluous by effects added later"},
                4: {},
                3: {"c": "explains no more than errors in the formulas of the others"},
            }[left]
        )
        assert len(made.hypotheses) == (2 if left == 3 else 3)


def test_over_short_windows_no_further_effect_is_tried_on_an_error_of_form(monkeypatch):
    monkeypatch.setattr(module, "add_candidate", lambda _base, best: best)
    made, coarse = procedure(), [node(5.0), node(1.26), node(1.0)]
    monkeypatch.setattr(made, "find_addition", lambda _base, step, **_: (coarse[step + 1], ()))
    assert made.add_effects(coarse[:1], (), effects_alone=True) == (coarse[:2], ())
    assert made.provisional is None


def test_a_dropped_addition_leaves_the_effects_that_were_reconsidered_beside_it(monkeypatch):
    made, swapped, left = procedure(), node(1.0, effects=2), node(1.3, effects=1)
    nodes = [node(5.0), node(1.3, effects=1), node(1.2, effects=2)]
    made.provisional, made.groups, made.hypotheses = 1, [("b",), ("c",)], [{}, {}]
    made.findings = [finding("b", 0.5), finding("c", 0.2, step=1)]
    monkeypatch.setattr(made, "reconsidered", lambda fitted: [*fitted[:-1], swapped])
    monkeypatch.setattr(made, "remove_superfluous", lambda fitted: fitted)
    asked: list[Any] = []
    monkeypatch.setattr(module, "refit_without_effect", lambda last, effect: asked.append((last, effect)) or left)
    assert made.simplified(nodes) == [nodes[0], left]
    assert asked == [(swapped, 1)]
    assert [f.name for f in made.findings if f.accepted] == ["b"]


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
        made.findings = [
            finding("a", 0.5), finding("b", 0.4, accepted=False, reason="another one explains more"),
            finding("d", 0.3, step=1), finding("b", 0.2, accepted=False, step=1),
        ]  # fmt: skip
        made.groups, made.hypotheses = [("a",), ("d",)], [{"a": "model a"}, {"d": "model d"}]
        made.widening = {0: np.array([7.0]), 1: np.array([7.0])}
        made.rivals = {0: rivals("a", "b"), 1: rivals("d", "b", step=1)}
        group: Any = tuple(
            (SimpleNamespace(model=f"model {n}"), replace(finding(n, 0.45), parameters=parameters))
            for n in winners or ()
        )
        other = node(1.0, 90.0, effects=4)
        answer = Reconsidered(other, group) if winners else None

        def answered(*args, answer=answer):
            asked.append(args)
            return answer

        monkeypatch.setattr(module, "reconsider", answered)
        nodes = [node(5), node(3, effects=3), node(1.0, 100.0, effects=4)]  # two of its own
        after = made.reconsidered(list(nodes))
        assert asked == [(nodes[-1], 2, made.rivals[0], made.cfg)]  # the last one has been compared beside all others
        assert after == ([*nodes[:-1], other] if winners else nodes)
        assert made.groups == [tuple(winners or ["a"]), ("d",)]
        assert made.hypotheses[0] == {n: f"model {n}" for n in winners or ["a"]}
        assert [f.name for f in made.findings if f.accepted] == accepted
        assert {k: w.tolist() for k, w in made.widening.items()} == widths
        assert sum(f.name == "b" and f.step == 0 for f in made.findings) == 1
        assert [f.accepted for f in made.findings if f.name == "b" and f.step == 1] == [False]
        if accepted[-1] == "b":
            replaced = next(f for f in made.findings if f.name == "a")
            assert replaced.reason == "another one explains more beside the others"
            assert made.findings[-1].parameters == parameters


def test_an_addition_without_rivals_is_not_reconsidered(monkeypatch):
    monkeypatch.setattr(module, "reconsider", lambda *_: pytest.fail("there is no rival"))
    made = procedure()
    made.findings = [finding("a", 0.5), finding("d", 0.3, step=1)]
    made.groups, made.hypotheses = [("a",), ("d",)], [{}, {}]
    made.rivals = {0: rivals("a"), 1: rivals("d", "b", step=1)}
    nodes = [node(5), node(3, effects=1), node(1.0, 100.0, effects=2)]
    assert made.reconsidered(nodes) is nodes
    made.rivals = {}
    assert made.reconsidered(nodes) is nodes


def test_superfluous_effects_are_removed_the_least_needed_first(monkeypatch):
    made = procedure()
    fitted = [node(3), node(2), node(1.5), node(1.1, 100.0, effects=5)]  # two of its own, three added
    made.groups = [("a", "b"), ("c",), ("d",)]
    made.hypotheses = [{"a": 1}, {"c": 2}, {"d": 3}]
    made.findings = [finding("a", 0.5, step=0), finding("c", 0.4, step=1), finding("d", 0.3, step=2)]
    made.findings.append(finding("x", 0.1, step=1, accepted=False, reason="no better than chance"))
    left: dict[tuple[int, ...], Any] = {
        (5, 2): node(1.2, 120.0, 4), (5, 3): node(1.2, 104.0, 4), (4, 2): node(1.3, 110.0, 3),
    }  # fmt: skip
    asked = []

    def without(last, effect):
        asked.append((len(last.model.effects), effect))
        return left[len(last.model.effects), effect]

    monkeypatch.setattr(module, "refit_without_effect", without)
    monkeypatch.setattr(module, "with_nominal_values", lambda *_: None)
    after = made.remove_superfluous(list(fitted))
    assert asked == [(5, 2), (5, 3), (4, 2)]
    assert after == [*fitted, left[5, 3]]
    assert made.groups == [("a", "b"), ("d",)]
    assert made.hypotheses == [{"a": 1}, {}, {"d": 3}]
    assert [(f.name, f.accepted, f.reason) for f in made.findings] == [
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
        made.groups, made.hypotheses = [("a",), ("b",)], [{}, {}]
        monkeypatch.setattr(module, "refit_without_effect", lambda *_, reduced=reduced: reduced)
        monkeypatch.setattr(module, "with_nominal_values", lambda *_: None)
        after = made.remove_superfluous([node(3), node(2), node(1.1, 100.0, 2)])
        assert (len(after) == 3) == kept
        assert made.groups == ([("a",), ("b",)] if kept else [("b",)])
    alone = procedure()
    monkeypatch.setattr(module, "refit_without_effect", lambda *_: pytest.fail("nothing to remove"))
    nodes = [node(3), node(2)]
    assert alone.remove_superfluous(nodes) is nodes


def test_an_effect_is_superfluous_where_nominal_values_explain_as_much(monkeypatch):
    for errors, found, dropped in ((150.0, 104.0, True), (150.0, 106.0, False), (104.0, None, True)):
        made, last = procedure(), node(1.1, 100.0, 2)
        reduced, instead = node(1.3, errors, 1), None if found is None else node(1.12, found, 1, nominal=2)
        made.groups, made.hypotheses = [("a",), ("b",)], [{}, {}]
        monkeypatch.setattr(module, "refit_without_effect", lambda *_, reduced=reduced: reduced)

        def nominal(one, *_, reduced=reduced, instead=instead):
            assert one is reduced
            return instead if instead is not None else pytest.fail("the effect is superfluous without them")

        monkeypatch.setattr(module, "with_nominal_values", nominal)
        after = made.remove_superfluous([node(3), node(2), last])
        assert made.groups == ([("b",)] if dropped else [("a",), ("b",)])
        assert after[-1] is (last if not dropped else reduced if instead is None else instead)


def interval(low: float, null: float = 0.0) -> FittedParameter:
    """Return a parameter of value 1 with the lower end of its interval."""
    return FittedParameter("size", 1.0, low, 2.0, "", null)


OPEN, CLEAR = interval(-0.1), interval(0.1)
"""A parameter whose interval includes its null value, and one whose interval does not."""


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
        made.findings = [
            replace(finding(name, gain, step=step), parameters=(OPEN if is_sure else CLEAR,))
            for name, gain, step, is_sure in zip("abc", (0.5, 0.3, 0.2), (0, 1, 2), sure, strict=True)
        ] + [finding("x", 0.1, accepted=False, reason="no better than chance")]
        made.groups = [("a",), ("b", "y"), ("c",)]
        made.hypotheses = [{"a": 1}, {}, {"b": 2, "y": 3}, {"c": 4}]  # one was superfluous
        made.cfg = replace(made.cfg, nominal=NominalCfg(enabled=False))
        fitted = [node(9), node(5, effects=1), node(3, effects=2), node(1.0, effects=3)]
        without = [r and node(r, 1.0, 2) for r in ratios]
        after = made.remove_unestablished(fitted, without, sure)
        if removed is None:
            assert after is None
            assert [f.accepted for f in made.findings] == [True] * 3 + [False]
            continue
        assert after == [*fitted, without["abc".index(removed)]]
        dropped = next(f for f in made.findings if f.name == removed)
        assert (dropped.accepted, dropped.reason) == (
            False,
            "its parameters may be at their null values beside the others",
        )
        assert [f.name for f in made._accepted()] == [name for name in "abc" if name != removed]
        assert made.groups == [g for g in (("a",), ("b", "y"), ("c",)) if g[0] != removed]
        assert made.hypotheses == [h for h in ({"a": 1}, {"b": 2, "y": 3}, {"c": 4}) if removed not in h]


def test_an_only_effect_that_may_be_at_its_null_value_leaves_the_model_as_given(monkeypatch):
    for ratio, nominal, left in ((1.2, None, "given"), (1.3, None, None), (1.3, 1.2, "nominal")):
        made, given, reduced = procedure(), node(ratio), node(ratio, 150.0)
        instead = None if nominal is None else node(nominal, 104.0, nominal=1)
        monkeypatch.setattr(module, "with_nominal_values", lambda *_, instead=instead: instead)
        made.findings = [replace(finding("a", 0.1), parameters=(OPEN,))]
        made.groups, made.hypotheses = [("a",)], [{"a": 1}]
        after = made.remove_unestablished([given, node(1.0, 100.0, effects=1)], [reduced], [False])
        # Beside no other effect, more than noise is no error of form.
        assert after == {"given": [given], "nominal": [instead], None: None}[left]
        assert made.groups == ([] if left else [("a",)])
        reason = "its parameters may be at their null values" if left else ""
        assert [(f.accepted, f.reason) for f in made.findings] == [(not left, reason)]


def test_effects_are_removed_one_at_a_time_and_the_rest_fitted_together(monkeypatch):
    made, asked = procedure(), []
    answers = iter([["first", "second"], ["third"], None])

    def together(fitted):
        asked.append(list(fitted))
        return [*fitted[:-1], f"joint {fitted[-1]}"], ["without"], ["established"]

    def remove(fitted, without, established):
        assert (fitted[-1][:5], without, established) == ("joint", ["without"], ["established"])
        return next(answers)

    monkeypatch.setattr(made, "_fitted_together", together)
    monkeypatch.setattr(made, "remove_unestablished", remove)
    assert made.final_values(["given", "all"]) == ["joint third"]
    assert asked == [["given", "all"], ["first", "second"], ["third"]]
    # What the removed ones explain needs no force of unknown form.
    assert made.with_unestablished == ["given", "joint all"]
    tested = []
    monkeypatch.setattr(module, "unknown_force", lambda nodes, *_: tested.append(nodes))
    made.findings, made.with_unestablished = [finding("a", 0.1)], [node(3), node(1.2), node(1.0)]
    given, last = node(3), node(1.1)
    assert made.conclude(given, [given, last], (), ()).verdict == "effect"
    made.with_unestablished, second = [], list(made.with_unestablished)
    made.conclude(given, [given, last], (), ())
    assert tested == [[given, *second[1:]], [given, last]]


def test_effects_are_established_by_intervals_that_the_profile_likelihood_does_not_widen(monkeypatch):
    narrow = [(CLEAR,), (OPEN,), (OPEN, CLEAR), (interval(0.5, np.inf),), (OPEN, OPEN)]
    wide, asked = [(CLEAR,), *[(OPEN,)] * 4], []

    def intervals(last, widening, nominal):
        asked.append((last, widening, nominal))
        return narrow if widening is None else wide

    made, last = procedure(), node(1.0, effects=5)  # one effect of its own, four added
    monkeypatch.setattr(made, "_joint", lambda _: last)
    monkeypatch.setattr(module, "joint_parameters", intervals)
    monkeypatch.setattr(module, "nominal_errors", lambda *_: "nominal")
    monkeypatch.setattr(module, "refit_without_effect", lambda _, k: f"without {k}")
    monkeypatch.setattr(module, "joint_finding", lambda f, parameters, *_: replace(f, parameters=parameters))
    monkeypatch.setattr(module, "with_intervals", lambda _, parameters: parameters)
    made.findings = [finding(name, 0.5, step=k) for k, name in enumerate("abcd")]
    made.widening = {k: f"width of {k}" for k in range(4)}
    found, without, established = made._fitted_together(["given", "all"])
    # One parameter is enough; a limit that is infinite by default and finite here excludes it.
    assert established == [False, True, True, False]
    assert without == [f"without {k}" for k in range(1, 5)]
    # What the answer states has the wider intervals.
    assert found == ["given", wide]
    assert [f.parameters for f in made.findings] == wide[1:]
    assert asked == [(last, {k + 1: f"width of {k}" for k in range(4)}, "nominal"), (last, None, "nominal")]
    assert procedure()._fitted_together([node(1.0)])[1:] == ([], [])


def test_where_the_data_are_explained_the_intervals_of_the_answer_decide_on_a_candidate(monkeypatch):
    ends = {"a": [OPEN], "b": [OPEN, CLEAR], "c": [CLEAR]}
    monkeypatch.setattr(module, "add_candidate", lambda _base, c: c)
    monkeypatch.setattr(module, "nominal_errors", lambda c, _cfg, shared: f"nominal {c.name} {shared}")
    simulated = []
    monkeypatch.setattr(module, "nominal_sensitivities", lambda base: simulated.append(base) or "at base")

    def answer(c, widening, nominal):
        assert (widening, nominal) == ({1: f"width of {c.name}"}, f"nominal {c.name} at base")
        return [(CLEAR,), tuple(ends[c.name])]

    monkeypatch.setattr(module, "joint_parameters", answer)
    gains = {"a": (0.9, True), "b": (0.7, True), "c": (0.6, False)}
    for explained, added, seen in ((False, "a", ["a", "b"]), (True, "b", ["b"])):
        made = procedure()
        (best, _), _ = searched(monkeypatch, made, gains, np.zeros(10), explained=explained)
        assert best.name == added
        assert made.groups == [tuple(seen)]
        first = next(f for f in made.findings if f.name == "a")
        assert first.accepted is not explained
        assert (first.reason == "its parameters may be at their null values") is explained
        assert len(simulated) == explained


def test_nominal_values_may_be_at_their_bounds_beside_an_effect_with_an_error_of_form(monkeypatch):
    given, after, asked = node(5.0), node(2.0, effects=1), []

    def nominal(one, cfg, min_gain, enough):
        # Far from the noise they must explain a fifth; as near as an error of form leaves, what an effect must.
        assert (cfg, min_gain) == (made.cfg.nominal, 0.2 if one is given else 0.04)
        asked.append(None if enough is None else [enough(node(r)) for r in (1.5, 1.8)])
        return one

    monkeypatch.setattr(module, "with_nominal_values", nominal)
    made = procedure(min_gain=0.04)
    made._with_nominal([given], None, given)
    made._with_nominal([given, after], None, given)
    # 5.2 % and 9.3 % of the discrepancy.
    assert asked == [None, [True, False]]


def test_far_from_the_noise_a_shorter_time_step_must_explain_a_fifth(monkeypatch):
    asked = {}
    monkeypatch.setattr(module, "finer_time_step", lambda one, cfg: asked.setdefault(one.ratio, cfg.min_gain))
    made = procedure(min_gain=0.04)
    for ratio in (5.0, 2.01, 2.0, 1.5):
        made._finer(node(ratio))
    assert asked == {5.0: 0.2, 2.01: 0.2, 2.0: 0.04, 1.5: 0.04}
    made = procedure(min_gain=0.3)
    made._finer(node(6.0))
    assert asked[6.0] == 0.3


def test_large_residuals_that_a_model_explains_are_no_outliers():
    one, first = node(1.0), node(3.0)
    one.limit = 4.0
    one.pieces[0].residual = np.array([1.0, -1.0, 2.0, 100.0])
    first.pieces[0].residual = np.array([20.0, -1.0, 2.0, 100.0])
    left, lacked = discrepancies(one, first)
    outlier = 2 * 4.0 * (100.0 - 2.0)
    assert left == pytest.approx((1 + 1 + 4 + outlier) / 4 - 1)
    assert lacked == pytest.approx((400 + 1 + 4 + outlier) / 4 - 1)
    first.pieces[0].residual, first.limit = np.array([3.0, 8.0]), 5.0
    assert discrepancies(one, first)[1] == pytest.approx((9 + 2 * 5.0 * (8.0 - 2.5)) / 2 - 1)


def test_noise_that_may_be_larger_than_its_estimate_leaves_a_model_adequate(monkeypatch):
    monkeypatch.setattr(module, "unknown_force", lambda *_: None)
    for ratio, factor, verdict in ((1.8, 1.5, "none_needed"), (1.8, 1.4, "none_of_these"), (1.8, 1.0, "none_of_these")):
        made = procedure()
        made.noise_factors = {"angle": factor}
        assert made.conclude(node(ratio), [node(ratio)], (), ()).verdict == verdict


def test_one_channel_that_the_model_misses_is_not_outweighed_by_others():
    one = node(0.5)
    (window,), (piece,) = one.windows, one.pieces
    window.readings = [SimpleNamespace(channel=c, rows=slice(k, k + 1)) for k, c in enumerate("abcd")]
    for worst, adequate in ((1.49, True), (1.51, False)):
        piece.residual = np.array([0.5, 0.5, 0.5, worst])
        assert is_adequate(one, {}, DiagnoseCfg()) == adequate
    assert is_adequate(one, {"d": 1.02}, DiagnoseCfg())
    piece.residual = np.full(4, 1.26)
    assert not is_adequate(one, {}, DiagnoseCfg())


def test_shorter_windows_are_taken_where_the_model_is_far_off(monkeypatch):
    lengths = []

    def windows(_model, length):
        lengths.append(length)
        return [SimpleNamespace(start=0.0, end=length)]

    for base, seconds, at_two, at_half, asked, left in (
        (20.0, 9.0, 1.0, 1.0, [], None),
        (20.1, 9.0, 20.0, 1.0, [2.0], 20.0),
        (20.1, 9.0, 20.1, 99.0, [2.0, 0.5], 99.0),
        (20.1, 3.9, 1.0, 30.0, [0.5], 30.0),
        (20.1, 0.9, 1.0, 1.0, [], None),
    ):
        made, given = procedure(), node(base)
        given.windows = [SimpleNamespace(start=1.0, end=1.0 + seconds), SimpleNamespace(start=0.0, end=0.1)]
        lengths.clear()
        monkeypatch.setattr(made, "_windows", windows)
        sizes = {2.0: at_two, 0.5: at_half}
        monkeypatch.setattr(made, "_refitted", lambda _model, cut, sizes=sizes: node(sizes[cut[0].end]))
        found = made.coarse_baseline(given)
        assert lengths == asked
        assert (None if found is None else found.ratio) == left


@pytest.mark.parametrize(
    ("ratio", "touchable", "scale"), [(60.0, True, 20.0), (20.1, True, 6.7), (20.0, True, 1.0), (60.0, False, 1.0)]
)
def test_the_error_of_a_model_far_off_takes_the_place_of_the_noise_where_a_free_body_can_be_touched(
    monkeypatch, ratio, touchable, scale
):
    made, cut = procedure(), []

    def observed(_model, _recording, *, noise, **_):
        cut.append(noise)
        return [window]

    def refitted(_model, windows):
        return SimpleNamespace(noise_ratio=ratio, scales=[w.noise_scale for w in windows])

    (window, *_) = windows_of(RECORDING)
    monkeypatch.setattr(module, "channel_noises", lambda *_: {"angle": 0.002, "place": 0.01})
    monkeypatch.setattr(module, "observe", observed)
    monkeypatch.setattr(module, "has_touchable_free_body", lambda _: touchable)
    monkeypatch.setattr(made, "_refitted", refitted)
    assert made.baseline().scales == pytest.approx([scale])
    assert made.noise_scale == pytest.approx(scale)
    assert cut[0] == {"angle": 0.002, "place": 0.01}
    assert len(cut) == (2 if scale > 1 else 1)
    assert cut[-1] == pytest.approx({"angle": scale * 0.002, "place": scale * 0.01})
    # Those of later fits are in the same units; the noise itself stays as it was found.
    (later,) = made._windows(MODEL, 0.5)
    assert (later.noise_scale, cut[-1]["angle"]) == pytest.approx((scale, scale * 0.002))
    assert made.noise == {"angle": 0.002, "place": 0.01}


def test_the_unit_of_residuals_decides_neither_what_is_left_nor_what_is_lacking():
    factors, cfg = {"angle": 1.2}, DiagnoseCfg()
    for ratio in (1.22, 1.24, 1.45, 1.51):
        plain, first = node(ratio), node(9.0)
        scaled, first_scaled = node(ratio), node(9.0)
        for one, scale in ((scaled, 4.0), (first_scaled, 2.0)):
            one.pieces[0].residual, one.noise_scale = one.pieces[0].residual / scale, scale
        assert discrepancies(scaled, first_scaled) == pytest.approx(discrepancies(plain, first))
        assert is_adequate(scaled, factors, cfg) == is_adequate(plain, factors, cfg) == (ratio < 1.5)
        assert is_lacking(scaled, factors, cfg) == is_lacking(plain, factors, cfg) == (ratio > 1.23)


def test_additions_that_explain_nothing_over_longer_windows_are_taken_back(monkeypatch):
    made = procedure()
    made.groups, made.hypotheses = [("a",), ("b",), ("c",)], [{"a": 1}, {"b": 2}, {"c": 3}]
    made.findings = [finding("a", 0.5), finding("b", 0.4, step=1), finding("c", 0.3, step=2)]
    made.findings.append(finding("x", 0.1, accepted=False, reason="no better than chance"))
    errors = {"after a": 10.0, "after b": 9.6, "after c": 1.0}
    monkeypatch.setattr(made, "_refitted", lambda model, _: node(1.0, errors[model.name], name=model.name))
    base = node(30.0, 100.0, name="given")
    after = made.carry_over(base, [base, *(node(1.0, name=name) for name in errors)])
    assert [one.model.name for one in after] == ["given", "after a"]
    assert (made.groups, made.hypotheses) == ([("a",)], [{"a": 1}])
    reason = "explains nothing more over longer windows"
    assert [(f.name, f.accepted, f.reason) for f in made.findings] == [
        ("a", True, ""), ("b", False, reason), ("c", False, reason), ("x", False, "no better than chance"),
    ]  # fmt: skip
    errors["after b"] = 9.4
    assert len(made.carry_over(base, [base, *(node(1.0, name=name) for name in errors)])) == 4


@pytest.mark.parametrize(
    ("ratios", "groups", "unknown", "verdict", "unexplained", "form_error"),
    [
        ((1.2,), [], None, "none_needed", 0.0, False),
        ((1.25,), [], None, "none_needed", 0.0, False),
        ((1.26,), [], None, "none_of_these", 1.0, False),
        ((3.0, 1.25), [("a",)], None, "effect", (1.25**2 - 1) / 8, True),  # 7 % of the discrepancy
        ((3.0, 1.1), [("a",), ("b", "c")], None, "group", (1.1**2 - 1) / 8, True),
        ((3.0, 1.02), [("a",)], None, "effect", (1.02**2 - 1) / 8, False),  # no more than noise
        ((1.5, 1.1), [("a",)], None, "effect", (1.1**2 - 1) / (1.5**2 - 1), False),  # little beside the noise
        ((1.5, 1.11), [("a",)], None, "none_of_these", (1.11**2 - 1) / (1.5**2 - 1), False),
        ((3.0, 2.0), [("a",)], None, "none_of_these", 3 / 8, False),
        ((3.0, 0.9), [("a",)], None, "effect", 0.0, False),
        ((3.0, 4.0), [], None, "none_of_these", 1.0, False),
        ((3.0, 1.0), [("a",)], 0.3, "none_of_these", 0.3, False),
        ((3.0, 2.0), [("a",)], 0.3, "none_of_these", 3 / 8, False),
        ((1.0,), [], 0.3, "none_of_these", 0.3, False),
        ((3.0, 1.0), [("a",)], -0.05, "effect", 0.0, False),
        ((5.0, 1.3), [("a",)], None, "effect", (1.3**2 - 1) / 24, True),  # 3 % of the discrepancy
        ((5.0, 1.3), [("a",), ("b", "c")], -0.05, "group", (1.3**2 - 1) / 24, True),
        ((5.0, 1.3), [("a",)], 0.3, "none_of_these", 0.3, False),
        ((2.8, 1.26), [("a",)], None, "none_of_these", (1.26**2 - 1) / (2.8**2 - 1), False),  # 8.6 %
        ((9.0, 2.0), [("a",)], None, "effect", 3 / 80, True),
        ((9.0, 2.01), [("a",)], None, "none_of_these", (2.01**2 - 1) / 80, False),
    ],
)
def test_verdicts_follow_from_what_is_left(monkeypatch, ratios, groups, unknown, verdict, unexplained, form_error):
    made, added = procedure(), bool(groups) or unknown is not None
    made.groups = groups
    made.findings = [
        finding("late", 0.1, accepted=added, step=1), finding("no", 0.9, accepted=False),
        finding("first", 0.2, accepted=added), finding("less", 0.8, accepted=False),
        finding("later", 0.95, accepted=False, step=1),
    ]  # fmt: skip
    # A share below zero stands for an error of form.
    force = None if unknown is None else SimpleNamespace(share=abs(unknown), form_error=unknown < 0)
    monkeypatch.setattr(module, "unknown_force", lambda nodes, _cfg, _results: force if len(nodes) else None)
    nodes = [node(r, name=str(r)) for r in ratios]
    found = made.conclude(nodes[0], nodes, ("size",), ["a gap"])
    assert found.verdict == verdict
    assert found.unexplained == pytest.approx(unexplained)
    assert found.ratio == tuple(10 * r for r in ratios)
    order = ["first", "late", "no", "less", "later"] if added else ["no", "less", "first", "later", "late"]
    assert [f.name for f in found.effects] == order
    assert found.groups == tuple(groups)
    assert (found.detectable, found.issues, found.seed) == (("size",), ("a gap",), 0)
    assert [m.name for m in found.models] == [str(ratios[0]), *(f"delivered {r}" for r in ratios[1:])]
    assert (found.where, found.next_experiment) == ((), None)
    assert found.form_error == (pytest.approx(unexplained) if form_error else None)
    # Where much more than noise is left, no force of unknown form is needed to show that something is missing.
    tested = ratios[-1] <= 1.1 or ratios == (5.0, 1.3) or form_error
    assert found.unknown_force is (force if tested else None)


def test_what_is_left_is_no_error_of_form_where_no_effect_was_accepted(monkeypatch):
    monkeypatch.setattr(module, "unknown_force", lambda *_: pytest.fail("no effect has a formula"))
    for findings in ([], [finding("no", 0.9, accepted=False)]):
        made = procedure()
        made.findings = findings
        found = made.conclude(node(5.0), [node(5.0), node(1.3)], (), ())
        assert (found.verdict, found.form_error) == ("none_of_these", None)


def test_failures_and_an_experiment_explain_what_was_found(monkeypatch):
    asked: list[Any] = []
    monkeypatch.setattr(module, "unknown_force", lambda *_: None)
    monkeypatch.setattr(module, "locate_failures", lambda *args, **more: asked.append((args, more)) or [{"span": 1}])
    monkeypatch.setattr(module, "suggest_experiment", lambda *args, **more: asked.append((args, more)) or "experiment")
    made = procedure(explain=True, seed=7)
    made.hypotheses = [{"a": MODEL}, {"b": MODEL, "c": MODEL}, {"d": MODEL, "e": MODEL}]
    given = node(3.0, name="given")
    found = made.conclude(given, [given, node(1.0)], (), ())
    assert (found.where, found.next_experiment) == (({"span": 1},), "experiment")
    (model, recording, cfg), more = asked[0]
    assert (model.name, recording) == ("given", RECORDING)
    assert cfg == made.cfg.failures
    assert more == {"engine": "mujoco", "windows": given.windows, "offsets": "o"}
    (models, recording, cfg), more = asked[1]
    assert (models, recording, cfg.seed, more) == (made.hypotheses[1], RECORDING, 7, {"engine": "mujoco"})
    asked.clear()
    lone = procedure(explain=True)
    lone.hypotheses = [{"a": MODEL}]
    assert lone.conclude(node(3.0), [node(3.0), node(1.0)], (), ()).next_experiment is None
    none = procedure(explain=True)
    assert none.conclude(node(1.0), [node(1.0)], (), ()).where == ()
    assert len(asked) == 1


class MadeUp(SimpleNamespace):
    """A fitted candidate."""

    fit = "its fit"

    def share(self, base: Any) -> float:
        """Return its gain over a baseline."""
        return self.gain - getattr(base, "less", 0.0)


def candidate(name: str, *, is_part: bool = False) -> Any:
    """Return a candidate, or a part of an element."""
    return SimpleNamespace(name=name, is_part=is_part, target=(), elements=())


def searched(monkeypatch, made, gains: dict[str, tuple[float, bool]], null: np.ndarray, ratio: float = 2.0, **given):
    """Return what a search adds whose candidates have these gains, and notes of what is asked for."""
    notes: dict[str, Any] = {"bases": []}
    fitted = [
        MadeUp(name=n, gain=g, model=SimpleNamespace(name=f"model {n}", effects=["own", f"added {n}"]))
        for n, (g, _) in gains.items()
    ]
    monkeypatch.setattr(module, "candidates", lambda *_: [candidate("effect")])
    monkeypatch.setattr(made, "_screened", lambda *_: ["s1", "s2", "s3"])
    monkeypatch.setattr(module, "max_gain_under_null", lambda *args: notes.setdefault("null", args[2:]) and null)
    monkeypatch.setattr(
        module, "detectable_size", lambda _b, s, needed: notes.update(needed=needed) or (s if s != "s2" else None)
    )

    def assess(base, c, _null, step, _effects, cfg):
        notes["bases"].append(base)
        notes["level"], notes["min_gain"] = cfg.significance_level, cfg.min_gain
        return finding(c.name, c.share(base), accepted=gains[c.name][1], step=step)

    class Fits:
        left = ()

        def __init__(self, *_):
            pass

        def unsettled(self, _name):
            return []

        def fit(self, _screened, needed, _windows, _promise):
            notes["asked"] = needed
            return fitted

    def refit(base, rivals):
        notes["rivals"] = [c.name for c in rivals]
        return SimpleNamespace(**{**vars(base), "less": 0.05})

    monkeypatch.setattr(module, "assess", assess)
    monkeypatch.setattr(module, "CandidateFits", Fits)
    monkeypatch.setattr(module, "refit_from_rivals", refit)
    monkeypatch.setattr(module, "profile_widening", lambda _base, c: f"width of {c.name}")
    monkeypatch.setattr(module, "group_indistinguishable", lambda _base, accepted, *_: accepted[:2])
    return made.find_addition(node(ratio), 1, **given), notes


def test_the_first_of_the_group_is_added_and_all_findings_are_kept(monkeypatch):
    made = procedure()
    gains = {"a": (0.5, True), "b": (0.7, True), "c": (0.6, False), "d": (0.65, True)}
    (best, sizes), notes = searched(monkeypatch, made, gains, np.arange(101) / 1000)
    assert best.name == "a"
    assert sizes == ("s1", "s3")
    assert notes["asked"] == pytest.approx(0.095)
    assert notes["needed"] == pytest.approx(0.095)
    assert notes["null"] == (400, 0)
    assert "rivals" not in notes
    assert made.groups == [("a", "b")]
    assert made.widening == {1: "width of a"}
    assert [{n: m.name for n, m in models.items()} for models in made.hypotheses] == [{"a": "model a", "b": "model b"}]
    assert list(made.rivals) == [1]
    assert [(r.finding.name, r.added, r.fit) for r in made.rivals[1]] == [(n, f"added {n}", "its fit") for n in "bdca"]
    assert [(f.name, f.accepted, f.reason, f.step) for f in made.findings] == [
        ("a", True, "", 1),
        ("b", False, "another one explains more", 1),
        ("d", False, "another one explains more", 1),
        ("c", False, "another one explains more", 1),
    ]


def test_a_doubtful_gain_is_judged_against_a_baseline_that_is_refitted_from_its_rivals(monkeypatch):
    made = procedure()
    gains = {"a": (0.3, True), "b": (0.39, True), "c": (0.9, False), "d": (0.35, True), "e": (0.2, True)}
    _, notes = searched(monkeypatch, made, gains, np.zeros(10))
    assert notes["needed"] == 0.05
    assert notes["rivals"] == ["b", "d", "a"]
    assert [getattr(b, "less", 0.0) for b in notes["bases"]] == [0.0] * 5 + [0.05] * 5
    clear = procedure()
    _, notes = searched(monkeypatch, clear, {"a": (0.4, True)}, np.zeros(10))
    assert "rivals" not in notes


def test_where_nothing_is_accepted_findings_are_kept_by_gain(monkeypatch):
    made = procedure()
    (best, _), _ = searched(monkeypatch, made, {"a": (0.1, False), "b": (0.2, False)}, np.zeros(10))
    assert best is None
    assert [f.name for f in made.findings] == ["b", "a"]
    assert (made.groups, made.rivals) == ([], {})


def test_a_residual_that_is_little_more_than_noise_is_searched_at_a_stricter_level(monkeypatch):
    for ratio, factor, level, gain in (
        (1.0, 1.0, 0.005, 0.125),
        (1.09, 1.0, 0.005, 0.125),
        (1.11, 1.0, 0.05, 0.05),
        (1.3, 1.2, 0.005, 0.125),  # 1.08 x the largest noise
        (1.33, 1.2, 0.05, 0.05),
    ):
        made, null = procedure(), np.arange(1001) / 1000
        made.noise_factors = {"angle": factor}
        (best, sizes), notes = searched(monkeypatch, made, {"a": (0.9, True)}, null, ratio)
        assert best.name == "a"
        assert sizes == ("s1", "s3")
        assert notes["asked"] == notes["needed"] == pytest.approx(1 - level)
        assert notes["level"] == level
        assert len(made.findings) == len(made.groups) == 1
        # Where chance is less than that, an effect must still remove a share of the error.
        other = procedure()
        other.noise_factors = made.noise_factors
        _, notes = searched(monkeypatch, other, {"a": (0.9, True)}, np.zeros(10), ratio)
        assert (notes["needed"], notes["min_gain"]) == (gain, gain)
    stricter = procedure(quiet_significance_level=0.001)
    _, notes = searched(monkeypatch, stricter, {"a": (0.9, True)}, np.arange(1001) / 1000, 1.0)
    assert notes["asked"] == pytest.approx(0.999)


def test_candidates_are_screened_and_started_by_gradients_where_asked_for(monkeypatch):
    made = procedure()
    monkeypatch.setattr(module, "linear_at_measured_states", lambda _base, _cfg: "shared")
    monkeypatch.setattr(module, "ranking", lambda _base, _screened, names, _seed: f"ranked {names}")
    monkeypatch.setattr(module, "label", lambda effect, _among: effect)
    monkeypatch.setattr(module, "screen", lambda _base, effect, _cfg, at: effect.upper() if at == "shared" else "")
    assert made._screened(node(2.0), ["a", "b"], 0) == ["A", "B"]
    assert made.runner.share == pytest.approx(0.5 * 0.85 / 3)
    assert made.seen[-1][1] == "ranked ['a', 'b']"
    made.gradient = SimpleNamespace(apply=lambda _base, screened, _runner: screened[::-1])
    assert made._screened(node(2.0), ["a", "b"], 0) == ["B", "A"]


class Parts:
    """A search in which one candidate is a part, and notes of what it asks for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, fits: dict[str, tuple[float, float]]) -> None:
        """Prepare a search whose candidates have a gain and a noise ratio."""
        self.screened: list[list[str]] = []
        self.fitted: list[tuple[list[str], float]] = []
        self.null: list[list[str]] = []
        self.among: list[list[str]] = []
        self.time = True
        notes, found = self, {}
        for name, (gain, ratio) in fits.items():
            found[name] = MadeUp(name=name, gain=gain, ratio=ratio, model=SimpleNamespace(effects=[name]))
        effects = [candidate("whole"), candidate("part", is_part=True), candidate("other")]

        class Fits:
            left = ()

            def __init__(self, *_):
                self.fits = []

            def unsettled(self, _name):
                return []

            def fit(self, screened, needed, _windows, _promise):
                notes.fitted.append((screened, needed))
                self.fits += [found[s] for s in screened if s in found]
                return self.fits

        def chance(_base, screened, *_):
            self.null.append(screened)
            return np.full(10, 0.01 * len(screened))

        def assess(_base, c, null, step, among, _cfg):
            self.among.append([e.name for e in among])
            return replace(finding(c.name, c.gain, step=step), p=float(null[0]))

        monkeypatch.setattr(module, "candidates", lambda *_: effects)
        monkeypatch.setattr(module, "max_gain_under_null", chance)
        monkeypatch.setattr(module, "detectable_size", lambda _b, s, needed: f"{s} {needed}")
        monkeypatch.setattr(module, "CandidateFits", Fits)
        monkeypatch.setattr(module, "assess", assess)
        monkeypatch.setattr(module, "profile_widening", lambda _base, c: f"width of {c.name}")
        monkeypatch.setattr(
            module, "group_indistinguishable", lambda _b, accepted, *_: [max(accepted, key=lambda pair: pair[1].gain)]
        )

    def find(self, made: Any, ratio: float = 2.0) -> tuple[str | None, tuple[str, ...]]:
        """Return the name of what is added to a model of a noise ratio, and the detectable sizes."""

        def screen(_base, effects, _step, **_):
            if not self.time and effects[0].is_part:
                raise TimeUpError
            self.screened.append([e.name for e in effects])
            return self.screened[-1]

        made._screened = screen
        best, sizes = made.find_addition(node(ratio), 0)
        return None if best is None else best.name, sizes


@pytest.mark.parametrize(
    ("whole", "other", "ratio", "needed"),
    [
        ((0.7, 1.1), (0.6, 1.5), 2.0, False),
        ((0.7, 1.11), (0.6, 1.0), 2.0, True),  # the one that gains most counts
        (None, None, 1.1, False),
        (None, None, 1.11, True),
    ],
)
def test_parts_are_candidates_where_no_other_one_explains_the_data(monkeypatch, whole, other, ratio, needed):
    fits = {n: v for n, v in (("whole", whole), ("other", other), ("part", (0.9, 1.0))) if v is not None}
    made, parts = procedure(), Parts(monkeypatch, fits)
    added, sizes = parts.find(made, ratio)
    assert added == ("part" if needed else "whole" if whole else None)
    least = 0.125 if ratio <= 1.1 else 0.05
    assert sizes == (f"whole {least}", f"other {least}")
    first, rest = ["whole", "other"], [["part"]] if needed else []
    assert parts.screened == [first, *rest]
    # Chance has the best of all of them, for those that were fitted before as well.
    assert parts.null == [first, *([[*first, "part"]] if needed else [])]
    assert parts.fitted == [(screened, least) for screened in (first, *rest)]  # more than chance reaches
    assert all(among == (["whole", "other", "part"] if needed else first) for among in parts.among)
    assert {f.p for f in made.findings} == ({0.03} if needed else {0.02} if whole else set())
    assert len(made.findings) == len(fits) - (not needed)


def test_beside_a_provisional_addition_candidates_must_promise_what_it_left():
    made = procedure()
    assert (made.cfg.max_remainder, made.cfg.search.remainder_promise) == (0.15, 0.75)
    assert made._least_promise(node(2.0)) == 0
    made.provisional = 1
    # 1 - 1 / 2^2 of the squared residual is more than noise.
    assert made._least_promise(node(2.0)) == pytest.approx(0.75 * 0.85 * 0.75)
    assert made._least_promise(node(0.9)) == 0


def test_parts_of_an_effect_that_was_asked_for_are_candidates_from_the_start(monkeypatch):
    for asked, first in ((("part",), ["whole", "part", "other"]), (("whole",), ["whole", "other"])):
        made, parts = procedure(effects=asked), Parts(monkeypatch, {"whole": (0.7, 1.0)})
        assert parts.find(made)[0] == "whole"
        assert parts.screened == [first]


def test_without_time_for_parts_the_other_candidates_stay(monkeypatch):
    made, parts = procedure(), Parts(monkeypatch, {"whole": (0.7, 1.5)})
    parts.time = False
    assert parts.find(made)[0] == "whole"
    assert made.budget.unsettled == ["Not screened: part."]
    assert made.budget.cut == {0}
