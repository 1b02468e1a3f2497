import re
from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.candidates import evidence
from concent_warp.diagnosis.candidates.baseline import add_candidate, fit_baseline
from concent_warp.diagnosis.candidates.evidence import fitted_parameters, indistinguishable
from concent_warp.diagnosis.candidates.fit_candidate import (
    fit_candidate,
    fitted_candidate,
    multiple_shooting_candidate,
    polish_candidate,
    restart_candidate,
    search_candidate_value,
)
from concent_warp.diagnosis.candidates.fit_promising import CandidateFits
from concent_warp.diagnosis.candidates.grouping import group_indistinguishable
from concent_warp.diagnosis.candidates.null_distribution import max_gain_under_null
from concent_warp.diagnosis.candidates.screening import FIRST_RANKING, linear_at_measured_states, ranking, screen
from concent_warp.diagnosis.cfg import DiagnoseCfg, SearchCfg
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import Finding
from concent_warp.diagnosis.search.joint_fit import refit_jointly
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.cross_validation import BlockCfg, cut_blocks
from concent_warp.fit.effects.initial_states import InitialStateCfg, InitialStateSearch
from concent_warp.fit.effects.least_squares import LeastSquaresCfg, Solver
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.prediction import Prediction
from tests.scenes.swinging import DAMPING, drawing, swung, windows_of

NAMES = ("joint_damping", "joint_friction", "armature")


def base_of(recording):
    windows = windows_of(recording)
    return fit_baseline(drawing(recording), windows, cut_blocks(windows), "mujoco")


def effect(name):
    return effect_class(name)("hinge")


@pytest.fixture(scope="module")
def lacking():
    return base_of(swung())


@pytest.fixture(scope="module")
def complete():
    return base_of(swung(damping=0.0))


def test_the_residual_of_a_complete_model_is_noise(lacking, complete):
    assert complete.ratio == pytest.approx(1.0, abs=0.1)
    assert lacking.ratio > 2.5


def test_a_fit_that_is_stuck_at_the_null_value_is_continued_without_fitting_its_initial_states_again(lacking):
    found = fit_candidate(lacking, screen(lacking, effect("joint_damping")))
    solver = Solver(Prediction(lacking.model, (effect("joint_damping"),), lacking.windows, threads=1))
    linear = solver.linearise(solver.p.start, lacking.fit.offsets)
    cost = solver.cost([piece.residual for piece in linear], lacking.fit.offsets, solver.p.start)
    assert cost == pytest.approx(lacking.fit.cost)
    fit = replace(lacking.fit, values=solver.p.start, linear=linear)
    polished = polish_candidate(lacking, replace(found, fit=fit))
    assert polished.fit.values[0] == pytest.approx(DAMPING, rel=0.05)


def test_multiple_shooting_leads_a_stuck_fit_to_the_value_and_samples_no_states(lacking, monkeypatch):
    found = fit_candidate(lacking, screen(lacking, effect("joint_damping")))
    solver = Solver(Prediction(lacking.model, (effect("joint_damping"),), lacking.windows, threads=1))
    linear = solver.linearise(solver.p.start, lacking.fit.offsets)
    stuck = replace(found, fit=replace(lacking.fit, values=solver.p.start, linear=linear))
    recording, searched = swung(), []
    short = [replace(w, smooth=False) for w in windows_of(recording, length=0.4)]
    refined = InitialStateSearch.refined

    def noted(self, *args, **settings):
        if len(self.p.windows) == len(short):
            searched.append((self.cfg.sample_spreads, self.cfg.restart_samples))
        return refined(self, *args, **settings)

    monkeypatch.setattr(InitialStateSearch, "refined", noted)
    there = multiple_shooting_candidate(lacking, stuck, short)
    assert there.fit.values[0] == pytest.approx(DAMPING, rel=0.05)
    assert set(searched) == {((), 0)}


def test_screening_expects_most_of_the_effect_that_is_missing(lacking):
    promised = {name: screen(lacking, effect(name)).expected_gain for name in NAMES}
    assert max(promised, key=promised.__getitem__) == "joint_damping"
    assert promised["joint_damping"] > 0.8
    assert promised["armature"] < 0.5


def test_a_fit_of_the_missing_effect_leaves_noise_alone_and_gains_in_every_fold(lacking):
    found = fit_candidate(lacking, screen(lacking, effect("joint_damping")))
    assert found.fit.values[0] == pytest.approx(DAMPING, rel=0.03)
    assert found.ratio == pytest.approx(1.0, abs=0.1)
    assert found.share(lacking) > 0.8
    gain = found.gain(lacking)
    assert all(gain[lacking.blocks.fold == f].sum() > 0 for f in range(5))
    assert polish_candidate(lacking, found).fit.cost <= found.fit.cost
    assert add_candidate(lacking, found).ratio == pytest.approx(found.ratio)


def test_a_fit_continued_without_improvement_stays(lacking):
    found = fit_candidate(lacking, screen(lacking, effect("joint_friction")))
    for _ in range(20):
        if found.polished:
            break
        found = polish_candidate(lacking, found)
    assert found.polished
    assert polish_candidate(lacking, found) is found
    assert polish_candidate(lacking, found, thorough=True) is not found


def test_a_fit_that_other_initial_states_do_not_improve_stays(lacking):
    right, wrong = (fit_candidate(lacking, screen(lacking, effect(name))) for name in ("joint_damping", "armature"))
    assert restart_candidate(lacking, right, wrong.fit) is right


def test_a_fit_with_wrong_initial_states_recovers_from_those_of_the_best_fit(lacking):
    right = fit_candidate(lacking, screen(lacking, effect("joint_damping")))
    solver = Solver(Prediction(lacking.model, (right.effect,), lacking.windows))
    astray = tuple(o + 3.0 for o in right.fit.offsets)
    linear = solver.linearise(right.fit.values, astray)
    cost = solver.cost([piece.residual for piece in linear], astray, right.fit.values)
    assert cost > 1.1 * right.fit.cost
    stuck = replace(right, fit=replace(right.fit, offsets=astray, cost=cost, linear=linear))
    assert restart_candidate(lacking, stuck, right.fit).fit.cost < 1.01 * right.fit.cost


def at_value(base, name, value):
    """Return a fit of an effect at a value, at the baseline's initial states."""
    solver = base.solver(effect(name))
    values = np.array([value])
    linear = solver.linearise(values, base.fit.offsets)
    cost = solver.cost([piece.residual for piece in linear], base.fit.offsets, values)
    fit = replace(base.fit, values=values, linear=linear, cost=cost)
    return fitted_candidate(base, effect(name), solver, fit)


@pytest.mark.parametrize(("start", "reached"), [(0.8, 1.0), (0.6, 1.05), (1.2, 0.9), (2.0, 1.0)])
def test_a_fit_that_no_step_improves_is_searched_from_its_scanned_value_on(lacking, monkeypatch, start, reached):
    stuck = at_value(lacking, "joint_damping", start * DAMPING)
    begun = []

    def stays(self, values, offsets, starts):  # as where the cost is rough
        begun.append(values / DAMPING)
        linear = self.linearise(values, offsets)
        cost = self.cost([piece.residual for piece in linear], offsets, values)
        return replace(stuck.fit, values=values, offsets=tuple(offsets), starts=starts, linear=linear, cost=cost)

    monkeypatch.setattr(Solver, "fit", stays)
    found = search_candidate_value(lacking, stuck, stuck.fit.values)
    assert found.fit.cost < 0.99 * stuck.fit.cost
    assert begun == [pytest.approx([reached])]
    assert found.fit.values == pytest.approx([reached * DAMPING])
    monkeypatch.undo()
    assert search_candidate_value(lacking, stuck, stuck.fit.values).fit.values[0] == pytest.approx(DAMPING, rel=0.03)


def test_a_fit_at_the_best_value_or_at_the_null_value_is_not_searched(lacking):
    right = fit_candidate(lacking, screen(lacking, effect("joint_damping")))
    assert search_candidate_value(lacking, right, right.fit.values) is right
    null = at_value(lacking, "joint_damping", 0.0)
    assert search_candidate_value(lacking, null, null.fit.values) is null


def test_an_effect_that_is_not_missing_gains_no_more_than_the_null_distribution(complete):
    screened = [screen(complete, effect(name)) for name in NAMES]
    null = max_gain_under_null(complete, screened, 200, 0)
    assert len(null) == 200
    for s in screened:
        assert fit_candidate(complete, s).share(complete) < np.quantile(null, 0.99)


def test_the_null_distribution_grows_with_the_candidates_and_stays_small(complete):
    screened = [screen(complete, effect(name)) for name in NAMES]
    one, all_of_them = (
        max_gain_under_null(complete, screened[:1], 200, 0),
        max_gain_under_null(complete, screened, 200, 0),
    )
    assert (all_of_them >= one - 1e-12).all()
    assert np.quantile(all_of_them, 0.95) < 0.1
    assert np.array_equal(one, max_gain_under_null(complete, screened[:1], 200, 0))


def of_two(base, rival_leaves, rough=0.0):
    """Return the names of the indistinguishable ones of damping and an armature whose errors are larger by a factor."""
    best = fit_candidate(base, screen(base, effect("joint_damping")))
    best = replace(best, cost_roughness=rough)
    other = fit_candidate(base, screen(base, effect("armature")))
    other = replace(other, errors=rival_leaves * best.errors, cost_roughness=rough)
    findings = [
        Finding(
            c.effect.name,
            c.effect.target,
            "",
            fitted_parameters(base, c),
            c.share(base),
            0.0,
            1.0,
            0.0,
            0.0,
            True,
            0,
            (),
            "",
        )
        for c in (best, other)
    ]
    accepted = list(zip((best, other), findings, strict=True))
    return {f.name for _, f in indistinguishable(base, accepted, SearchCfg())}


def test_candidates_with_nearly_equal_errors_are_indistinguishable_and_others_are_not(lacking):
    assert of_two(lacking, 1.01) == {"joint_damping", "armature"}
    assert of_two(lacking, 1.3) == {"joint_damping"}


def test_rough_costs_distinguish_less(lacking):
    left = fit_candidate(lacking, screen(lacking, effect("joint_damping"))).errors.sum()
    assert of_two(lacking, 1.3, rough=0.3 * left) == {"joint_damping", "armature"}


def test_a_rare_effect_does_not_shut_out_a_common_one_that_leaves_hardly_more(lacking, monkeypatch):
    count = lacking.blocks.count
    little, much = np.exp(4.0 / count), np.exp(8.0 / count)
    assert of_two(lacking, little) == {"joint_damping"}
    monkeypatch.setattr(effect_class("joint_damping"), "rarity", 6.0)
    assert of_two(lacking, little) == {"joint_damping", "armature"}
    assert of_two(lacking, much) == {"joint_damping"}


def test_a_rival_is_refitted_from_the_best_fits_initial_states_for_as_long_as_it_gains(lacking):
    right = fit_candidate(lacking, screen(lacking, effect("joint_damping")))
    solver = Solver(Prediction(lacking.model, (right.effect,), lacking.windows))
    astray = tuple(o + 3.0 for o in right.fit.offsets)
    values = 0.5 * right.fit.values
    linear = solver.linearise(values, astray)
    cost = solver.cost([piece.residual for piece in linear], astray, values)
    stuck = replace(right, fit=replace(right.fit, values=values, offsets=astray, cost=cost, linear=linear))
    stuck = replace(stuck, errors=1.5 * right.errors)
    found = [right, stuck]
    fits = CandidateFits(lacking, DiagnoseCfg(jobs=1), TaskRunner())
    fits.fits = found
    fits.refit_rivals(np.array([right.share(lacking)] * 2))
    assert found[0].fit.cost <= right.fit.cost
    assert found[1].fit.cost < 1.01 * right.fit.cost
    assert found[1].fit.values[0] == pytest.approx(DAMPING, rel=0.05)


def test_nearly_equal_candidates_get_a_profile_likelihood_and_the_first_is_polished(lacking, monkeypatch):
    monkeypatch.setattr(evidence, "surprise", lambda *_: 0.0)  # the one that leaves least is the first
    best = fit_candidate(lacking, screen(lacking, effect("joint_damping")))
    other = replace(fit_candidate(lacking, screen(lacking, effect("armature"))), errors=1.022 * best.errors)
    evaluated = []

    class Watched(TaskRunner):
        def results(self, task, arguments):
            evaluated.extend(c.effect.name for _, c, *_ in arguments)
            return super().results(task, arguments)

    def judge(c):
        return Finding(c.effect.name, c.effect.target, "", (), c.share(lacking), 0.0, 1.0, 0.0, 0.0, False, 0, (), "")

    accepted = [(c, replace(judge(c), accepted=True)) for c in (best, other)]
    group = group_indistinguishable(lacking, accepted, judge, Watched(), DiagnoseCfg(jobs=1))
    assert set(evaluated) == {"joint_damping", "armature"}
    first, finding = group[0]
    assert finding.accepted
    assert finding.name == "joint_damping"
    assert first.polished
    assert first.fit.cost <= best.fit.cost


def test_a_diagnosis_fits_with_its_own_settings():
    states = InitialStateCfg(iterations=2)
    fits = EffectSolverCfg(
        least_squares=LeastSquaresCfg(prior=3.0, max_polished_windows=1, initial_states=states),
        blocks=BlockCfg(min_blocks=6, max_blocks=7, folds=3),
        observation=ObservationCfg(state_noise=4.0),
    )
    recording = swung(seconds=1.0)
    base = Procedure(drawing(recording), recording, DiagnoseCfg(fits=fits)).baseline()
    plain = Procedure(drawing(recording), recording, DiagnoseCfg()).baseline()
    assert base.cfg == fits
    assert base.solver().cfg == fits.least_squares
    assert 6 <= base.blocks.count <= 7 < plain.blocks.count
    assert set(base.blocks.fold) == {0, 1, 2}
    np.testing.assert_allclose(base.windows[0].spread[0], plain.windows[0].spread[0] * 4 / 3)


def test_screening_takes_over_what_the_baseline_knows(lacking):
    own = replace(lacking, model=lacking.model.add(effect("armature")))
    base = fit_baseline(own.model, own.windows, own.blocks, "mujoco")
    offsets = base.fit.offsets
    for name, same in (("joint_damping", True), ("joint_friction", False)):
        assert effect(name).prepares is not same
        whole, shared = base.solver(effect(name)), base.solver(effect(name))
        values = whole.p.start
        alone = whole.linearise(values, offsets)
        known = shared.linearise(values, offsets, base.fit.linear, residual_known=same)
        assert shared.p.simulated == pytest.approx(whole.p.simulated * (1 if same else 2) / 3)
        for a, b, mine in zip(alone, known, base.fit.linear, strict=True):
            assert b.jacobian[:, 0].tolist() == mine.jacobian[:, 0].tolist()
            assert np.abs(a.residual - b.residual).max() < 1e-6
            # The baseline's finite difference has a shorter step, adapted by its fit.
            assert np.abs(a.jacobian - b.jacobian)[:, 0].max() < 0.1 * np.abs(a.jacobian).max()
            assert b.jacobian[:, 1] == pytest.approx(a.jacobian[:, 1], abs=1e-4)


def test_an_effect_of_measurement_is_screened_on_one_simulation(lacking):
    latency = effect_class("latency")("angle")
    solver, again = lacking.solver(latency), lacking.solver(latency)
    known = solver.linearise(solver.p.start, lacking.fit.offsets, lacking.fit.linear, residual_known=True)
    whole = again.linearise(again.p.start, lacking.fit.offsets)
    assert solver.p.simulated == pytest.approx(again.p.simulated)
    assert [piece.jacobian.tolist() for piece in known] == [piece.jacobian.tolist() for piece in whole]


def test_sensitivities_at_the_measured_states_are_shared_by_all_candidates(lacking):
    cfg = SearchCfg()
    near = replace(lacking, fit=replace(lacking.fit, offsets=tuple(0.5 * np.ones(2) for _ in lacking.fit.offsets)))
    assert linear_at_measured_states(near, cfg) == ()
    offsets = tuple(np.array([0.5, 1.1]) for _ in lacking.fit.offsets)
    far = replace(lacking, fit=replace(lacking.fit, offsets=offsets))
    shared = linear_at_measured_states(far, cfg)
    assert len(shared) == len(far.windows)
    given, computed = screen(far, effect("joint_damping"), cfg, shared), screen(far, effect("joint_damping"), cfg)
    assert given.linear_gain == computed.linear_gain


def test_what_a_thorough_polish_ended_with_is_not_polished_again(lacking):
    found = fit_candidate(lacking, screen(lacking, effect("joint_damping")))
    polished = polish_candidate(lacking, found, thorough=True)
    assert polished.fit.polished
    added = add_candidate(lacking, polished)
    assert refit_jointly(added) is added
    assert not polish_candidate(lacking, found).fit.polished


def test_a_first_ranking_comes_from_the_screening_with_intervals(lacking):
    screened = [screen(lacking, effect(name)) for name in NAMES]
    text = ranking(lacking, screened, NAMES)
    assert text.startswith(f"{FIRST_RANKING}, error expected to fall by: joint_damping ")
    gain, low, high = map(int, re.findall(r"joint_damping (\d+) % \[(-?\d+), (-?\d+)\]", text)[0])
    assert low <= gain <= high
    assert gain == round(100 * screened[0].expected_gain)
    assert text.index("joint_damping") < text.index("joint_friction")
    scanned = replace(screened[2], scanned_gain=0.99)
    assert ranking(lacking, [*screened[:2], scanned], NAMES).split(": ")[1].startswith("armature 99 %, joint_damping")
