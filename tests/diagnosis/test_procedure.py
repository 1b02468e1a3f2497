"""The procedure of a diagnosis step by step, with fits that are made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis import procedure as module
from concent_warp.diagnosis.cfg import CheckDataCfg, DiagnoseCfg, SearchCfg
from concent_warp.diagnosis.check_data import _is_white, check_data
from concent_warp.diagnosis.failures import _force_entries, _span_entry, _with_starts
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import Finding
from concent_warp.diagnosis.search.adequacy import is_adequate
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.recording.recording import Channel
from tests.scenes.swinging import drawing, swung, windows_of

RECORDING = swung(seconds=0.5)
MODEL = drawing(RECORDING)


def finding(name: str, gain: float, *, accepted: bool = True, step: int = 0, reason: str = "") -> Finding:
    """Return the evidence of an effect."""
    return Finding(name, (), "", (), gain, gain, gain, 0.0, 0.0, accepted, step, (), reason)


def node(ratio: float, errors: float = 1.0, effects: int = 0, name: str = "", scene: str = "as given") -> Any:
    """Return a fitted model."""
    added = SimpleNamespace(effect=SimpleNamespace(nominal=False))
    model = SimpleNamespace(effects=[added] * effects, name=name, scene=scene)
    # Residuals of one size, beyond the limit of the robust loss nowhere.
    piece = SimpleNamespace(residual=np.full(4, float(ratio)))
    window = SimpleNamespace(readings=[SimpleNamespace(channel="angle", rows=slice(0, 4))])
    return SimpleNamespace(
        ratio=ratio, noise_ratio=10 * ratio, errors=np.array([errors / 2] * 2), model=model, windows=[window],
        fit=SimpleNamespace(offsets="o", cost=errors), pieces=[piece], cfg=EffectSolverCfg(),
    )  # fmt: skip


def procedure(**changes: Any) -> Any:
    """Return a procedure, with settings."""
    made = Procedure(MODEL, RECORDING, replace(DiagnoseCfg(jobs=1, explain=False), **changes))
    made.seen = []  # pyright: ignore[reportAttributeAccessIssue]
    made.runner = TaskRunner(1, lambda share, text: made.seen.append((share, text)))  # pyright: ignore
    return made


def test_effects_are_added_until_none_is_accepted_or_little_is_left(monkeypatch):
    for ratios, answers, count in (
        ((3.0, 2.0, 1.5, 1.2), 9, 4),
        ((3.0, 2.0), 1, 2),
        ((1.27, 1.0246), 9, 2),
        ((1.27, 1.0248, 1.0), 9, 3),
        ((3.0, 1.24, 1.0), 9, 2),  # adequate, and 7 % of the discrepancy is left
        ((2.4, 1.24, 1.0), 9, 3),
        ((5.0, 1.26, 1.0), 9, 3),
        ((1.0, 1.0), 9, 2),
    ):
        made, asked = procedure(), []
        nodes = [node(r) for r in ratios]

        def find(base, step, asked=asked, answers=answers, nodes=nodes, made=made):
            asked.append((step, base, made.runner.share))
            return (nodes[step + 1] if step < answers else None), (f"size {step}",)

        concluded = []
        monkeypatch.setattr(made, "baseline", lambda nodes=nodes: nodes[0])
        monkeypatch.setattr(made, "find_addition", find)
        monkeypatch.setattr(module, "finer_time_step", lambda *_: None)
        monkeypatch.setattr(module, "with_nominal_values", lambda *_: None)
        monkeypatch.setattr(module, "add_candidate", lambda _base, best: best)
        monkeypatch.setattr(made, "simplified", lambda fitted: fitted)
        monkeypatch.setattr(made, "final_values", lambda fitted: fitted)
        monkeypatch.setattr(made, "conclude", lambda *args, concluded=concluded: concluded.append(args))
        made.run()
        ((given, fitted, detectable, issues),) = concluded
        assert given is nodes[0]
        assert fitted == nodes[:count]
        assert detectable == ("size 0",)
        assert issues == []
        assert [a[1] for a in asked] == nodes[: len(asked)]
        assert [a[2] for a in asked] == pytest.approx([0.1 + 0.85 * k / 3 for k in range(len(asked))])
        assert made.seen[0] == (0.0, "cutting windows")
        assert made.seen[-1] == (1.0, "done")


def test_a_shorter_time_step_is_used_where_no_effect_explains_more(monkeypatch):
    given, effect = node(3.0, 100.0), node(1.5, 40.0, effects=1)
    for errors, ratio, asked, left in (
        (35.0, 1.01, 0, ["finer"]),  # it leaves nothing to explain
        (35.0, 1.4, 2, ["finer", "effect"]),  # more than the effect: the search goes on with it
        (40.7, 1.6, 2, ["finer", "effect"]),  # nearly as much as the effect
        (41.0, 1.6, 1, ["as given", "effect"]),  # less than the effect
    ):
        made, finer, calls = procedure(max_additions=1), node(ratio, errors, scene="finer"), []
        rivals = {id(given): finer}

        def find(base, step, calls=calls, made=made):
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
        assert [("effect" if one is effect else one.model.scene) for one in fitted] == left
        assert made.groups == [("effect",)] * (len(fitted) - 1)
        assert len(made.findings) == len(fitted) - 1
        assert made.time_step == ("found" if left[0] == "finer" else None)


def test_a_shorter_time_step_after_an_effect_may_make_it_superfluous(monkeypatch):
    made = procedure()
    made.groups, made.hypotheses, made.findings = [("a",)], [{}], [finding("a", 0.5)]
    monkeypatch.setattr(module, "refit_without_effect", lambda *_: node(1.0, 104.0, scene="finer"))
    fitted = made.remove_superfluous([node(3), node(1.0, 100.0, effects=1, scene="finer")])
    assert len(fitted) == 3
    assert not made.groups
    assert not made.findings[0].accepted


def test_the_answer_starts_with_the_model_as_given(monkeypatch):
    monkeypatch.setattr(module, "unknown_force", lambda *_: None)
    given, finer, added = node(3.0), node(1.2, scene="finer"), node(1.0, scene="finer", effects=1)
    found = procedure().conclude(given, [finer, added], (), ())
    assert found.ratio == (30.0, 12.0, 10.0)
    assert found.models == (given.model, finer.model, added.model)
    assert procedure().conclude(given, [given], (), ()).ratio == (30.0,)


def test_a_third_effect_of_an_adequate_model_stays_if_it_makes_another_superfluous(monkeypatch):
    for errors, left in ((104.0, 5), (200.0, 3)):  # errors of the model without the first
        made = procedure()
        nodes = [node(50, effects=0), node(7, effects=1), node(1.15, effects=2), node(1.0, 100.0, effects=3)]
        names, reduced = iter("abc"), node(1.0, errors, effects=2)

        def find(_base, step, made=made, nodes=nodes, names=names):
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
        superfluous = errors < 105
        assert after == ([*nodes, reduced] if superfluous else nodes[:3])
        assert made.groups == ([("b",), ("c",)] if superfluous else [("a",), ("b",)])
        assert [f.name for f in made.findings if f.accepted] == (["b", "c"] if superfluous else ["a", "b"])
        assert len(after) == left


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
    after = made.remove_superfluous(list(fitted))
    assert asked == [(5, 2), (5, 3), (4, 2)]
    assert after == [*fitted, left[5, 3]]
    assert made.groups == [("a", "b"), ("d",)]
    assert made.hypotheses == [{"a": 1}, {}, {"d": 3}]
    assert [(f.name, f.accepted, f.reason) for f in made.findings] == [
        ("a", True, ""), ("c", False, "made superfluous by effects added later"), ("d", True, ""),
        ("x", False, "no better than chance"),
    ]  # fmt: skip
    assert made.seen == [(0.0, "removing one effect at a time")] * 2


def test_an_effect_that_removes_the_least_gain_stays(monkeypatch):
    for errors, kept in ((100 / 0.951, False), (100 / 0.949, True)):
        made = procedure()
        made.groups, made.hypotheses = [("a",), ("b",)], [{}, {}]
        monkeypatch.setattr(module, "refit_without_effect", lambda *_, errors=errors: node(1.2, errors, 1))
        after = made.remove_superfluous([node(3), node(2), node(1.1, 100.0, 2)])
        assert (len(after) == 3) == kept
        assert made.groups == ([("a",), ("b",)] if kept else [("b",)])
    alone = procedure()
    monkeypatch.setattr(module, "refit_without_effect", lambda *_: pytest.fail("nothing to remove"))
    nodes = [node(3), node(2)]
    assert alone.remove_superfluous(nodes) is nodes


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
    ("ratios", "groups", "unknown", "verdict", "unexplained"),
    [
        ((1.2,), [], None, "none_needed", 0.0),
        ((1.25,), [], None, "none_needed", 0.0),
        ((1.26,), [], None, "none_of_these", 1.0),
        ((3.0, 1.25), [("a",)], None, "effect", (1.25**2 - 1) / 8),
        ((3.0, 1.1), [("a",), ("b", "c")], None, "group", (1.1**2 - 1) / 8),
        ((3.0, 2.0), [("a",)], None, "none_of_these", 3 / 8),
        ((3.0, 0.9), [("a",)], None, "effect", 0.0),
        ((3.0, 4.0), [], None, "none_of_these", 1.0),
        ((3.0, 1.0), [("a",)], 0.3, "none_of_these", 0.3),
        ((3.0, 2.0), [("a",)], 0.3, "none_of_these", 3 / 8),
        ((1.0,), [], 0.3, "none_of_these", 0.3),
        ((3.0, 1.0), [("a",)], -0.05, "effect", 0.0),
    ],
)
def test_verdicts_follow_from_what_is_left(monkeypatch, ratios, groups, unknown, verdict, unexplained):
    made = procedure()
    made.groups = groups
    made.findings = [
        finding("late", 0.1, step=1), finding("no", 0.9, accepted=False), finding("first", 0.2),
        finding("less", 0.8, accepted=False), finding("later", 0.95, accepted=False, step=1),
    ]  # fmt: skip
    # A share below zero stands for an error of form.
    force = None if unknown is None else SimpleNamespace(share=abs(unknown), form_error=unknown < 0)
    monkeypatch.setattr(module, "unknown_force", lambda nodes, _cfg, _results: force if len(nodes) else None)
    nodes = [node(r, name=str(r)) for r in ratios]
    found = made.conclude(nodes[0], nodes, ("size",), ["a gap"])
    assert found.verdict == verdict
    assert found.unexplained == pytest.approx(unexplained)
    assert found.ratio == tuple(10 * r for r in ratios)
    assert [f.name for f in found.effects] == ["first", "late", "no", "less", "later"]
    assert found.groups == tuple(groups)
    assert (found.detectable, found.issues, found.seed) == (("size",), ("a gap",), 0)
    assert [m.name for m in found.models] == [str(r) for r in ratios]
    # Where much more than noise is left, no force of unknown form is needed to show that something is missing.
    assert (found.where, found.next_experiment) == ((), None)
    assert found.unknown_force is (force if ratios[-1] <= 1.25 else None)


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

    def share(self, base: Any) -> float:
        """Return its gain over a baseline."""
        return self.gain - getattr(base, "less", 0.0)


def searched(monkeypatch, made, gains: dict[str, tuple[float, bool]], null: np.ndarray):
    """Return what a search adds whose candidates have these gains, and notes of what is asked for."""
    notes: dict[str, Any] = {"bases": []}
    fitted = [MadeUp(name=n, gain=g, model=f"model {n}") for n, (g, _) in gains.items()]
    monkeypatch.setattr(module, "candidates", lambda *_: ["effect"])
    monkeypatch.setattr(made, "_screened", lambda *_: ["s1", "s2", "s3"])
    monkeypatch.setattr(module, "max_gain_under_null", lambda *args: notes.setdefault("null", args[2:]) and null)
    monkeypatch.setattr(
        module, "detectable_size", lambda _b, s, needed: notes.update(needed=needed) or (s if s != "s2" else None)
    )

    def assess(base, c, _null, step, _effects, _cfg):
        notes["bases"].append(base)
        return finding(c.name, c.share(base), accepted=gains[c.name][1], step=step)

    class Fits:
        left = ()

        def __init__(self, *_):
            pass

        def unsettled(self, _name):
            return []

        def fit(self, _screened, critical, _windows):
            notes["critical"] = critical
            return fitted

    def refit(base, rivals):
        notes["rivals"] = [c.name for c in rivals]
        return SimpleNamespace(**{**vars(base), "less": 0.05})

    monkeypatch.setattr(module, "assess", assess)
    monkeypatch.setattr(module, "CandidateFits", Fits)
    monkeypatch.setattr(module, "refit_from_rivals", refit)
    monkeypatch.setattr(module, "profile_widening", lambda _base, c: f"width of {c.name}")
    monkeypatch.setattr(module, "group_indistinguishable", lambda _base, accepted, *_: accepted[:2])
    return made.find_addition(node(2.0), 1), notes


def test_the_first_of_the_group_is_added_and_all_findings_are_kept(monkeypatch):
    made = procedure()
    gains = {"a": (0.5, True), "b": (0.7, True), "c": (0.6, False), "d": (0.65, True)}
    (best, sizes), notes = searched(monkeypatch, made, gains, np.arange(101) / 1000)
    assert best.name == "a"
    assert sizes == ("s1", "s3")
    assert notes["critical"] == pytest.approx(0.095)
    assert notes["needed"] == pytest.approx(0.095)
    assert notes["null"] == (400, 0)
    assert "rivals" not in notes
    assert made.groups == [("a", "b")]
    assert made.widening == {1: "width of a"}
    assert made.hypotheses == [{"a": "model a", "b": "model b"}]
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
    assert made.groups == []


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


def spoiled(time: np.ndarray, value: np.ndarray, noise: float | None = 1e-3, more: bool = False) -> list[str]:
    """Return what is said of a channel."""
    (d,) = RECORDING.demonstrations
    measured = {"x": Channel(time, value, noise)}
    if more:
        measured["clean"] = d.measured["angle"]
    return check_data(replace(RECORDING, demonstrations=(replace(d, measured=measured),)))


def test_thresholds_of_the_check_of_the_data():
    time = np.arange(40) * 0.01
    swing = np.sin(9 * time)[:, None]
    late = time.copy()
    late[20:] += 0.09
    assert spoiled(late, swing) == []
    late[20:] += 0.0011
    late[30:] += 0.5
    assert spoiled(late, swing) == ["demo_0, x: 2 gaps of up to 0.51 s between samples 0.01 s apart."]
    lost = swing.copy()
    lost[:8] = np.nan
    assert spoiled(time, lost) == []
    lost[:9] = np.nan
    assert spoiled(time, lost) == ["demo_0, x: 22 % of the samples are missing."]
    assert spoiled(time[:10], 0 * swing[:10]) == []
    assert spoiled(time[:11], 0 * swing[:11]) == ["demo_0, x: the reading never changes."]
    two = np.concatenate([0 * swing, swing], axis=1)
    assert spoiled(time, two) == []
    assert spoiled(time[:2], swing[:2]) == []
    assert spoiled(time[:1], swing[:1]) == ["demo_0, x: only 1 sample, which carries no information."]
    white = np.where(np.arange(40) % 2, 1.0, -1.0)[:, None] * np.random.default_rng(0).uniform(0.5, 1, (40, 1))
    said = ["demo_0, x: the readings scatter like noise, no motion shows in them."]
    std = float(white.std())
    assert spoiled(time, white, std / 3.01) == said
    assert spoiled(time, white, std / 2.99) == []
    assert spoiled(time, white, None) == said
    assert spoiled(time, white, None, more=True) == []
    assert spoiled(time[:29], white[:29], None) == []
    assert spoiled(time[:30], white[:30], None) == said


def test_readings_are_white_where_all_that_move_differ_as_independent_ones():
    cfg, rng = CheckDataCfg(), np.random.default_rng(1)
    white, swing = rng.normal(size=(100, 1)), np.sin(np.arange(100) / 9)[:, None]
    assert _is_white(white, cfg)
    assert _is_white(np.hstack([white, 0 * white]), cfg)
    assert not _is_white(np.hstack([white, swing]), cfg)
    assert not _is_white(0 * white, cfg)
    ratio = np.mean(np.diff(white, axis=0) ** 2) / white.var()
    assert _is_white(white, replace(cfg, white_noise_ratio=ratio / 2 * 0.999))
    assert not _is_white(white, replace(cfg, white_noise_ratio=ratio / 2 * 1.001))


def test_failures_name_spans_and_significant_forces_by_size():
    span: Any = SimpleNamespace(
        demonstration="d", channels=("angle", "rate"), phase="all", start=0.1, end=0.2, body="arm", direction="",
        ratio=3.0, sentence=lambda demonstration: f"said {demonstration}",
    )  # fmt: skip
    assert _span_entry(span, True) == {
        "demonstration": "d", "channel": "angle", "phase": "all", "start": 0.1, "end": 0.2, "body": "arm",
        "direction": None, "ratio": 3.0, "sentence": "said True",
    }  # fmt: skip
    from tests.diagnosis.forces.test_describe import body, joint, phase

    forces: Any = SimpleNamespace(
        joints=[joint(ratio=2.0), joint(joint="other", ratio=9.0, significant=False)],
        bodies=[body(phase(), phase(phase="free", significant=False), ratio=5.0), body(phase(), ratio=1.0)],
    )
    found = _force_entries(forces)
    assert [(f["channel"], f["body"], f["phase"], f["ratio"]) for f in found] == [
        (None, "block", "slide", 5.0), ("hinge", None, None, 2.0), (None, "block", "slide", 1.0),
    ]  # fmt: skip
    assert found[1]["sentence"].startswith("hinge: ")
    assert found[0]["sentence"].startswith("block, slide")
    assert all(f["start"] is None and f["end"] is None and f["demonstration"] is None for f in found)


def test_replays_start_where_the_first_window_of_a_demonstration_was_fitted_to():
    windows = windows_of(swung(seconds=0.5), length=0.25)
    (d,) = RECORDING.demonstrations
    assert len(windows) > 1
    offsets = [np.array([0.5, -2.0]) + k for k in range(len(windows))]
    (moved,) = _with_starts(MODEL, RECORDING, windows, offsets).demonstrations
    first = windows[0]
    np.testing.assert_allclose(np.asarray(moved.qpos), first.qpos + 0.5 * first.spread[0])
    np.testing.assert_allclose(np.asarray(moved.qvel), first.qvel - 2.0 * first.spread[1])
    (same,) = _with_starts(MODEL, RECORDING, windows[1:], offsets[1:]).demonstrations
    assert same.qpos is d.qpos
    assert same.qvel is d.qvel
    assert SearchCfg().max_rounds == 3
