"""Earlier additions are tried again beside later ones, on a pendulum that lacks a damping and a part of its gain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline, refit_without_effect
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg, SearchCfg
from concent_warp.diagnosis.result import Finding
from concent_warp.diagnosis.search import reconsider as module
from concent_warp.diagnosis.search.reconsider import Rival, near_best, reconsider
from concent_warp.effects.library.joints import JointDamping
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import DAMPING, swing_scene, swung

CFG = DiagnoseCfg(jobs=1)
GAIN = 1.25
"""Of the true servo over that of the model."""
RECORDING = swung(damping=DAMPING)
TARGETS = {"actuator_gain": "servo", "actuator_delay": "servo"}


def fitted(*effects: str, damping: float = 0.0) -> FittedModel:
    """Return the model of a weaker servo with some effects, fitted."""
    model = Model(Scene(swing_scene(damping, kp=1 / GAIN)))
    for name in effects:
        model = model.add_effect(name, [TARGETS.get(name, "hinge")])
    windows = observe(model, RECORDING)
    return fit_baseline(model, windows, cut_blocks(windows))


def finding(name: str, **changes: Any) -> Finding:
    """Return the evidence of an effect at the time when it was compared."""
    return replace(Finding(name, ("hinge",), "joints", (), 0.5, 0.4, 0.6, 0.03, 0.02, True, 0, ()), **changes)


def rival(name: str, alone: FittedModel | None = None, **changes: Any) -> Rival:
    """Return a rival, with the values that it had when no other effect was in the model."""
    alone = alone or fitted(name)
    (added,) = alone.model.effects
    return Rival(finding(name, **changes), added, alone.fit)


@pytest.fixture(scope="module")
def alone() -> dict[str, FittedModel]:
    """Return the model with one effect each."""
    return {name: fitted(name) for name in ("joint_damping", "joint_friction")}


@pytest.fixture(scope="module")
def right() -> FittedModel:
    """Return the model with both effects that were missing."""
    return fitted("joint_damping", "actuator_gain")


@pytest.fixture(scope="module")
def wrong() -> FittedModel:
    """Return the model with a wrong first effect."""
    return fitted("joint_friction", "actuator_gain")


def names(one: FittedModel) -> list[str]:
    return [a.effect.name for a in one.model.effects]


@dataclass(frozen=True)
class MadeUp:
    """A fitted candidate with a gain."""

    name: str
    gain: float

    @property
    def model(self) -> Any:
        """A model in which the candidate comes last."""
        return SimpleNamespace(effects=("own", f"added {self.name}"))

    @property
    def fit(self) -> str:
        """Its fit."""
        return f"fit of {self.name}"

    def share(self, base: Any) -> float:
        """Return the gain over a baseline."""
        return self.gain - base

    def removed(self, base: Any) -> np.ndarray:
        """Return what it takes from the residuals."""
        return np.array([self.gain, base])


def near(gains: dict[str, float], base: float = 0.0, **changes: Any) -> list[str]:
    """Return the names of those near the best, best first."""
    fits: Any = [MadeUp(n, g) for n, g in gains.items()]
    given: Any = base
    cfg = replace(CFG, search=replace(SearchCfg(), **changes))
    found = near_best(given, fits, [finding(n, accepted=g > 0.5) for n, g in gains.items()], cfg)
    assert [(r.added, r.fit) for r in found] == [(f"added {r.finding.name}", f"fit of {r.finding.name}") for r in found]
    return [r.finding.name for r in found]


def test_rivals_are_those_that_explain_at_least_half_as_much_as_the_best_in_their_order():
    assert near({"a": 0.39, "b": 0.8, "c": 0.41, "d": 0.7, "e": 0.4}) == ["b", "d", "c", "e"]
    assert near({"a": 0.39, "b": 0.8, "c": 0.41}, restart_min_gain=0.4) == ["b", "c", "a"]
    # Shares count over the baseline that they are added to.
    assert near({"a": 0.39, "b": 0.8, "c": 0.41}, base=-0.1) == ["b", "c", "a"]
    assert near({"a": 0.8}) == ["a"]
    assert near({"a": -0.2, "b": 0.1}) == ["b"]


def test_a_rival_is_kept_with_what_it_takes_from_the_residuals():
    before = fitted()
    c = fit_candidate(before, screen(before, JointDamping("hinge")))
    (found,) = near_best(before, [c], [finding("joint_damping")], CFG)
    was, left = (np.concatenate([piece.residual for piece in one.pieces]) for one in (before, c))
    assert np.array_equal(found.removed, was - left)
    assert np.linalg.norm(left) < 0.8 * np.linalg.norm(was)


def test_the_rival_that_explains_more_beside_the_others_takes_the_place_of_an_earlier_effect(wrong, right, alone):
    # Alone each takes up the missing gain too.
    among = [rival(n, alone[n], p=0.01 * (k + 1), smallest_p=0.001) for k, n in enumerate(alone)]
    assert abs(alone["joint_damping"].fit.values[0] / DAMPING - 1) > 0.05
    found = reconsider(wrong, 0, among, CFG)
    assert found is not None
    assert names(found.last) == ["joint_damping", "actuator_gain"]
    assert found.last.fit.values == pytest.approx([DAMPING, GAIN], rel=0.01)
    assert found.last.ratio == pytest.approx(right.ratio, rel=0.01)
    assert found.last.errors.sum() < 0.5 * wrong.errors.sum()
    ((c, f),) = found.group
    assert (f.name, f.accepted, f.reason, f.p, f.smallest_p, f.step) == ("joint_damping", True, "", 0.01, 0.001, 0)
    assert [p.name for p in f.parameters] == ["damping[hinge]"]
    assert f.parameters[0].value == pytest.approx(DAMPING, rel=0.01)
    # Its gain is that over the model with the others alone.
    base = refit_without_effect(wrong, 0)
    assert names(base) == ["actuator_gain"]
    assert f.gain == pytest.approx(c.share(base))
    assert 0.5 < f.gain < 1


def test_an_effect_in_the_middle_is_replaced_where_it_is(right):
    model = right.model
    reverse = replace(model, effects=(model.effects[1], *model.add_effect("joint_friction", ["hinge"]).effects[2:]))
    last = fit_baseline(reverse, right.windows, right.blocks)
    assert names(last) == ["actuator_gain", "joint_friction"]
    found = reconsider(last, 1, [rival("joint_damping"), rival("joint_friction")], CFG)
    assert found is not None
    assert names(found.last) == ["actuator_gain", "joint_damping"]
    assert found.last.fit.values == pytest.approx([GAIN, DAMPING], rel=0.01)
    first = reconsider(last, 0, [rival("actuator_gain")], CFG)
    assert first is not None
    assert names(first.last) == ["actuator_gain", "joint_friction"]


def test_the_effect_itself_stays_where_no_rival_explains_more(right, alone):
    among = [rival(n, alone[n]) for n in ("joint_friction", "joint_damping")]
    found = reconsider(right, 0, among, CFG)
    assert found is not None
    assert [f.name for _, f in found.group] == ["joint_damping"]
    assert names(found.last) == ["joint_damping", "actuator_gain"]
    assert found.last.fit.cost <= right.fit.cost
    assert found.last.errors.sum() <= 1.02 * right.errors.sum()


def test_of_the_same_effect_the_fit_with_the_lower_cost_is_kept(right, alone):
    better: Any = replace(right, fit=replace(right.fit, cost=0.0))
    found = reconsider(better, 0, [rival("joint_damping", alone["joint_damping"])], CFG)
    assert found is not None
    assert found.last is better


def test_no_rival_that_explains_less_takes_the_place_of_an_effect(right, alone):
    assert reconsider(right, 0, [rival("joint_friction", alone["joint_friction"])], CFG) is None


def test_a_rival_may_be_a_little_worse_than_the_effect_as_equals_are(right, alone):
    among = [rival("joint_damping", alone["joint_damping"])]
    for factor, kept in ((0.985, True), (0.975, False)):
        # An infinite cost lets the fit of the same effect count as that of another.
        last = replace(right, errors=factor * right.errors, fit=replace(right.fit, cost=np.inf))
        found = reconsider(last, 0, among, CFG)
        assert (found is not None) == kept


def test_a_rival_that_explains_too_little_or_ends_at_a_bound_is_left_out(right, alone, monkeypatch):
    among = [rival("joint_damping", alone["joint_damping"])]
    assert reconsider(right, 0, among, replace(CFG, min_gain=0.999999)) is None
    judge = module.assess

    def assess(*args: Any) -> Finding:
        found = judge(*args)
        return replace(found, parameters=tuple(replace(p, at_bound=True) for p in found.parameters))

    monkeypatch.setattr(module, "assess", assess)
    assert reconsider(right, 0, among, CFG) is None


def test_a_rival_that_was_no_better_than_chance_or_is_uncertain_now_does_not_come_in(wrong, right, alone, monkeypatch):
    for p, name in ((0.05, "joint_damping"), (0.051, None)):
        found = reconsider(wrong, 0, [rival("joint_damping", alone["joint_damping"], p=p, accepted=False)], CFG)
        assert (None if found is None else names(found.last)[0]) == name
    judge = module.assess
    monkeypatch.setattr(module, "assess", lambda *args: replace(judge(*args), low=0.0))
    among = [rival(n, alone[n], p=p) for n, p in (("joint_friction", 0.5), ("joint_damping", 0.01))]
    # The effect that was accepted stays one of those compared.
    for last, name in ((wrong, "joint_friction"), (right, "joint_damping")):
        found = reconsider(last, 0, among, CFG)
        assert found is not None
        assert [f.name for _, f in found.group] == [name]
        assert names(found.last) == names(last)


def test_nothing_is_reconsidered_without_rivals(right):
    assert reconsider(right, 0, [], CFG) is None


def test_rivals_that_the_data_cannot_distinguish_make_a_group(right, alone, monkeypatch):
    asked = []

    def indistinguishable(base: Any, pairs: Any, cfg: Any) -> Any:
        asked.append((names(base), [f.name for _, f in pairs], cfg))
        return pairs[::-1]

    monkeypatch.setattr(module, "indistinguishable", indistinguishable)
    among = [rival(n, alone[n]) for n in ("joint_friction", "joint_damping")]
    found = reconsider(right, 0, among, CFG)
    assert found is not None
    assert [f.name for _, f in found.group] == ["joint_damping", "joint_friction"]
    assert asked == [(["actuator_gain"], ["joint_friction", "joint_damping"], CFG.search)]
