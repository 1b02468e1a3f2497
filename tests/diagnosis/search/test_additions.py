"""Effects, shorter time steps and nominal values added one after the other, with fits that are made up."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import NominalCfg
from concent_warp.diagnosis.search import additions, context, nominal_values
from concent_warp.diagnosis.search.adequacy import is_lacking
from concent_warp.effects.effect import Parameter
from concent_warp.simulate.time_limit import TimeUpError
from tests.diagnosis.made_up import FINER, GIVEN, Comparison, finding, node, procedure


def one_after_the_other(made, nodes):
    """Return a search that finds and records an effect at each step, fitted as the next node."""

    def find(_base, step, **_):
        made.record.groups.append((f"effect {step}",))
        made.record.hypotheses.append({})
        made.record.findings.append(finding(f"effect {step}", 0.6, accepted=True, step=step))
        return nodes[step + 1], ()

    return find


def test_noise_that_may_be_larger_than_its_estimate_ends_the_search(monkeypatch):
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    for ratios, factor, count in (
        ((3.0, 1.53, 1.0), 1.5, 2),  # 1.02 x the largest noise
        ((3.0, 1.55, 1.0), 1.5, 3),
        ((3.0, 1.53, 1.0), 1.0, 3),
        ((5.0, 1.26, 1.0), 1.01, 3),  # adequate beside it, but more than the noise may be
        ((1.5, 1.0), 1.5, 2),
    ):
        made, nodes = procedure(), [node(r) for r in ratios]
        made.context.noise_factors = {"angle": factor}
        monkeypatch.setattr(made.additions.finder, "find", lambda _base, step, nodes=nodes, **_: (nodes[step + 1], ()))
        assert made.additions.add_effects(nodes[:1], ())[0] == nodes[:count]
        assert is_lacking(node(1.02 * factor), made.context.noise_factors, made.context.cfg) is False
        assert is_lacking(node(1.03 * factor), made.context.noise_factors, made.context.cfg)


def test_what_the_noise_may_be_at_most_is_left_to_nominal_values_first(monkeypatch):
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(additions, "stays_within", lambda *_: True)
    better, asked = node(1.0, nominal=1, effects=1), []

    def nominal(one, *_):
        asked.append(one)
        return better if one.ratio < 3.0 else None

    monkeypatch.setattr(context, "with_nominal_values", nominal)
    for ratio, found in ((1.4, better), (1.01, None)):  # of a noise that is half as large again, at most
        made, nodes = procedure(), [node(3.0), node(ratio, effects=1)]
        made.context.noise_factors = {"angle": 1.5}
        monkeypatch.setattr(made.additions.finder, "find", lambda _base, step, nodes=nodes, **_: (nodes[step + 1], ()))
        monkeypatch.setattr(made.additions, "with_holding", lambda one: one)
        asked.clear()
        assert made.additions.add_effects(nodes[:1], ())[0] == [nodes[0], found or nodes[1]]
        assert (nodes[1] in asked) == (found is not None)


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

    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(additions, "renew_defects", lambda one, _cfg: one)
    monkeypatch.setattr(additions, "with_interleaved_folds", lambda one: one)
    monkeypatch.setattr(made.additions.finder, "find", one_after_the_other(made, nodes))
    errors = None if corrected is None else np.array([corrected / 2] * 2)
    monkeypatch.setattr(made.additions, "_correction", lambda one, _first: None if one is nodes[0] else errors)
    monkeypatch.setattr(made.additions, "_explains_more", lambda *_: explains_more)
    assert made.additions.add_effects(nodes[:1], ())[0] == nodes[: 2 + added]
    assert made.record.form_corrected is form
    assert made.record.groups == [("effect 0",), ("effect 1",)][: 1 + added]
    first, second = made.record.findings
    assert first.accepted
    assert second.accepted is added
    assert second.reason == ("" if added else "explains no more than a flexible correction of the effects before it")


@pytest.mark.parametrize(
    ("left", "size", "added"),
    [
        (30.0, 80.0, False),  # 9 % of the discrepancy, by a size that hardly any machine has
        (30.0, -80.0, False),
        (30.0, 20.0, True),
        (60.0, 80.0, True),  # 36 % is more than an error in a formula
    ],
)
def test_a_small_remainder_is_not_explained_by_a_size_far_beyond_typical_ones(monkeypatch, left, size, added):
    made, nodes = procedure(), [node(100.0), node(left, effects=1), node(1.0, effects=2)]
    typical = Parameter("scale", "-", 0.0, -5.0, 5.0, 0.03)
    nodes[1].prediction = lambda _effect: SimpleNamespace(owned=1, parameters=(typical, typical))
    nodes[2].fit.values = np.array([9.0, size * typical.scale])

    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(additions, "renew_defects", lambda one, _cfg: one)
    monkeypatch.setattr(made.additions.finder, "find", one_after_the_other(made, nodes))
    assert made.additions.add_effects(nodes[:1], ())[0] == nodes[: 2 + added]
    assert made.record.findings[1].accepted is added
    assert ("far beyond typical" in made.record.findings[1].reason) is not added


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
            made.record.groups.append(("effect",))
            made.record.findings.append(finding("effect", 0.6, step=step))
            return effect, ()

        monkeypatch.setattr(made.additions.finder, "find", find)
        monkeypatch.setattr(additions, "finer_time_step", lambda one, _cfg, rivals=rivals: rivals.get(id(one)))
        monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
        monkeypatch.setattr(additions, "time_step_finding", lambda *_: "found")
        monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
        fitted, _ = made.additions.add_effects([given], ())
        assert len(calls) == asked
        assert [("effect" if one is effect else one.timestep) for one in fitted] == left
        assert made.record.groups == [("effect",)] * (len(fitted) - 1)
        assert len(made.record.findings) == len(fitted) - 1
        assert made.record.time_step == ("found" if left[0] == FINER else None)


@pytest.mark.parametrize(("errors", "used"), [(9.0, True), (11.0, False)])
def test_a_shorter_time_step_that_explains_nearly_all_comes_before_an_effect_that_explains_more(
    monkeypatch, errors, used
):
    given, finer, bases = node(10.0, 100.0), node(3.0, errors, timestep=FINER), []

    def find(base, _step, **_):
        bases.append(base)
        made.record.groups.append(("effect",))
        made.record.findings.append(finding("effect", 0.9))
        return node(1.0, 2.0, effects=1), ()

    made = procedure(max_additions=1)
    monkeypatch.setattr(made.additions.finder, "find", find)
    monkeypatch.setattr(additions, "finer_time_step", lambda one, _cfg: finer if one is given else None)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "time_step_finding", lambda *_: "found")
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    fitted, _ = made.additions.add_effects([given], ())
    assert [one is (finer if used else given) for one in bases] == [True]
    assert fitted[0] is bases[0]
    assert made.record.time_step == ("found" if used else None)


def test_nominal_values_are_fitted_with_the_shorter_time_step_where_both_explain_more(monkeypatch):
    given, finer = node(3.0, 100.0), node(2.0, 60.0, timestep=FINER)
    both, plain = node(1.0, 28.0, timestep=FINER, nominal=2), node(1.01, 30.0, nominal=1)
    close = node(1.0, 29.0, timestep=FINER, nominal=2)
    monkeypatch.setattr(additions, "finer_time_step", lambda one, _cfg: finer if one is given else None)
    monkeypatch.setattr(additions, "time_step_finding", lambda base, one, seed: (base, one, seed))
    for answers, left, changed in (
        ({id(finer): both, id(given): plain}, both, True),
        ({id(finer): both}, both, True),
        ({id(finer): close, id(given): plain}, plain, False),  # nominal values stand in for the step
        ({id(given): plain}, plain, False),
        ({}, given, False),
    ):
        made = procedure(seed=5)
        monkeypatch.setattr(context, "with_nominal_values", lambda one, *_, answers=answers: answers.get(id(one)))
        monkeypatch.setattr(made.additions.finder, "find", lambda *_, **_k: (None, ()))
        fitted, _ = made.additions.add_effects([given], ())
        if answers:
            assert fitted == [left]
            assert made.record.time_step == ((given, finer, 5) if changed else None)
        else:  # then the shorter time step alone is the rival of the effects, of which none was accepted
            assert fitted == [finer]
    disabled = procedure(nominal=NominalCfg(enabled=False))
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: pytest.fail("nominal values stay as given"))
    assert disabled.additions._with_nominal([given], finer, given) is None


def test_over_short_windows_no_further_effect_is_tried_on_an_error_of_form(monkeypatch):
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    made, coarse = procedure(), [node(5.0), node(1.26), node(1.0)]
    monkeypatch.setattr(made.additions.finder, "find", lambda _base, step, **_: (coarse[step + 1], ()))
    assert made.additions.add_effects(coarse[:1], (), effects_alone=True) == (coarse[:2], ())
    assert made.record.provisional is None


def test_nominal_values_may_be_at_their_bounds_beside_an_effect_with_an_error_of_form(monkeypatch):
    given, after, asked = node(5.0), node(2.0, effects=1), []

    def nominal(one, cfg, min_gain, sensitivities, dependent):
        assert (sensitivities, dependent) == ("shared", one is after)
        # Far from the noise they must explain a fifth; as near as an error of form leaves, what an effect must.
        assert (cfg, min_gain) == (made.context.cfg.nominal, 0.2 if one is given else 0.04)
        return one

    def within(_found, _cfg, enough):
        asked.append([enough(node(r)) for r in (1.2, 1.26, 1.5, 1.8)])
        return True

    monkeypatch.setattr(context, "with_nominal_values", nominal)
    monkeypatch.setattr(additions, "stays_within", within)
    made = procedure(min_gain=0.04)
    monkeypatch.setattr(made.additions, "with_holding", lambda one: one)
    made.additions._with_nominal([given], None, given)
    made.additions._with_nominal([given, after], None, given)
    # 1.8, 2.4, 5.2 and 9.3 % of the discrepancy.
    assert asked == [[True, False, False, False], [True, True, True, False]]


@pytest.mark.parametrize(
    ("held", "inside", "tried", "left", "holding"),
    [
        ("held", ("held", "finer"), "", "held", ("joints",)),
        ("held", (), "held", None, ()),
        ("held", ("values",), "held", "values", ()),  # what holds has led a value to its bound
        ("values", ("values",), "", "values", ()),  # nothing that holds explains more
        ("held", ("finer", "values"), "held", "finer", ("joints",)),  # with a shorter time step it has not
        ("values", ("finer",), "values", "finer", ()),
    ],
)
def test_friction_that_holds_and_a_shorter_time_step_are_tried_beside_nominal_values(
    monkeypatch, held, inside, tried, left, holding
):
    made, given = procedure(), node(9.0, 900.0)
    nodes = {"values": node(1.7, 60.0, nominal=1), "held": node(1.2, 20.0, nominal=1), "finer": node(1.0, 15.0)}
    shortened = []
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: nodes["values"])
    monkeypatch.setattr(additions, "finer_time_step", lambda one, _cfg: shortened.append(one) or nodes["finer"])
    monkeypatch.setattr(additions, "time_step_finding", lambda one, finer, _seed: (one, finer))
    monkeypatch.setattr(additions, "stays_within", lambda found, *_: found in [nodes[name] for name in inside])

    def with_holding(one):
        assert one is nodes["values"]
        made.record.holding = ("joints",) if held == "held" else ()
        return nodes[held]

    monkeypatch.setattr(made.additions, "with_holding", with_holding)
    after = node(4.0, 300.0, effects=1)
    found = made.additions._with_nominal([given, after], None, given)
    assert found == (None if left is None else [given, nodes[left]])
    assert made.record.holding == holding
    assert shortened == ([nodes[tried]] if tried else [])
    assert made.record.time_step == ((nodes[held], nodes["finer"]) if left == "finer" else None)
    # Of the model as given, values at their bounds and a shorter time step at once are less plausible than an effect,
    # but for constraints that hold, which may need such a step.
    shortened.clear()
    made.record.time_step = None
    made.additions._with_nominal([given], None, given)
    assert shortened == ([nodes["held"]] if tried and held == "held" else [])


@pytest.mark.parametrize(
    ("bounded_errors", "bounded_ratio", "at_bounds", "effect_errors", "asked", "left"),
    [
        (40.0, 1.5, True, 20.0, 1, "effect"),
        (40.0, 1.5, True, 39.5, 1, "values"),  # the effect explains no more than may be chance
        (40.0, 1.5, True, None, 1, "values"),
        (40.0, 1.5, False, 20.0, 0, "values"),
        (40.0, 1.05, True, 20.0, 0, "values"),  # little more than noise is left
    ],
)
def test_an_effect_that_explains_more_comes_before_nominal_values_at_their_bounds(
    monkeypatch, bounded_errors, bounded_ratio, at_bounds, effect_errors, asked, left
):
    given, after = node(9.0, 900.0), node(2.5, 100.0, effects=1)
    bounded, second = (
        node(bounded_ratio, bounded_errors, effects=1, nominal=1),
        node(1.0, effect_errors or 1, effects=2),
    )
    made, calls = procedure(max_additions=2), []

    def find(base, step, **_):
        calls.append((base, step))
        found = None if base is bounded or effect_errors is None else second
        if found is not None:
            made.record.groups.append(("second",))
            made.record.findings.append(finding("second", 0.6, step=step))
        return found, ()

    # With a shorter time step, too.
    finer = node(2.4, 95.0, effects=1, timestep=FINER)
    monkeypatch.setattr(made.additions.finder, "find", find)
    monkeypatch.setattr(additions, "finer_time_step", lambda one, _cfg: finer if one is after else None)
    monkeypatch.setattr(additions, "time_step_finding", lambda *_: "found")
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(additions, "renew_defects", lambda one, _cfg: one)
    share = {id(bounded.model): 0.5 if at_bounds else 0.0}
    monkeypatch.setattr(nominal_values, "bounded_share", lambda model: share.get(id(model), 0.0))
    monkeypatch.setattr(context, "with_nominal_values", lambda one, *_: bounded if one is finer else None)
    fitted, _ = made.additions.add_effects([given, after], ())
    assert [base for base, _ in calls].count(after) == asked
    assert fitted == ([given, after, second] if left == "effect" else [given, bounded])
    assert made.record.groups == ([("second",)] if left == "effect" else [])
    assert len(made.record.findings) == (left == "effect")
    assert made.record.time_step == (None if left == "effect" else "found")


@pytest.mark.parametrize(
    ("decides", "finer_beside", "left"),
    [
        (True, 30.0, "effect"),  # beside nominal values it leaves 10, the shorter time step 30
        (True, 10.1, "finer"),
        (False, 30.0, "finer"),  # alone it leaves 60, the shorter time step 50
    ],
)
def test_an_effect_is_compared_with_a_shorter_time_step_as_it_was_with_others(monkeypatch, decides, finer_beside, left):
    given, effect = node(3.0, 100.0, name="given"), node(1.5, 60.0, effects=1, name="effect")
    finer, made = node(1.4, 50.0, timestep=FINER, name="finer"), procedure(max_additions=1)
    beside = {"effect": np.full(2, 5.0), "finer": np.full(2, finer_beside / 2)}
    made.context.beside_nominal = lambda base: Comparison(base, beside, decides=decides)
    found = {id(given): (effect, ())}
    monkeypatch.setattr(made.additions.finder, "find", lambda base, _step, **_: found.get(id(base), (None, ())))
    monkeypatch.setattr(additions, "finer_time_step", lambda one, _cfg: finer if one is given else None)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "time_step_finding", lambda *_: "found")
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(additions, "renew_defects", lambda one, _cfg: one)
    fitted, _ = made.additions.add_effects([given], ())
    assert fitted[-1] is (effect if left == "effect" else finer)


def test_nominal_values_at_their_bounds_stay_where_there_is_no_time_to_look_for_an_effect(monkeypatch):
    given, after, bounded = node(9.0, 900.0), node(2.5, 100.0, effects=1), node(1.5, 40.0, effects=1, nominal=1)
    made = procedure()

    def late(*_, **__):
        raise TimeUpError

    monkeypatch.setattr(made.additions.finder, "find", late)
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(nominal_values, "bounded_share", lambda _: 0.5)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: bounded)
    assert made.additions.add_effects([given, after], ()) == ([given, bounded], ())
    assert made.context.budget.cut == {1}


def test_far_from_the_noise_a_shorter_time_step_must_explain_a_fifth(monkeypatch):
    asked = {}
    monkeypatch.setattr(additions, "finer_time_step", lambda one, cfg: asked.setdefault(one.ratio, cfg.min_gain))
    made = procedure(min_gain=0.04)
    for ratio in (5.0, 2.01, 2.0, 1.5):
        made.additions._finer(node(ratio))
    assert asked == {5.0: 0.2, 2.01: 0.2, 2.0: 0.04, 1.5: 0.04}
    made = procedure(min_gain=0.3)
    made.additions._finer(node(6.0))
    assert asked[6.0] == 0.3


def test_an_addition_takes_three_quarters_of_what_is_left_and_begins_earlier_than_the_one_before_ended():
    made = procedure()
    shares = []
    for step in range(3):
        made.context.enter_addition(step, 0.0, 1.0)
        shares += [made.context.runner.share, made.context.runner.end]
    left = (0.9, 0.9 * 0.75, 0.9 * 0.75**2)
    assert shares == pytest.approx([s for each in left for s in (1 - each, 1 - each / 4)])
    made.context.enter_addition(1, 0.25, 0.7)
    assert made.context.runner.share == pytest.approx(1 - left[1] + 0.25 * 0.75 * left[1])
    assert made.context.runner.end == pytest.approx(1 - left[1] + 0.7 * 0.75 * left[1])


def test_no_further_effect_is_searched_where_less_is_left_than_it_must_remove(monkeypatch):
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    finer = node(1.04, 30.0, timestep=FINER)
    for left, shorter, searched, steps in (
        (1.06, None, 1, [GIVEN, GIVEN]),  # at most 11 % can go; an effect beside so little must remove 12.5 %
        (1.08, None, 2, [GIVEN, GIVEN]),  # 14 %
        (1.12, None, 2, [GIVEN, GIVEN]),  # an effect must remove 5 % here
        (1.06, finer, 1, [GIVEN, FINER]),  # as where no effect explains more
    ):
        made, asked, after = procedure(), [], node(left, effects=1)

        def find(_base, step, *, explained, asked=asked, after=after, **_):
            asked.append((step, explained))
            return (None if step else after), ()

        monkeypatch.setattr(made.additions.finder, "find", find)
        monkeypatch.setattr(
            additions, "finer_time_step", lambda one, _cfg, shorter=shorter: None if one.ratio > 2 else shorter
        )
        monkeypatch.setattr(additions, "time_step_finding", lambda *_: "found")
        monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
        fitted, _ = made.additions.add_effects([node(3.0)], ())
        assert len(asked) == searched
        assert [one.timestep for one in fitted] == steps


def test_an_effect_whose_rivals_were_not_fitted_in_time_is_not_added_to_one_that_explains_nearly_all(monkeypatch):
    monkeypatch.setattr(additions, "finer_time_step", lambda *_: None)
    monkeypatch.setattr(context, "with_nominal_values", lambda *_: None)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    # 1.2 x noise is 2 % of what 5 lack and 15 % of what 2 lack: then what is established does not dominate.
    for first, cut, count, accepted in (
        (5.0, True, 2, [True, False]),
        (2.0, True, 3, [True, True]),
        (5.0, False, 3, [True, True]),
    ):
        made, nodes = procedure(), [node(first), node(1.2, effects=1), node(1.0, effects=2)]

        def find(_base, step, *, made=made, nodes=nodes, cut=cut, **_):
            made.record.groups.append((f"effect {step}",))
            made.record.hypotheses.append({})
            made.record.findings.append(finding(f"effect {step}", 0.6, step=step))
            if cut and step:
                made.context.budget.note("Not fitted: drag.", step)
            return nodes[step + 1], ()

        monkeypatch.setattr(made.additions.finder, "find", find)
        assert made.additions.add_effects(nodes[:1], ())[0] == nodes[:count]
        assert [f.accepted for f in made.record.findings] == accepted
        assert len(made.record.groups) == count - 1
        steps = [f.step for f in made.record.accepted()]
        assert made.context.budget.verdict("effect", steps) == ("unsettled" if first == 2.0 else "effect")


@pytest.mark.parametrize(("within", "count"), [(1.0, 2), (2.9, 3), (None, 3)])
def test_over_short_windows_nothing_is_added_to_an_effect_beside_which_nominal_values_explain_the_rest(
    monkeypatch, within, count
):
    made, nodes = procedure(), [node(9.0), node(3.0, effects=1), node(1.0, effects=2)]
    found = None if within is None else node(within, effects=1)
    asked = []

    def with_nominal_values(one, *_):
        asked.append(one)
        return found

    monkeypatch.setattr(context, "with_nominal_values", with_nominal_values)
    monkeypatch.setattr(context, "stays_within", lambda *_: True)
    monkeypatch.setattr(additions, "add_candidate", lambda _base, best: best)
    monkeypatch.setattr(additions, "renew_defects", lambda one, _cfg: one)
    monkeypatch.setattr(made.additions.finder, "find", one_after_the_other(made, nodes))
    assert made.additions.add_effects(nodes[:1], (), effects_alone=True)[0] == nodes[:count]
    assert asked == [nodes[1]]
