"""What makes a fitted effect accepted: significance, gain, folds, its parameters' intervals; and how likely it is."""

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel
from concent_warp.diagnosis.candidates.evidence import (
    assess,
    detectable_size,
    equal_at_noise,
    fitted_parameters,
    indistinguishable,
    removed_by_channel,
)
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg, SearchCfg
from concent_warp.diagnosis.result import Finding
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.intervals import covariance, formula_errors
from concent_warp.fit.effects.prediction import Prediction
from tests.scenes.swinging import drawing, swung, windows_of

CFG = DiagnoseCfg(jobs=1)


@pytest.fixture(scope="module")
def base() -> FittedModel:
    recording = swung()
    windows = windows_of(recording)
    return fit_baseline(drawing(recording), windows, cut_blocks(windows), "mujoco")


@pytest.fixture(scope="module")
def damping(base) -> FittedCandidate:
    """The effect that is missing, fitted."""
    return fit_candidate(base, screen(base, effect_class("joint_damping")("hinge")))


def assessed(base, c, null, cfg=CFG) -> Finding:
    return assess(base, c, np.asarray(null, dtype=float), 0, [c.effect], cfg)


def test_a_gain_that_chance_often_reaches_is_not_accepted(base, damping):
    share = damping.share(base)
    null = np.zeros(400)
    assert assessed(base, damping, null).accepted
    null[:40] = share + 1e-6
    found = assessed(base, damping, null)
    assert found.p == pytest.approx(41 / 401)
    assert not found.accepted
    assert found.reason == "no better than chance"
    assert assessed(base, damping, null, replace(CFG, significance_level=0.2)).accepted
    null[18:] = 0.0
    assert assessed(base, damping, null).p == pytest.approx(19 / 401)
    assert assessed(base, damping, null).accepted


def with_gain(base, c, gain) -> FittedCandidate:
    """Return a candidate that removes this share of each block's error, shape (B,) or one for all."""
    return replace(c, errors=base.errors * (1 - np.broadcast_to(gain, base.errors.shape)))


def test_a_small_gain_is_not_accepted(base, damping):
    found = assessed(base, with_gain(base, damping, 0.04), np.zeros(400))
    assert found.reason == "removes less than 5 % of the error"
    assert assessed(base, with_gain(base, damping, 0.06), np.zeros(400)).accepted
    assert found.gain == pytest.approx(0.04)


def with_fold_gains(base, c, gains) -> FittedCandidate:
    """Return a candidate that removes this share of the whole error in each fold, shape (F,)."""
    fold, total = base.blocks.fold, base.errors.sum()
    share = np.array([g * total / base.errors[fold == f].sum() for f, g in enumerate(gains)])
    return with_gain(base, c, share[fold])


def test_an_effect_that_loses_in_some_folds_more_than_a_fifth_of_gains_and_losses_is_not_accepted(base, damping):
    assert np.unique(base.blocks.fold).tolist() == [0, 1, 2, 3, 4]
    for loss, reason in ((0.098, ""), (0.102, "folds disagree")):  # a fifth of losses and gains is 0.1
        found = assessed(base, with_fold_gains(base, damping, [0.1, 0.1, 0.1, 0.1, -loss]), np.zeros(400))
        assert (found.reason, found.low > 0) == (reason, True)
    one = [0.1, 0.1, 0.1, 0.1, -0.102]
    lenient = replace(CFG, search=replace(CFG.search, min_fold_share=0.75))
    assert assessed(base, with_fold_gains(base, damping, one), np.zeros(400), lenient).accepted


def test_folds_that_hardly_show_an_effect_do_not_count_against_it(base, damping):
    gains = [0.1, 0.1, 0.0, -0.002, -0.002]
    assert assessed(base, with_fold_gains(base, damping, gains), np.zeros(400)).reason == ""


def test_a_gain_owed_to_few_blocks_is_not_accepted(base, damping):
    gain = np.full(len(base.errors), -0.3)
    gain[int(np.argmax(base.errors))] = 0.99
    found = assessed(base, with_gain(base, damping, gain), [-1.0] * 400, replace(CFG, min_gain=-1.0))
    assert found.low < 0 < found.high
    assert found.reason == "the interval of its gain includes zero"


def test_an_effect_whose_parameter_may_be_null_or_is_at_its_bound_is_not_accepted(base, damping):
    wide = replace(damping, std=np.full(len(damping.fit.values), 1e3))
    assert assessed(base, wide, np.zeros(400)).reason == "its parameters may be at their null values"
    p = Prediction(base.model, (damping.effect,), base.windows).parameters[-1]
    values = damping.fit.values.copy()
    values[-1] = p.high
    ended = replace(damping, fit=replace(damping.fit, values=values))
    assert assessed(base, ended, np.zeros(400)).reason == "a parameter is at its bound"


def test_an_interval_is_two_standard_deviations_and_the_formulas_own_error(base, damping):
    (found,) = fitted_parameters(base, damping)
    p = Prediction(base.model, (damping.effect,), base.windows).parameters[-1]
    own = formula_errors(damping.effect, [p], damping.fit.values[-1:], base.cfg.discretisation_error)[0]
    std = np.sqrt(covariance(damping.sums, base.blocks)[-1, -1]) * p.scale
    assert std > 0
    assert found.high - found.value == pytest.approx(1.96 * np.hypot(std, own), rel=1e-9)
    assert found.value - found.low == pytest.approx(1.96 * np.hypot(std, own), rel=1e-9)
    assert not found.at_bound
    (given,) = fitted_parameters(base, replace(damping, std=np.full(len(damping.fit.values), 0.3)))
    assert given.high - given.value == pytest.approx(1.96 * np.hypot(0.3 * p.scale, own), rel=1e-9)
    (wide,) = fitted_parameters(base, replace(damping, std=np.full(len(damping.fit.values), 1e6)))
    assert (wide.low, wide.high) == (p.low, p.high)


def order(base, pairs, cfg: SearchCfg | None = None) -> list[str]:
    """Return the names of those that are indistinguishable, in their order."""
    return [f.name for _, f in indistinguishable(base, pairs, cfg or SearchCfg())]


def pair(base, c, name, value=None) -> tuple[FittedCandidate, Finding]:
    """Return a candidate with a finding of a name, whose parameter has another value if one is given."""
    found = replace(assessed(base, c, np.zeros(400)), name=name)
    if value is not None:
        found = replace(found, parameters=tuple(replace(p, value=value) for p in found.parameters))
    return c, found


def test_of_two_with_the_same_errors_the_rarer_comes_second(base, damping, monkeypatch):
    friction = fit_candidate(base, screen(base, effect_class("joint_friction")("hinge")))
    rare = replace(friction, errors=damping.errors)
    null = [p.null for p in Prediction(base.model, (friction.effect,), base.windows).parameters][-1]
    start = Prediction(base.model, (damping.effect,), base.windows).parameters[-1].null
    pairs = [pair(base, rare, "friction", null), pair(base, damping, "damping", start)]
    assert len(pairs[0][1].parameters) == len(pairs[1][1].parameters)
    monkeypatch.setattr(effect_class("joint_damping"), "rarity", 0.0)
    monkeypatch.setattr(effect_class("joint_friction"), "rarity", 3.0)
    assert order(base, pairs) == ["damping", "friction"]
    monkeypatch.setattr(effect_class("joint_damping"), "rarity", 6.0)
    assert order(base, pairs) == ["friction", "damping"]


def test_of_two_with_the_same_errors_the_larger_value_comes_second(base, damping):
    scale = Prediction(base.model, (damping.effect,), base.windows).parameters[-1].scale
    pairs = [pair(base, damping, "large", 6 * scale), pair(base, damping, "small", scale)]
    assert order(base, pairs) == ["small", "large"]


def test_of_two_with_the_same_errors_one_that_is_implausible_is_left_out(base, damping, monkeypatch):
    p = Prediction(base.model, (damping.effect,), base.windows).parameters[-1]
    # Under the Cauchy prior of sizes the odds of 1 and x times the scale are (1 + x^2) / 2.
    for size, odds in ((6.24, 20.0), (6.25, 20.0), (9.0, 20.0), (9.0, 42.0), (3.0, 4.9), (3.0, 5.1)):
        named = (1 + size**2) / 2 < odds
        pairs = [pair(base, damping, "large", p.null + size * p.scale), pair(base, damping, "small", p.null + p.scale)]
        assert order(base, pairs, SearchCfg(max_odds=odds)) == (["small", "large"] if named else ["small"])
    # The rarity of an effect counts as much as the size of its value.
    friction = fit_candidate(base, screen(base, effect_class("joint_friction")("hinge")))
    null = Prediction(base.model, (friction.effect,), base.windows).parameters[-1].null
    pairs = [
        pair(base, replace(friction, errors=damping.errors), "friction", null),
        pair(base, damping, "damping", p.null),
    ]
    monkeypatch.setattr(effect_class("joint_damping"), "rarity", 0.0)
    for rarity, named in ((2 * np.log(20) - 0.01, ["damping", "friction"]), (2 * np.log(20) + 0.01, ["damping"])):
        monkeypatch.setattr(effect_class("joint_friction"), "rarity", rarity)
        assert order(base, pairs) == named


def test_errors_that_fall_are_shares_of_each_channel(base, damping):
    ((name, share),) = removed_by_channel(base, damping)
    assert name == "angle"
    before = sum(float(piece.residual @ piece.residual) for piece in base.pieces)
    after = sum(float(piece.residual @ piece.residual) for piece in damping.pieces)
    assert share == pytest.approx(1 - after / before)
    assert removed_by_channel(base, replace(damping, pieces=base.pieces)) == ()


def test_the_detectable_size_adds_the_share_to_the_error(base):
    screened = screen(base, effect_class("joint_damping")("hinge"))
    found = detectable_size(base, screened, 0.1)
    p = Prediction(base.model, (screened.effect,), base.windows).parameters[-1]
    curvature = sum(float(piece.jacobian[:, -1] @ piece.jacobian[:, -1]) for piece in screened.pieces)
    assert (found.name, found.parameter, found.unit) == ("joint_damping", p.name, p.unit)
    assert curvature * (found.size / p.scale) ** 2 == pytest.approx(0.1 * base.errors.sum())
    assert detectable_size(base, screened, 0.4).size == pytest.approx(2 * found.size)
    assert detectable_size(base, screened, 1e9) is None


def test_of_two_with_the_same_errors_one_with_the_other_as_a_special_case_is_left_out(base, damping, monkeypatch):
    friction = replace(
        fit_candidate(base, screen(base, effect_class("joint_friction")("hinge"))), errors=damping.errors
    )
    null = {c.effect.name: base.prediction(c.effect).parameters[-1].null for c in (friction, damping)}
    pairs = [
        pair(base, friction, "friction", null["joint_friction"]),
        pair(base, damping, "damping", null["joint_damping"]),
    ]
    monkeypatch.setattr(effect_class("joint_friction"), "rarity", 1.0)
    assert order(base, pairs) == ["damping", "friction"]
    monkeypatch.setattr(effect_class("joint_friction"), "special_cases", ("joint_damping",))
    assert order(base, pairs) == ["damping"]
    # The special case is not left out for the sake of what contains it.
    monkeypatch.setattr(effect_class("joint_friction"), "special_cases", ())
    monkeypatch.setattr(effect_class("joint_damping"), "special_cases", ("mass",))
    assert order(base, pairs) == ["damping", "friction"]


def test_one_that_a_rare_best_lets_in_must_not_leave_more_than_the_likeliest(base, damping, monkeypatch):
    friction = fit_candidate(base, screen(base, effect_class("joint_friction")("hinge")))
    armature = fit_candidate(base, screen(base, effect_class("armature")("hinge")))
    monkeypatch.setattr(effect_class("joint_damping"), "rarity", 6.0)
    more = np.exp(3.0 / base.blocks.count)
    found = {}
    for factor in (1.0, more):
        pairs = [
            pair(base, damping, "rare", None),
            pair(base, replace(friction, errors=factor * damping.errors), "likeliest", 0.0),
            pair(base, replace(armature, errors=more * damping.errors), "other", None),
        ]
        found[factor] = set(order(base, pairs, SearchCfg(max_odds=1e9, equal_standard_errors=0.1, equal_error=0.001)))
    assert found == {1.0: {"rare", "likeliest"}, more: {"rare", "likeliest", "other"}}


def test_at_the_noise_odds_decide_which_others_belong_to_a_group(base, damping, monkeypatch):
    friction = fit_candidate(base, screen(base, effect_class("joint_friction")("hinge")))
    monkeypatch.setattr(effect_class("joint_damping"), "rarity", 0.0)
    monkeypatch.setattr(effect_class("joint_friction"), "rarity", 0.0)
    cfg, count = SearchCfg(), base.blocks.count
    null = [Prediction(base.model, (c.effect,), base.windows).parameters[-1].null for c in (damping, friction)]
    # Errors that are larger by this factor in all blocks have odds of 20 against them.
    factor = cfg.max_odds ** (2 / count)
    for ratios, larger, known in (
        ((1.0, 1.05), 0.99 * factor, True),
        ((1.0, 1.05), 1.01 * factor, False),
        ((1.0, 1.11), 0.99 * factor, False),
        ((1.11, 1.05), 0.99 * factor, False),
    ):
        first = pair(base, replace(damping, ratio=ratios[0]), "damping", null[0])
        other = pair(base, replace(friction, ratio=ratios[1], errors=larger * damping.errors), "friction", null[1])
        assert [f.name for _, f in indistinguishable(base, [first, other], cfg)] == ["damping"]
        found = equal_at_noise(base, [first], [other, first], cfg)
        assert [f.name for _, f in found] == ["damping", *(["friction"] if known else [])]
        assert equal_at_noise(base, found, [other, first], cfg) == found
    monkeypatch.setattr(effect_class("joint_friction"), "has_as_special_case", lambda *_: True)
    first = pair(base, replace(damping, ratio=1.0), "damping", null[0])
    other = pair(base, replace(friction, ratio=1.0, errors=damping.errors), "friction", null[1])
    assert equal_at_noise(base, [first], [other], cfg) == [first]
