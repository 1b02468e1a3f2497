"""Nominal values within their tolerance are fitted before effects are searched for."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.diagnosis.candidates.baseline import add_candidate, fit_baseline
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import NominalCfg
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.search import nominal_values
from concent_warp.diagnosis.search.nominal_values import (
    _independent,
    _visible,
    _without_worst,
    considered_std,
    nominal_errors,
    nominal_sensitivities,
    stays_within,
    with_nominal_values,
)
from concent_warp.effects.effect import AddedEffect
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import HeldOut, block_sums, cut_blocks
from concent_warp.fit.effects.least_squares import Solver
from concent_warp.fit.effects.nominal import possible_nominal_effects
from concent_warp.fit.effects.observe import observe
from tests.scenes.foreign import PUSHER, pusher
from tests.scenes.swinging import drawing, swung, windows_of


def test_columns_that_others_can_produce_are_left_out():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 400))
    columns = np.stack([0.5 * a, a + 0.05 * b, 0.3 * b, 0.01 * rng.normal(size=400)], axis=1)
    assert list(_independent(columns, NominalCfg())) == [1, 2]
    assert list(_independent(columns, NominalCfg(max_values=1))) == [1]
    assert not _independent(columns, NominalCfg(min_change=2.0))
    # What no other can produce of the first column is above `min_change`, but no more than an error of its derivative.
    large = np.stack([50 * a, 50 * a + 1.0 * b], axis=1)
    assert len(_independent(large, NominalCfg())) == 1
    assert len(_independent(large, NominalCfg(min_independent=0.01))) == 2


def test_the_blocks_that_become_worst_are_not_counted():
    worse = np.array([0.0, 5.0, -1.0, 2.0, 0.0])
    assert sorted(_without_worst(worse, 0.02)) == [0, 2, 3, 4]
    assert sorted(_without_worst(worse, 0.4)) == [0, 2, 4]


def test_a_nominal_value_that_acts_like_a_parameter_gives_it_its_own_error():
    rng = np.random.default_rng(0)
    direction, other = rng.normal(size=(2, 2000))
    # A tolerance of the nominal value changes the residuals as 0.3 of the parameter does.
    like = considered_std(5.0 * direction[:, None], 1.5 * direction[:, None], 0.05, 10.0)
    assert like == pytest.approx([0.3], rel=1e-3)
    apart = considered_std(
        5.0 * direction[:, None],
        1.5 * (other - direction * (other @ direction) / (direction**2).sum())[:, None],
        1e9,
        10.0,
    )
    assert apart == pytest.approx([0.0], abs=1e-6)


def test_a_nominal_value_whose_error_would_show_counts_by_what_may_go_unseen():
    rng = np.random.default_rng(1)
    direction, other = rng.normal(size=(2, 4000))
    other -= direction * (other @ direction) / (direction @ direction)
    j, k = 5.0 * direction[:, None], (1.5 * direction + 4.0 * other)[:, None]
    change = float(np.mean((4.0 * other) ** 2))
    for excess in (0.05, 1.0):
        found = considered_std(j, k, excess, 10.0)
        assert found == pytest.approx([0.3 / np.sqrt(1 + change / excess)], rel=1e-2)
    assert considered_std(j, k, 1e9, 10.0) == pytest.approx([0.3], rel=1e-2)


def test_a_nominal_value_is_not_considered_beside_the_effect_that_it_is():
    model = cw.Model(cw.Scene(PUSHER))
    gains = {t for e in possible_nominal_effects(model) if e.name == "nominal_gain" for t in e.target}
    assert len(gains) == 2
    first = sorted(gains)[0]
    with_gain = model.add_effect("actuator_gain", target=[first])
    beside = possible_nominal_effects(with_gain)
    assert {t for e in beside if e.name == "nominal_gain" for t in e.target} == gains - {first}
    assert any(e.name == "nominal_velocity_gain" and first in e.target for e in beside)


def test_candidates_share_the_sensitivities_to_nominal_values_of_the_model_that_they_are_added_to():
    recording = swung(seconds=2.0)
    windows = windows_of(recording)
    base, cfg = fit_baseline(drawing(recording), windows, cut_blocks(windows), "mujoco"), cw.DiagnoseCfg(jobs=1)

    def plus(base, name):
        return add_candidate(base, fit_candidate(base, screen(base, effect_class(name)("hinge"))))

    base = plus(base, "joint_damping")  # explains the data
    assert base.ratio < 1.25
    shared = nominal_sensitivities(base)
    kinds = possible_nominal_effects(base.model)
    assert shared.names == tuple((e.name, t) for e in kinds for t in e.target)
    assert shared.columns.shape == (sum(len(p.residual) for p in base.pieces), len(shared.names))
    for k, effect in enumerate(kinds):
        one = shared.of([effect])
        assert one == pytest.approx(shared.columns[:, [name == effect.name for name, _ in shared.names]]), k
    added = plus(base, "joint_friction")
    exact = nominal_errors(added, cfg)
    assert exact.min() > 0
    assert nominal_errors(added, cfg, shared) == pytest.approx(exact, rel=0.2)


def test_a_nominal_value_is_known_no_better_than_those_that_it_may_stand_for():
    """Inertia, damping and drive of a pusher scale together."""
    recording = pusher(damping=0.05, delay=0.0, seconds=3.0)
    model = cw.Model.from_recording(recording)
    windows = observe(model, recording)
    base, cfg = fit_baseline(model, windows, cut_blocks(windows), "mujoco"), cw.DiagnoseCfg(jobs=1)
    (gains,) = (e for e in possible_nominal_effects(model) if e.name == "nominal_gain")
    one = nominal_values._fitted(base, [gains])
    spread = nominal_errors(one, cfg)
    assert spread.shape == (2,)
    # In units of the scale, a tenth of the tolerance; all but their own spread is that of what stays as given.
    assert spread.max() > 3.0
    no_others = replace(
        nominal_sensitivities(one), names=(), columns=np.zeros((sum(len(p.residual) for p in one.pieces), 0))
    )
    assert nominal_errors(one, cfg, no_others).max() == 0.0


def test_the_tolerance_of_a_drive_widens_the_interval_of_a_damping_unless_nominal_values_are_exact():
    recording, without = pusher(damping=0.15, delay=0.0, seconds=3.0), cw.Model(cw.Scene(PUSHER))
    halves = []
    for enabled in (True, False):
        cfg = cw.DiagnoseCfg(
            jobs=1, explain=False, effects=("joint_damping",), nominal=NominalCfg(enabled=enabled, min_change=1e9)
        )
        found = cw.diagnose(without, recording, cfg)
        (p, *_) = found.accepted[0].parameters
        halves.append(p.high - p.value)
        assert not found.nominal_values
    assert halves[0] > 1.2 * halves[1]


SLIGHTLY_WRONG = (
    PUSHER.replace('mass="0.8"', 'mass="0.806"')
    .replace('kp="12"', 'kp="11.9"')
    .replace('"0.12 0 0" mass', '"0.121 0 0" mass')
)


@pytest.fixture(scope="module")
def slightly_wrong():
    model, cfg = cw.Model(cw.Scene(SLIGHTLY_WRONG)), cw.DiagnoseCfg(jobs=1)
    return Procedure(model, pusher(damping=0.05, delay=0.0, seconds=4.0), cfg).baseline()


@pytest.fixture
def fits(monkeypatch):
    """Models that are fitted, one entry each."""
    done, fit = [], Solver.fit

    def watched(solver, *args, **kwargs):
        done.append([a.name for a in solver.p.effects])
        return fit(solver, *args, **kwargs)

    monkeypatch.setattr(Solver, "fit", watched)
    return done


def test_nominal_values_are_fitted_only_where_a_linear_step_promises_a_share_of_the_least_gain(slightly_wrong, fits):
    cfg = NominalCfg()
    visible, promised = _visible(slightly_wrong, cfg, nominal_sensitivities(slightly_wrong))
    assert 0.6 < promised < 0.8
    assert cfg.promised_share == 0.5
    fits.clear()
    for share, min_gain, fitted in (
        (0.5, 2.02 * promised, False),
        (0.5, 1.98 * promised, True),
        (1.0, 1.01 * promised, False),
        (0.0, 2.02 * promised, True),
    ):
        # None of these least gains is reached.
        assert with_nominal_values(slightly_wrong, replace(cfg, promised_share=share), min_gain) is None
        assert fits == ([[e.name for e in visible]] if fitted else [])
        fits.clear()


def test_nominal_values_that_remove_less_than_the_least_gain_stay_as_given(slightly_wrong):
    found = with_nominal_values(slightly_wrong, NominalCfg(), 0.05)
    assert found is not None
    sums = block_sums(found.pieces, found.blocks, found.limit)
    errors = HeldOut(sums, found.blocks, found.cfg.least_squares.prior).own()
    removed = 1 - errors.sum() / slightly_wrong.errors.sum()
    assert 0.6 < removed < 0.8
    assert with_nominal_values(slightly_wrong, NominalCfg(), 0.99 * removed) is not None
    assert with_nominal_values(slightly_wrong, NominalCfg(), 1.01 * removed) is None


@pytest.mark.parametrize(
    ("values", "ratio", "enough", "within"),
    [
        ((1.0, 1.01), 3.0, None, True),
        ((1.02, 1.0), 3.0, None, False),
        ((1.02, 1.0), 1.09, None, True),  # little more than noise is left
        ((1.02, 1.0), 1.11, None, False),
        ((1.02, 1.0), 3.0, True, True),  # beside an effect, with an error in its formula
        ((1.02, 1.0), 3.0, False, False),
        ((1.02, 0.98), 3.0, True, False),  # more than half of them at once
        ((1.02, 0.98), 1.09, True, True),
    ],
)
def test_something_larger_is_missing_where_values_run_to_their_bounds(values, ratio, enough, within):
    model = cw.Model(cw.Scene(PUSHER))
    gains = next(e for e in possible_nominal_effects(model) if e.name == "nominal_gain")
    one: Any = SimpleNamespace(model=replace(model, effects=(AddedEffect(gains, values),)), ratio=ratio)
    assert stays_within(one, NominalCfg(), None if enough is None else lambda _: enough) is within


@pytest.mark.parametrize("at_bound", [True, False])
def test_values_that_others_stand_in_for_are_fitted_where_one_of_these_runs_to_its_bound(
    slightly_wrong, fits, monkeypatch, at_bound
):
    monkeypatch.setattr(nominal_values, "stays_within", lambda *_: not at_bound)
    plain = with_nominal_values(slightly_wrong, NominalCfg(), 0.05, None, False)
    assert len(fits) == 1
    found = with_nominal_values(slightly_wrong, NominalCfg(), 0.05, None, True)
    assert plain is not None
    assert found is not None
    assert len(fits) == (3 if at_bound else 2)
    names = [{(a.effect.name, t) for a in one.model.effects for t in a.effect.target} for one in (plain, found)]
    assert (names[0] < names[1]) is at_bound
    assert (found.fit.cost < plain.fit.cost) is at_bound
    assert len(names[1]) <= NominalCfg().max_values


def test_what_a_fit_of_nominal_values_could_not_take_does_not_count(slightly_wrong, monkeypatch):
    fit = Solver.fit

    def stuck(solver, values, offsets, starts):
        linear, cost = solver.linearise(values, offsets), slightly_wrong.fit.cost
        return replace(slightly_wrong.fit, values=values, offsets=offsets, starts=starts, linear=linear, cost=cost)

    monkeypatch.setattr(Solver, "fit", stuck)
    assert with_nominal_values(slightly_wrong, NominalCfg(), 0.05) is None
    monkeypatch.setattr(Solver, "fit", fit)
    assert with_nominal_values(slightly_wrong, NominalCfg(), 0.05) is not None


def test_nominal_values_that_are_slightly_wrong_are_no_missing_effect():
    model, recording = cw.Model(cw.Scene(SLIGHTLY_WRONG)), pusher(damping=0.05, delay=0.0, seconds=4.0)
    found = cw.diagnose(model, recording, cw.DiagnoseCfg(jobs=1, explain=False))
    assert found.verdict == "none_needed"
    assert not found.accepted
    assert 0.9 < found.ratio[-1] < 1.05 < 1.5 < found.ratio[0]
    assert found.nominal_values
    assert all(p.low < p.value < p.high for p in found.nominal_values)
    for p in found.nominal_values:
        reach = 1e-3 if p.unit == "s" else 0.1 if p.name.startswith("damping") else 0.02
        assert abs(p.value - p.null) <= reach
        assert p.null == (0.0 if p.unit == "s" else 1.0)
    # The integrator is half a time step of 2 ms ahead of the motion.
    values = {p.name: p.value for p in found.nominal_values}
    assert "velocity_gain[shoulder]" in values
    assert 5e-4 < values["delay[shoulder_position]"] <= 1e-3
    (sentence,) = (s for s in found.sentences() if "within their tolerance" in s)
    assert f"velocity_gain[shoulder] x {values['velocity_gain[shoulder]']:.3f} [" in sentence
    assert f"delay[shoulder_position] {values['delay[shoulder_position]']:.2g} [" in sentence
    assert sentence.endswith(" s.")
    assert [p["null"] for p in found.to_json()["nominal_values"]] == [p.null for p in found.nominal_values]
    kept = [a for a in found.model.effects if a.effect.nominal]
    assert [v for a in kept for v in a.values] == pytest.approx([p.value for p in found.nominal_values])


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_nominal_values_stay_as_given_where_that_is_asked_for():
    wrong = cw.Model(cw.Scene(PUSHER.replace('kp="12"', 'kp="11.8"')))
    cfg = cw.DiagnoseCfg(jobs=1, explain=False, effects=("actuator_gain",), nominal=NominalCfg(enabled=False))
    found = cw.diagnose(wrong, pusher(damping=0.05, delay=0.0, seconds=3.0), cfg)
    assert not found.nominal_values
    # The velocity gain is right.
    assert found.groups == (("actuator_gain(shoulder, ..., kp)",),)
