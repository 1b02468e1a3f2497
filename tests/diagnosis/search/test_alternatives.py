"""The search continued from a rival of the first of several effects: a pendulum with a hidden damping and delay.

Of a lag, a delay and a damping, the lag explains most while both others are missing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis import procedure
from concent_warp.diagnosis.candidates.baseline import add_candidate, fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg, NominalCfg, SearchCfg
from concent_warp.diagnosis.constants import FinerTimeStep
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import Diagnosis, Finding
from concent_warp.diagnosis.search import alternatives as module
from concent_warp.diagnosis.search import context
from concent_warp.diagnosis.search.alternatives import _from, log_odds, plausibility, try_alternatives
from concent_warp.diagnosis.search.reconsider import Rival, beside
from concent_warp.effects.effect import Effect
from concent_warp.effects.library.joints import JointDamping
from concent_warp.effects.library.nominal import NominalGain
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.simulate.time_limit import TimeUpError
from tests.scenes.swinging import DAMPING, drawing, swung, windows_of

DELAY = 0.03
"""From a command to the servo [s]."""
RECORDING = swung(seconds=3.0, delay=DELAY)
EFFECTS = ("joint_damping", "actuator_delay", "actuator_lag")


def searching(alternatives: int, *, recording=RECORDING, max_additions: int = 3) -> Procedure:
    """Return a procedure that looks for a lag, a delay and a damping, from some rivals of the first."""
    cfg = DiagnoseCfg(
        jobs=1, explain=False, effects=EFFECTS, max_additions=max_additions, nominal=NominalCfg(enabled=False),
        search=SearchCfg(alternatives=alternatives),
    )  # fmt: skip
    return Procedure(drawing(recording), recording, cfg)


def names(one: FittedModel) -> list[str]:
    return [added.effect.name for added in one.model.effects]


def accepted(made: Procedure) -> list[str]:
    return [f.name for f in made.record.findings if f.accepted]


@pytest.fixture(scope="module")
def greedy() -> tuple[Procedure, list[FittedModel]]:
    """Return a search that adds one effect after another, and its fitted models."""
    made = searching(0)
    return made, made.search(made.baseline())[0]


@pytest.fixture(scope="module")
def continued() -> Diagnosis:
    """Return the diagnosis whose search is continued from the best rival of the first effect."""
    return searching(1).run()


def resumed(greedy: tuple[Procedure, list[FittedModel]], alternatives: int) -> Procedure:
    """Return a procedure with what such a search has recorded."""
    made = searching(alternatives)
    made.context.record, made.noise = greedy[0].record.copy(), greedy[0].noise
    made.context.noise_factors = greedy[0].context.noise_factors
    return made


def test_an_effect_that_stands_for_parts_of_others_comes_first_where_one_is_added_after_another(greedy):
    made, fitted = greedy
    assert [r.finding.name for r in made.record.rivals[0]] == ["actuator_lag", "actuator_delay", "joint_damping"]
    assert [names(one)[-1:] for one in fitted] == [[], ["actuator_lag"], ["joint_damping"], ["actuator_delay"]]
    assert accepted(made) == ["actuator_lag", "joint_damping", "actuator_delay"]


def test_the_search_from_its_best_rival_finds_the_effects_that_are_missing(continued):
    assert continued.verdict == "effect"
    assert [(f.name, f.step) for f in continued.accepted] == [("actuator_delay", 0), ("joint_damping", 1)]
    delay, damping = (f.parameters[0] for f in continued.accepted)
    assert delay.low < DELAY < delay.high
    assert damping.low < DAMPING < damping.high
    # One ratio for the model as given and each addition: none of the first search.
    assert len(continued.ratio) == len(continued.models) == 3
    assert continued.ratio[-1] == pytest.approx(1.0, abs=0.05)
    assert continued.groups == (("actuator_delay",), ("joint_damping",))


def test_findings_are_those_of_the_answer_alone(continued):
    first = [f for f in continued.effects if f.step == 0]
    assert sorted(f.name for f in first) == sorted(EFFECTS)
    (lag,) = (f for f in first if f.name == "actuator_lag")
    assert (lag.accepted, lag.reason) == (False, "another one explains more beside the others")
    assert {f.step for f in continued.effects} == {0, 1}


def test_an_alternative_that_leaves_more_changes_nothing(greedy, monkeypatch):
    made, fitted = resumed(greedy, 1), greedy[1]
    before = made.record.copy()
    monkeypatch.setattr(made.additions, "add_effects", lambda begun, _: (begun, ()))  # it finds no second effect
    assert try_alternatives(made.additions, fitted) is fitted
    assert made.record == before


def test_beyond_the_noise_the_plausible_answer_counts_and_not_the_one_that_leaves_least(greedy, monkeypatch):
    # The other answer leaves 10 % more. Its plausibility decides where that may be an error in formulas.
    for ratio, plausible, taken in ((1.05, 5.0, True), (1.05, -5.0, False), (1.2, 5.0, True), (2.1, 5.0, False)):
        made, fitted = resumed(greedy, 1), greedy[1]
        other = replace(fitted[-1], errors=1.1 * fitted[-1].errors)
        monkeypatch.setattr(FittedModel, "ratio", property(lambda one, o=other, r=ratio: r if one is o else 1.0))
        monkeypatch.setattr(made.additions, "add_effects", lambda begun, _, other=other: ([*begun, other], ()))
        monkeypatch.setattr(module, "plausibility", lambda one, o=other, p=plausible: p if one is o else 0.0)
        assert (try_alternatives(made.additions, fitted)[-1] is other) is taken


def test_as_many_rivals_are_tried_as_asked_for_and_none_of_the_group_of_the_first(greedy, monkeypatch):
    for alternatives, group, tried in (
        (0, ("actuator_lag",), []),
        (1, ("actuator_lag",), ["actuator_delay"]),
        (2, ("actuator_lag",), ["actuator_delay", "joint_damping"]),
        (9, ("actuator_lag",), ["actuator_delay", "joint_damping"]),
        (1, ("actuator_lag", "actuator_delay"), ["joint_damping"]),
    ):
        made, begun = resumed(greedy, alternatives), []
        made.record.provisional = 1
        assert made.record.time_step is None
        made.record.groups = [group, *made.record.groups[1:]]

        def add(fitted, _, begun=begun, made=made):
            begun.append(names(fitted[-1])[-1])
            # Each begins with its own effect, and with nothing of an earlier one.
            assert accepted(made) == begun[-1:]
            assert made.record.groups == [(begun[-1],)]
            assert list(made.record.rivals) == [0]
            assert made.record.provisional is None
            assert made.record.time_step is None
            made.record.time_step = FinerTimeStep(0.01, 0.002, 1.0, 0.5, 0.4, 0.6)
            return fitted, ()

        monkeypatch.setattr(made.additions, "add_effects", add)
        try_alternatives(made.additions, greedy[1])
        assert begun == tried
        assert made.record.groups[0] == group
        assert (made.record.provisional, made.record.time_step) == (1, None)


def test_a_single_effect_that_explains_the_data_has_no_alternatives(monkeypatch):
    monkeypatch.setattr(procedure, "try_alternatives", lambda *_: pytest.fail("it explains the data"))
    made = searching(1, recording=swung(seconds=3.0))
    made.search(made.baseline())
    assert accepted(made) == ["joint_damping"]


def test_a_single_effect_that_leaves_more_than_noise_has_alternatives(monkeypatch):
    # One effect may be added: the lag leaves what it does not imitate of damping and delay.
    tried = []
    monkeypatch.setattr(procedure, "try_alternatives", lambda _, fitted: tried.append(names(fitted[-1])) or fitted)
    made = searching(1, max_additions=1)
    made.search(made.baseline())
    assert tried == [["actuator_lag"]]


def begun_from(
    greedy: tuple[Procedure, list[FittedModel]], monkeypatch, *, noisy: bool, parallel: bool, far_ratio: float = 20.0
) -> list[str]:
    """Return the rivals from which a search is continued.

    Args:
        greedy: The search.
        monkeypatch: Of the test.
        noisy: Whether all answers leave more than noise.
        parallel: Whether the second rival takes from the residuals what the first one takes.
        far_ratio: Setting of the search.
    """
    made, begun = resumed(greedy, 1), []
    made.context.cfg = replace(made.context.cfg, search=replace(made.context.cfg.search, far_ratio=far_ratio))
    axes = np.eye(2)
    removed = {"actuator_lag": axes[0], "actuator_delay": axes[0], "joint_damping": axes[0 if parallel else 1]}
    rivals = tuple(replace(r, removed=removed[r.finding.name]) for r in made.record.rivals[0])
    made.record.rivals = {**made.record.rivals, 0: rivals}
    monkeypatch.setattr(module, "is_near_noise", lambda *_: not noisy)
    monkeypatch.setattr(
        made.additions, "add_effects", lambda fitted, _: (begun.append(names(fitted[-1])[-1]) or fitted, ())
    )
    try_alternatives(made.additions, greedy[1])
    return begun


def test_more_rivals_are_tried_while_all_answers_leave_more_than_noise(greedy, monkeypatch):
    with monkeypatch.context() as patch:
        assert begun_from(greedy, patch, noisy=False, parallel=False) == ["actuator_delay"]
    assert begun_from(greedy, monkeypatch, noisy=True, parallel=False) == ["actuator_delay", "joint_damping"]


def test_no_rival_is_tried_where_the_answer_is_far_off_and_leaves_much(greedy, monkeypatch):
    last, given = greedy[1][-1].noise_ratio, greedy[1][0]
    assert begun_from(greedy, monkeypatch, noisy=True, parallel=False, far_ratio=1.1 * last)
    assert begun_from(greedy, monkeypatch, noisy=True, parallel=False, far_ratio=0.5 * last)  # it leaves little
    monkeypatch.setattr(context, "discrepancies", lambda _, first: (0.3, 1.0) if first is given else (0.0, 1.0))
    assert not begun_from(greedy, monkeypatch, noisy=True, parallel=False, far_ratio=0.5 * last)


def test_a_rival_that_takes_away_what_an_earlier_one_does_is_not_tried(greedy, monkeypatch):
    assert begun_from(greedy, monkeypatch, noisy=True, parallel=True) == ["actuator_delay"]


def test_rivals_are_alike_by_the_angle_between_what_they_take_away(base):
    one = rival_of(added(base, JointDamping("hinge")))
    for removed, alike in (([1.0, 0.1], True), ([5.0, 0.5], True), ([1.0, 1.0], False), ([-1.0, 0.0], False)):
        other = replace(one, removed=np.array(removed))
        assert replace(one, removed=np.array([1.0, 0.0])).is_like(other, 0.95) is alike


def test_an_alternative_that_there_is_no_time_for_is_named_and_the_answer_stays(greedy, monkeypatch):
    made, fitted = resumed(greedy, 1), greedy[1]

    def late(*_):
        raise TimeUpError

    monkeypatch.setattr(made.additions, "add_effects", late)
    assert try_alternatives(made.additions, fitted) is fitted
    assert made.context.budget.unsettled == ["Open: whether actuator_delay with another effect explains more."]
    assert made.context.budget.cut == set()
    assert accepted(made) == accepted(greedy[0])


def test_a_search_from_a_rival_begins_with_that_effect_alone(greedy):
    made, (first, *_) = resumed(greedy, 1), greedy[1]
    made.context.cfg = replace(made.context.cfg, max_additions=1)
    rival = next(r for r in made.record.rivals[0] if r.finding.name == "joint_damping")
    _, begun = _from(made.additions, first, rival)
    assert names(begun) == accepted(made) == ["joint_damping"]
    assert {f.step for f in made.record.findings} == {0}
    assert (made.record.groups, list(made.record.hypotheses[0])) == ([("joint_damping",)], ["joint_damping"])
    assert made.record.hypotheses[0]["joint_damping"] is begun.model
    assert [w.tolist() for w in made.record.widening.values()] == [[1.0]]


@pytest.fixture(scope="module")
def base() -> FittedModel:
    """Return a pendulum that lacks its damping, fitted."""
    recording = swung(seconds=1.0)
    windows = windows_of(recording)
    return fit_baseline(drawing(recording), windows, cut_blocks(windows))


def added(base: FittedModel, effect: Effect) -> FittedModel:
    """Return a fitted model with an effect."""
    return add_candidate(base, fit_candidate(base, screen(base, effect)))


def rival_of(one: FittedModel) -> Rival:
    """Return the last effect of a fitted model as a rival."""
    evidence = Finding("rival", (), "", (), 0.5, 0.4, 0.6, 0.01, 0.01, False, 0, ())
    return Rival(evidence, one.model.effects[-1], one.fit)


def test_a_rival_is_added_from_where_its_fit_ended(base):
    damped = added(base, JointDamping("hinge"))
    found = beside(base, rival_of(damped))
    assert names(found) == ["joint_damping"]
    assert found.fit.values == pytest.approx([DAMPING], rel=0.05)
    assert found.fit.cost <= 1.001 * damped.fit.cost
    assert found.errors.sum() < 0.1 * base.errors.sum()


def test_over_other_windows_a_rival_has_the_initial_states_of_the_model(base):
    damped, windows = added(base, JointDamping("hinge")), windows_of(swung(seconds=1.0), 0.5)
    cut = fit_baseline(base.model, windows, cut_blocks(windows))
    assert len(cut.fit.offsets) == 2 * len(damped.fit.offsets)
    found = beside(cut, rival_of(damped))
    assert len(found.fit.offsets) == len(windows)
    assert found.fit.values == pytest.approx([DAMPING], rel=0.05)


def at(one: FittedModel, value: float) -> FittedModel:
    """Return a fitted model with its only parameter at a value, its errors as they are."""
    return replace(one, fit=replace(one.fit, values=np.array([value])))


def test_an_effect_is_the_more_plausible_the_more_it_explains_and_costs_the_logarithm_of_the_blocks(base):
    damped, count = added(base, JointDamping("hinge")), base.blocks.count
    assert plausibility(damped) > plausibility(base) + 10
    assert plausibility(base) == pytest.approx(-count * np.log(base.errors.sum()))
    idle = at(replace(damped, errors=base.errors), 0.0)
    assert plausibility(base) - plausibility(idle) == pytest.approx(np.log(count))
    half = replace(base, errors=base.errors / 2)
    assert plausibility(half) - plausibility(base) == pytest.approx(count * np.log(2))


def test_each_parameter_of_an_effect_counts(base):
    effect = effect_class("stribeck_friction")("hinge")
    parameters = base.solver(effect).p.parameters
    assert len(parameters) > 1
    rubbed = fit_baseline(base.model.add(effect, [p.null for p in parameters]), base.windows, base.blocks)
    idle = replace(rubbed, errors=base.errors, fit=replace(rubbed.fit, values=np.array([p.null for p in parameters])))
    expected = len(parameters) * np.log(base.blocks.count) + effect.rarity
    assert plausibility(base) - plausibility(idle) == pytest.approx(expected)


def test_larger_effects_and_rare_ones_are_less_plausible(base, monkeypatch):
    damped = added(base, JointDamping("hinge"))
    (scale,) = (p.scale for p in damped.prediction().parameters)
    least, large = plausibility(at(damped, 0.0)), plausibility(at(damped, 3 * scale))
    assert least - large == pytest.approx(2 * np.log(10))  # Cauchy's density, squared for twice its logarithm
    monkeypatch.setattr(JointDamping, "rarity", 6.0)
    assert least - plausibility(at(damped, 0.0)) == pytest.approx(6.0)


def test_nominal_values_cost_what_they_are_off_and_nothing_for_their_number(base):
    gain = added(base, NominalGain("servo"))
    ((scale, null),) = ((p.scale, p.null) for p in gain.prediction().parameters)
    same = -base.blocks.count * np.log(gain.errors.sum())
    assert plausibility(at(gain, null)) == pytest.approx(same)
    prior = gain.cfg.least_squares.prior
    assert plausibility(at(gain, null)) - plausibility(at(gain, null + 2 * scale)) == pytest.approx(4 / prior**2)


def test_of_errors_in_formulas_the_amounts_count_once_and_not_once_a_block(base, monkeypatch):
    damped, cfg = added(base, JointDamping("hinge")), DiagnoseCfg()
    other = replace(damped, errors=1.2 * damped.errors)
    by_blocks = -base.blocks.count * np.log(1.2)
    assert log_odds(other, damped, None, cfg) == pytest.approx(by_blocks)
    for left, odds in (((0.4, 0.2), 2 * np.log(0.5)), ((0.2, 0.01), 2 * np.log(0.25)), ((9.0, 0.0), by_blocks)):
        others, best = left
        monkeypatch.setattr(module, "discrepancies", lambda one, _, a=others, b=best: (b if one is damped else a, 8.0))
        assert log_odds(other, damped, base, cfg) == pytest.approx(max(odds, by_blocks))
        # The rest of what makes an answer plausible counts as before.
        assert log_odds(at(other, 0.5), damped, base, cfg) - log_odds(at(other, 0.0), damped, base, cfg) == (
            pytest.approx(plausibility(at(other, 0.5)) - plausibility(at(other, 0.0)))
        )


def settled(greedy: tuple[Procedure, list[FittedModel]], monkeypatch, answer: FittedModel, odds: float) -> Any:
    """Return a procedure after an alternative that has a damping and a delay beside those of the first search.

    Args:
        greedy: That search.
        monkeypatch: Of the test.
        answer: Last model of the alternative.
        odds: By how much the alternative is the more plausible, twice the logarithm.
    """
    made = resumed(greedy, 1)
    last = greedy[1][2]
    made.record.groups, made.record.hypotheses = made.record.groups[:2], made.record.hypotheses[:2]
    made.record.findings = [f for f in made.record.findings if f.step < 2]
    assert accepted(made) == ["actuator_lag", "joint_damping"]

    def add(begun, _):
        (damping,) = (f for f in greedy[0].record.findings if f.accepted and f.name == "joint_damping")
        made.record.findings = [*made.record.findings, damping]
        made.record.groups, made.record.hypotheses = (
            [*made.record.groups, ("joint_damping",)],
            [*made.record.hypotheses, {}],
        )
        return [*begun, answer], ()

    monkeypatch.setattr(made.additions, "add_effects", add)
    monkeypatch.setattr(module, "plausibility", lambda one: odds if one is answer else 0.0)
    return made, try_alternatives(made.additions, greedy[1][:3])[-1], last


def test_the_more_plausible_of_answers_that_explain_as_much_counts(greedy, monkeypatch):
    for odds, chosen in ((100.0, "actuator_delay"), (-100.0, "actuator_lag")):
        answer = replace(greedy[1][2])
        made, found, last = settled(greedy, monkeypatch, answer, odds)
        assert found is (answer if odds > 0 else last)
        assert accepted(made) == [chosen, "joint_damping"]
        # The other is so much less plausible that it is not named.
        assert made.record.groups == [(chosen,), ("joint_damping",)]


def test_the_effect_of_an_answer_that_is_nearly_as_plausible_joins_the_group_of_the_one_it_replaces(
    greedy, monkeypatch
):
    limit = 2 * float(np.log(SearchCfg().max_odds))
    for odds, named in ((-0.99 * limit, True), (-1.01 * limit, False)):
        answer = replace(greedy[1][2])
        made, _, _ = settled(greedy, monkeypatch, answer, odds)
        assert accepted(made) == ["actuator_lag", "joint_damping"]
        assert made.record.groups == [
            ("actuator_lag", "actuator_delay") if named else ("actuator_lag",),
            ("joint_damping",),
        ]
        assert (made.record.hypotheses[0].get("actuator_delay") is answer.model) == named
        assert "actuator_delay" not in greedy[0].record.hypotheses[0]


def test_a_more_plausible_answer_that_leaves_more_does_not_count(greedy, monkeypatch):
    for more, chosen in ((1.019, "actuator_delay"), (1.021, "actuator_lag")):  # within 2 %
        answer = replace(greedy[1][2], errors=more * greedy[1][2].errors)
        made, found, _ = settled(greedy, monkeypatch, answer, 100.0)
        assert (found is answer) == (chosen == "actuator_delay")
        assert accepted(made)[0] == chosen


def test_an_answer_that_leaves_less_counts_whatever_its_plausibility(greedy, monkeypatch):
    answer = replace(greedy[1][2], errors=0.5 * greedy[1][2].errors)
    made, found, _ = settled(greedy, monkeypatch, answer, -100.0)
    assert found is answer
    assert accepted(made) == ["actuator_delay", "joint_damping"]
    assert made.record.groups == [("actuator_delay",), ("joint_damping",)]
