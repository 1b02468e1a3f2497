"""The procedure of a diagnosis from its windows to its verdict, with fits that are made up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from concent_warp.diagnosis import procedure as module
from concent_warp.diagnosis.replayed import Replayed
from concent_warp.diagnosis.result import UnknownForceFound
from concent_warp.diagnosis.search import additions, context
from tests.diagnosis.made_up import FINER, MODEL, RECORDING, finding, force_is, node, procedure
from tests.scenes.swinging import windows_of


def test_effects_are_added_until_none_is_accepted_or_little_is_left(monkeypatch):
    for ratios, answers, count, provisional in (
        ((3.0, 2.0, 1.5, 1.4), 9, 4, None),
        ((3.0, 2.0), 1, 2, None),
        ((1.27, 1.0246), 9, 2, None),
        ((1.27, 1.0248, 1.0), 9, 2, None),  # more than noise, but less than a further effect must remove
        ((1.27, 1.07, 1.0), 9, 3, None),
        ((3.0, 1.24, 1.0), 9, 3, 1),  # adequate, but 7 % of the discrepancy is left: one more is tried
        ((2.4, 1.24, 1.0), 9, 3, None),
        ((5.0, 1.26, 1.0), 9, 3, 1),
        ((5.0, 1.26, 1.24, 1.0), 9, 3, 1),
        ((5.0, 4.0, 1.24, 1.0), 9, 4, 2),  # adequate after two: one may be superfluous
        ((17.0, 2.01, 2.0, 1.8), 9, 4, 2),  # beyond twice the noise it is no error of form
        ((19.0, 2.01, 2.0, 1.8), 9, 3, 1),  # unless it is less than 1 % of the discrepancy
        ((5.0, 1.26), 1, 2, 1),
        ((1.0, 1.0), 9, 2, None),
    ):
        made, asked = procedure(), []
        nodes = [node(r) for r in ratios]

        def find(base, step, *, asked=asked, answers=answers, nodes=nodes, made=made, **_):
            asked.append((step, base, made.context.runner.share))
            return (nodes[step + 1] if step < answers else None), (f"size {step}",)

        concluded, renewed = [], []
        monkeypatch.setattr(made, "baseline", lambda nodes=nodes: nodes[0])
        monkeypatch.setattr(module, "longer_time_step", lambda one, _cfg: one)
        monkeypatch.setattr(module, "with_errors_of_impacts", lambda *_: None)  # nothing touches anything
        monkeypatch.setattr(made.additions.finder, "find", find)
        monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
        monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
        monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
        monkeypatch.setattr(additions, "renew_defects", lambda one, cfg, seen=renewed: seen.append((one, cfg)) or one)
        monkeypatch.setattr(made.revision, "simplified", lambda fitted: fitted)
        monkeypatch.setattr(made.revision, "restore_given", lambda fitted, _given: fitted)
        monkeypatch.setattr(made.revision, "final_values", lambda fitted: fitted)
        monkeypatch.setattr(made, "conclude", lambda *args, concluded=concluded: concluded.append(args))
        made.run()
        ((given, fitted, detectable, issues),) = concluded
        assert given is nodes[0]
        assert fitted == nodes[:count]
        assert made.record.provisional == provisional
        assert renewed == [(one, made.context.cfg.time_step) for one in nodes[1:count]]
        assert detectable == ("size 0",)
        assert issues == []
        assert [a[1] for a in asked] == nodes[: len(asked)]
        assert [a[2] for a in asked] == pytest.approx([0.1] * len(asked))
        assert made.seen[0] == (0.0, "cutting windows")
        assert made.seen[-1] == (1.0, "done")


def test_a_force_in_the_variables_of_a_corrected_formula_is_its_error(monkeypatch):
    force = UnknownForceFound("a force", 0.3, 0.01, 0.2, None)
    force_is(monkeypatch, lambda *_: force)
    for corrected, most, verdict in (
        (True, 0.25, "effect"),
        (True, 0.15, "none_of_these"),
        (False, 0.25, "none_of_these"),
    ):
        made = procedure(max_form_error=most)
        made.record.form_corrected = corrected
        made.record.findings, made.record.groups = [finding("effect", 0.6, accepted=True)], [("effect",)]
        found = made.conclude(node(3.0), [node(3.0), node(1.2, effects=1)], (), [])
        assert found.verdict == verdict
        assert (found.form_error is not None) is (verdict == "effect")


def test_over_short_windows_time_step_and_nominal_values_stay_as_given(monkeypatch):
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: pytest.fail("a shorter time step is tried"))
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    made, coarse, given = procedure(), [node(5.0), node(3.0), node(2.0)], node(30.0)
    # Beside an effect they are fitted to see whether they explain the rest, and are not kept.
    monkeypatch.setattr(context, "with_nominal_values", lambda one, *_: coarse[2] if one in coarse[1:] else given)
    monkeypatch.setattr(context, "stays_within", lambda *_: True)
    monkeypatch.setattr(
        made.additions.finder, "find", lambda _base, step, **_: (coarse[step + 1] if step < 2 else None, ("size",))
    )
    assert made.additions.add_effects(coarse[:1], (), effects_alone=True) == (coarse, ("size",))
    asked: list[Any] = []

    def add(fitted, detectable, *, effects_alone=False):
        asked.append((fitted, detectable, effects_alone))
        return (coarse if effects_alone else ["long"]), (("size",) if effects_alone else ("other",))

    monkeypatch.setattr(made.additions, "add_effects", add)
    monkeypatch.setattr(made, "coarse_baseline", lambda _given: coarse[0])
    monkeypatch.setattr(made, "carry_over", lambda base, found: [base, *found[1:]])
    monkeypatch.setattr(made.additions, "within_tolerances", lambda _given: None)
    assert made.search(given) == (["long"], ("size",))
    assert asked == [([coarse[0]], (), True), ([given, *coarse[1:]], ("size",), False)]


@pytest.mark.parametrize(
    ("left", "stepped", "step", "found"),
    [(1.0, None, False, "nominal"), (8.0, 1.0, True, "both"), (8.0, 3.0, False, None), (None, None, False, None)],
)
def test_a_model_that_is_far_off_is_first_tried_with_constants_within_their_tolerance(
    monkeypatch, left, stepped, step, found
):
    made, given, finer = procedure(), node(30.0, 900.0), node(29.0, 850.0, timestep=FINER)
    nominal = {
        id(given): None if left is None else node(left, left**2, name="nominal"),
        id(finer): None if stepped is None else node(stepped, stepped**2, name="both", timestep=FINER),
    }
    monkeypatch.setattr(made.additions, "with_holding", lambda one: one)
    monkeypatch.setattr(made.additions, "_nominal", lambda one, *_, **__: nominal[id(one)])
    monkeypatch.setattr(additions, "at_finer_step", lambda *_: finer)
    monkeypatch.setattr(additions, "time_step_finding", lambda *_: "step")
    monkeypatch.setattr(additions, "has_touchable_free_body", lambda _m: False)
    given.model.compile = lambda: None
    one = made.additions.within_tolerances(given)
    assert (None if one is None else one.model.name) == found
    assert made.record.time_step == ("step" if step else None)
    if found is not None:
        asked: list[Any] = []
        monkeypatch.setattr(made.additions, "add_effects", lambda fitted, *_: (asked.append(fitted) or fitted, ()))
        monkeypatch.setattr(made, "coarse_baseline", lambda _given: pytest.fail("short windows"))
        made.search(given)
        assert [[n.model.name for n in fitted] for fitted in asked] == [[found]]


def test_the_answer_starts_with_the_model_as_given(monkeypatch):
    force_is(monkeypatch, lambda *_: None)
    given, finer, added = node(3.0), node(1.2, timestep=FINER), node(1.0, timestep=FINER, effects=1)
    found = procedure().conclude(given, [finer, added], (), ())
    assert found.ratio == (30.0, 12.0, 10.0)
    assert found.models == (given.delivered, finer.delivered, added.delivered)
    assert procedure().conclude(given, [given], (), ()).ratio == (30.0,)


def test_noise_that_may_be_larger_than_its_estimate_leaves_a_model_adequate(monkeypatch):
    force_is(monkeypatch, lambda *_: None)
    for ratio, factor, verdict in ((1.8, 1.5, "none_needed"), (1.8, 1.4, "none_of_these"), (1.8, 1.0, "none_of_these")):
        made = procedure()
        made.context.noise_factors = {"angle": factor}
        assert made.conclude(node(ratio), [node(ratio)], (), ()).verdict == verdict


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


@pytest.mark.parametrize(("count", "scale"), [(1, 20.0), (2, 20.0), (3, 1.0)])
def test_the_noise_stays_where_windows_would_be_shorter_with_the_error_in_its_place(monkeypatch, count, scale):
    made, (window, *_) = procedure(), windows_of(RECORDING)
    monkeypatch.setattr(module, "channel_noises", lambda *_: {"angle": 0.002})
    monkeypatch.setattr(module, "observe", lambda *_, noise, **_k: [window] * (2 if noise["angle"] == 0.002 else count))
    monkeypatch.setattr(module, "has_touchable_free_body", lambda _: True)
    monkeypatch.setattr(made, "_refitted", lambda _model, windows: SimpleNamespace(noise_ratio=60.0, windows=windows))
    assert [w.noise_scale for w in made.baseline().windows] == [scale] * (2 if scale == 1 else count)
    assert made.noise_scale == scale


def test_additions_that_explain_nothing_over_longer_windows_are_taken_back(monkeypatch):
    made = procedure()
    made.record.groups, made.record.hypotheses = [("a",), ("b",), ("c",)], [{"a": 1}, {"b": 2}, {"c": 3}]
    made.record.findings = [finding("a", 0.5), finding("b", 0.4, step=1), finding("c", 0.3, step=2)]
    made.record.findings.append(finding("x", 0.1, accepted=False, reason="no better than chance"))
    errors = {"after a": 10.0, "after b": 9.6, "after c": 1.0}
    monkeypatch.setattr(made, "_refitted", lambda model, _: node(1.0, errors[model.name], name=model.name))
    base = node(30.0, 100.0, name="given")
    after = made.carry_over(base, [base, *(node(1.0, name=name) for name in errors)])
    assert [one.model.name for one in after] == ["given", "after a"]
    assert (made.record.groups, made.record.hypotheses) == ([("a",)], [{"a": 1}])
    reason = "explains nothing more over longer windows"
    assert [(f.name, f.accepted, f.reason) for f in made.record.findings] == [
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
    made.record.groups = groups
    made.record.findings = [
        finding("late", 0.95, accepted=added, step=1), finding("no", 0.98, accepted=False),
        finding("first", 0.96, accepted=added), finding("less", 0.97, accepted=False),
        finding("later", 0.96, accepted=False, step=1),
    ]  # fmt: skip
    # A share below zero stands for an error of form.
    force = None if unknown is None else SimpleNamespace(share=abs(unknown), form_error=unknown < 0, varies=False)
    force_is(monkeypatch, lambda nodes, _cfg, _results: force if len(nodes) else None)
    nodes = [node(r, name=str(r)) for r in ratios]
    found = made.conclude(nodes[0], nodes, ("size",), ["a gap"])
    assert found.verdict == verdict
    assert found.unexplained == pytest.approx(unexplained)
    assert found.ratio == tuple(10 * r for r in ratios)
    order = ["first", "late", "no", "less", "later"] if added else ["no", "less", "first", "later", "late"]
    assert [f.name for f in found.effects] == order
    assert found.groups == tuple(groups)
    assert (found.detectable, found.issues, found.seed) == (("size",), ("a gap",), 0)
    assert [m.name for m in found.models] == [f"delivered {r}" for r in ratios]
    assert (found.where, found.next_experiment) == ((), None)
    assert found.form_error == (pytest.approx(unexplained) if form_error else None)
    # Where much more than noise is left, no force of unknown form is needed to show that something is missing.
    tested = ratios[-1] <= 1.1 or ratios == (5.0, 1.3) or form_error
    assert found.unknown_force is (force if tested else None)


@pytest.mark.parametrize(
    ("gains", "ratio", "verdict"),
    [
        ((0.97, 0.9), 1.45, "effect"),  # 6 % of what is left without the second one
        ((0.97, 0.7), 1.45, "none_of_these"),  # 18 %
        ((0.7, 0.97), 1.45, "none_of_these"),
        ((0.97, 0.06), 1.05, "effect"),  # little more than noise
        ((0.7,), 1.45, "effect"),  # a single one is compared with the model as given
    ],
)
def test_of_several_effects_none_leaves_a_part_of_what_is_left_without_it(monkeypatch, gains, ratio, verdict):
    force_is(monkeypatch, lambda *_: None)
    made = procedure()
    made.record.findings = [finding(str(k), gain, step=k) for k, gain in enumerate(gains)]
    made.record.groups = [(f.name,) for f in made.record.findings]
    given = node(12.0)
    fitted = [given, *(node(ratio, effects=1 + k) for k in range(len(gains)))]
    assert made.conclude(given, fitted, (), ()).verdict == verdict


def test_what_is_left_is_no_error_of_form_where_no_effect_was_accepted(monkeypatch):
    force_is(monkeypatch, lambda *_: pytest.fail("no effect has a formula"))
    for findings in ([], [finding("no", 0.9, accepted=False)]):
        made = procedure()
        made.record.findings = findings
        found = made.conclude(node(5.0), [node(5.0), node(1.3)], (), ())
        assert (found.verdict, found.form_error) == ("none_of_these", None)


def test_failures_and_an_experiment_explain_what_was_found(monkeypatch):
    asked: list[Any] = []
    said = Replayed(40.0, 1.5, 0.3, False)
    replays: list[tuple[Any, ...]] = []
    monkeypatch.setattr(module, "replayed", lambda *args: replays.append(args) or said)
    force_is(monkeypatch, lambda *_: None)
    monkeypatch.setattr(module, "locate_failures", lambda *args, **more: asked.append((args, more)) or [{"span": 1}])
    monkeypatch.setattr(module, "suggest_experiment", lambda *args, **more: asked.append((args, more)) or "experiment")
    made = procedure(explain=True, seed=7)
    made.record.hypotheses = [{"a": MODEL}, {"b": MODEL, "c": MODEL}, {"d": MODEL, "e": MODEL}]
    given, last = node(3.0, name="given"), node(1.0)
    found = made.conclude(given, [given, last], (), ())
    assert (found.where, found.next_experiment, found.replayed) == (({"span": 1},), "experiment", said)
    limit = made.context.cfg.doubtful_replay
    assert replays == [(given.delivered, last.delivered, RECORDING, last.windows, limit, "mujoco")]
    (model, recording, cfg), more = asked[0]
    assert (model.name, recording) == ("delivered given", RECORDING)
    assert cfg == made.context.cfg.failures
    assert more == {"engine": "mujoco", "windows": given.windows, "offsets": "o"}
    (models, recording, cfg), more = asked[1]
    assert (models, recording, cfg.seed, more) == (made.record.hypotheses[1], RECORDING, 7, {"engine": "mujoco"})
    asked.clear()
    lone = procedure(explain=True)
    lone.record.hypotheses = [{"a": MODEL}]
    assert lone.conclude(node(3.0), [node(3.0), node(1.0)], (), ()).next_experiment is None
    none = procedure(explain=True)
    settled = none.conclude(node(1.0), [node(1.0)], (), ())
    assert (settled.where, settled.replayed) == ((), None)
    assert len(asked) == 1
