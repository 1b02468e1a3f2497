"""A shorter time step enters as a correction of the predictions, on motions that were simulated with a tenth of it."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import add_candidate, fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg, TimeStepCfg
from concent_warp.diagnosis.constants import FinerTimeStep
from concent_warp.diagnosis.search import time_step as module
from concent_warp.diagnosis.search.time_step import (
    at_given_step,
    finding,
    finer_time_step,
    longer_time_step,
    may_be_step,
    renew_defects,
)
from concent_warp.effects.registry import effect_class
from concent_warp.estimation.noise_ratio import noise_ratio
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.time_limit import stop_at
from tests.scenes.bouncing import bounced
from tests.scenes.swinging import DAMPING, TIMESTEP, swung

FINE = TIMESTEP / 10
CFG = DiagnoseCfg(jobs=1)


def fitted(recording: Recording, length: float | None = None, timestep: float = TIMESTEP) -> FittedModel:
    """Return the fitted model of a recording's own scene with a time step [s]."""
    model = Model(Scene(recording.scene).with_timestep(timestep))
    windows = observe(model, recording, length=length)
    return fit_baseline(model, windows, cut_blocks(windows))


@pytest.fixture(scope="module")
def base() -> FittedModel:
    """Return the model of a motion that it describes but for its time step."""
    return fitted(swung(damping=0.0, timestep=FINE))


@pytest.fixture(scope="module")
def finer(base) -> FittedModel:
    """Return the same with a shorter time step."""
    found = finer_time_step(base, CFG)
    assert found is not None
    return found


def with_step(one: FittedModel, timestep: float) -> FittedModel:
    """Return a model that is simulated with a time step and has no defects."""
    scene = one.model.scene.with_timestep(timestep)
    plain = tuple(replace(w, defect=None) for w in one.windows)
    return replace(one, model=replace(one.model, scene=scene), windows=plain)


def residuals(one: FittedModel, move: float = 0.0) -> np.ndarray:
    """Return the residuals at a model's values and at initial states that differ from its own by some spreads."""
    solver = one.solver()
    return np.concatenate(solver.p.residuals(solver.trials(one.fit.values, [o + move for o in one.fit.offsets])))


def simulated_steps(one: FittedModel) -> float:
    """Return the time step with which a model is simulated [s]."""
    return float(one.prediction().compiled.opt.timestep)


@pytest.mark.parametrize("length", [None, 0.5])
def test_predictions_with_defects_are_those_of_the_shorter_step_at_the_same_values_and_states(base, length):
    one = base if length is None else fitted(swung(damping=0.0, timestep=FINE), length)
    corrected = module._with_defects(one, FINE)
    exact = residuals(with_step(one, FINE))
    np.testing.assert_allclose(residuals(corrected), exact, atol=1e-9)
    assert np.abs(exact - residuals(one)).max() > 3.0
    assert simulated_steps(corrected) == TIMESTEP
    # Nearby they differ by what the change of the states changes of the defects alone.
    near = residuals(with_step(one, FINE), 0.3) - residuals(corrected, 0.3)
    assert 0.0 < noise_ratio(near) < 0.1 * noise_ratio(exact - residuals(one))
    # Defects are replaced, not added to those that are there.
    twice = module._with_defects(corrected, FINE)
    np.testing.assert_allclose(residuals(twice), exact, atol=1e-9)
    np.testing.assert_array_equal(residuals(module.without_defects(twice)), residuals(one))


def test_a_model_with_defects_has_their_time_step_and_is_handed_out_with_it(base, finer):
    assert (base.timestep, base.delivered) == (TIMESTEP, base.model)
    assert finer.timestep == pytest.approx(TIMESTEP / CFG.time_step.max_division)
    assert {w.defect.timestep for w in finer.windows if w.defect is not None} == {finer.timestep}
    assert finer.model.scene.model.opt.timestep == TIMESTEP
    assert simulated_steps(finer) == TIMESTEP
    assert finer.delivered.scene.model.opt.timestep == pytest.approx(finer.timestep)
    assert finer.delivered.effects == finer.model.effects


def test_a_step_that_is_too_long_is_shortened_until_it_explains_the_data(base, finer):
    assert base.ratio > 5
    assert finer.ratio < 1.25
    assert finer.errors.sum() < 0.01 * base.errors.sum()
    # Its residuals are those of simulations with the shorter step, at its own states.
    exact = residuals(with_step(finer, finer.timestep))
    assert noise_ratio(exact - residuals(finer)) < CFG.time_step.max_error
    told = finding(base, finer, seed=0)
    assert (told.given, told.used) == (TIMESTEP, finer.timestep)
    assert told.gain == pytest.approx(1 - finer.errors.sum() / base.errors.sum())
    assert told.low <= told.gain <= told.high
    assert told.change > 5
    with stop_at(time.time() - 1):
        assert finding(base, finer, seed=0) == told  # what was found as the time ended is told nevertheless


def test_a_step_that_is_short_enough_stays(base):
    assert finer_time_step(fitted(swung(damping=0.0, timestep=FINE), timestep=FINE), CFG) is None
    assert finer_time_step(base, replace(CFG, time_step=TimeStepCfg(max_division=1))) is None
    assert finer_time_step(base, replace(CFG, time_step=TimeStepCfg(max_error=1e3))) is None


def test_a_shorter_step_that_promises_no_more_is_not_fitted(monkeypatch):
    # The motion was simulated with the step as given.
    given = fitted(swung(damping=0.0))
    assert module._division(given, CFG.time_step) > 1
    monkeypatch.setattr(module, "refitted", lambda _one: pytest.fail("it promises nothing"))
    assert finer_time_step(given, CFG) is None


def test_a_shorter_step_is_taken_where_it_explains_a_relevant_and_significant_share(base, finer):
    gain = 1 - finer.errors.sum() / base.errors.sum()
    eager = replace(CFG.search, min_expected_gain=0.0)
    for share, level, taken in ((0.999 * gain, 0.05, True), (1.0001 * gain, 0.05, False), (0.05, 1e-9, False)):
        cfg = replace(CFG, min_gain=share, significance_level=level, search=eager)
        assert (finer_time_step(base, cfg) is not None) == taken


def test_the_step_is_divided_into_as_many_parts_as_its_error_asks_for(base, monkeypatch):
    error = 2 * noise_ratio(
        np.concatenate(
            module._projected(base, [residuals(with_step(base, TIMESTEP / 2)) - base.fit.linear[0].residual])
        )
    )
    for parts in (2.5, 6.9):
        assert module._division(base, TimeStepCfg(max_error=error / parts)) == np.ceil(parts)
    assert module._division(base, TimeStepCfg(max_error=error / 100, max_division=50)) == 50
    assert module._division(base, TimeStepCfg(max_error=1.01 * error)) == 1
    monkeypatch.setattr(module, "_residuals", lambda one: [np.full(w.count, np.nan) for w in one.windows])
    assert module._division(base, TimeStepCfg()) == 1


def test_a_model_without_defects_is_renewed_unchanged(base, monkeypatch):
    monkeypatch.setattr(module, "refitted", lambda _one: pytest.fail("nothing to fit again"))
    assert renew_defects(base, CFG.time_step) is base


def test_renewed_defects_are_those_of_the_motion_that_is_fitted_with_them(base):
    # Defects about a motion far off, as before an effect was added.
    far = replace(base, fit=replace(base.fit, offsets=tuple(o + 30.0 for o in base.fit.offsets)))
    wrong = replace(base, windows=module._with_defects(far, FINE).windows)

    def error(one: FittedModel) -> float:
        return noise_ratio(residuals(with_step(one, FINE)) - residuals(one))

    found = renew_defects(wrong, CFG.time_step)
    assert found.timestep == FINE
    assert error(found) < CFG.time_step.max_error < error(wrong)


def test_defects_are_renewed_until_they_stay(finer, monkeypatch):
    refit, done = module.refitted, []
    changes = iter([9.0, 0.31, 0.29, 9.0])

    def refitted(one: FittedModel) -> FittedModel:
        done.append(one)
        return refit(one)

    monkeypatch.setattr(module, "refitted", refitted)
    monkeypatch.setattr(module, "noise_ratio", lambda _change: next(changes))
    renew_defects(finer, TimeStepCfg())
    assert len(done) == 3
    done.clear()
    monkeypatch.setattr(module, "noise_ratio", lambda _change: 9.0)
    renew_defects(finer, TimeStepCfg(max_renewals=2))
    assert len(done) == 2


def test_defects_that_do_not_come_to_stay_are_renewed_no_further(finer, monkeypatch):
    done: list[FittedModel] = []
    monkeypatch.setattr(module, "refitted", lambda one: done.append(one) or one)
    for changes, times in (([9.0, 9.0, 0.1], 2), ([9.0, 6.0, 0.1], 3), ([9.0, 6.0, 5.0, 0.1], 3)):
        left = iter(changes)
        monkeypatch.setattr(module, "noise_ratio", lambda _change, left=left: next(left))
        done.clear()
        renew_defects(finer, TimeStepCfg())
        assert len(done) == times


def test_an_effect_is_found_beside_a_step_that_is_too_long():
    recording = swung(damping=DAMPING, timestep=FINE)
    coarse = module._with_defects(fitted(recording), FINE)
    base = renew_defects(module.refitted(coarse), CFG.time_step)
    found = fit_candidate(base, screen(base, effect_class("joint_damping")("hinge")))
    added = renew_defects(add_candidate(base, found), CFG.time_step)
    assert added.timestep == FINE
    assert added.ratio < 1.1
    assert added.fit.values[-1] == pytest.approx(DAMPING, rel=0.01)
    # With the step as given the value takes up its error.
    given = fitted(recording)
    plain = fit_candidate(given, screen(given, effect_class("joint_damping")("hinge")))
    assert abs(plain.fit.values[-1] / DAMPING - 1) > 0.04
    restored = at_given_step(added, TIMESTEP, CFG.time_step)
    assert restored.timestep == TIMESTEP
    assert all(w.defect is None for w in restored.windows)
    assert restored.fit.values[-1] == pytest.approx(plain.fit.values[-1], rel=0.02)
    assert restored.errors.sum() > 2 * added.errors.sum()


def test_states_far_off_are_fitted_by_simulations_with_the_shorter_step():
    given = fitted(swung(damping=0.0, timestep=FINE), 0.5)
    one = renew_defects(module.refitted(module._with_defects(given, FINE)), CFG.time_step)
    least = TimeStepCfg().max_state_offset
    # Of the last one no more than noise is left.
    spoiled = [np.array(o) for o in ([0.5, 0.5], [9.0, -9.0], [0.0, 0.9 * least], [9.0, 9.0])]
    pieces = [replace(p, residual=p.residual + 5.0 * (w < 3)) for w, p in enumerate(one.pieces)]
    lost: Any = replace(one, fit=replace(one.fit, offsets=tuple(spoiled)), pieces=tuple(pieces))
    found = module._at_states_of_shorter_step(lost, TimeStepCfg())
    assert found is not None
    moved = [not np.array_equal(a, b) for a, b in zip(found.fit.offsets, spoiled, strict=True)]
    assert moved == [False, True, False, False]
    exact = with_step(one, FINE).solver()
    alone, starts = exact.fit_initial_states(one.fit.values, [np.zeros(2)] * 4)
    np.testing.assert_allclose(found.fit.offsets[1], alone[1], atol=1e-9)
    np.testing.assert_allclose(found.fit.starts[1], starts[1], atol=1e-6)
    assert found.fit.starts[0] is one.fit.starts[0]
    # Defects are those at these states, for simulations with the step as given.
    np.testing.assert_allclose(residuals(found), residuals(with_step(found, FINE)), atol=1e-9)
    assert simulated_steps(found) == TIMESTEP
    near = replace(lost, fit=replace(one.fit, offsets=(*spoiled[:1], np.full(2, least), *spoiled[2:])))
    assert module._at_states_of_shorter_step(near, TimeStepCfg()) is None
    # At the measured states the shorter step leaves a small part of what the long one does, but not none.
    assert module._at_states_of_shorter_step(lost, TimeStepCfg(max_misfit_left=0.0)) is None


@pytest.mark.parametrize(
    ("change", "ratio", "expected"),
    [
        (102.0, 13.8, True),
        (102.0, 23.0, False),
        (6.0, 1.3, False),
        (8.0, 1.9, True),
        (203.0, 90.0, False),
        (217.0, 90.0, True),
    ],
)
def test_what_may_be_the_error_of_the_shorter_step_is_no_sign_that_something_is_missing(change, ratio, expected):
    last: Any = SimpleNamespace(noise_ratio=ratio)
    step = FinerTimeStep(2e-3, 2.5e-4, change, 0.98, 0.97, 0.99)
    assert step.error == pytest.approx(change / 7)
    assert may_be_step(last, step, TimeStepCfg()) == expected
    assert may_be_step(last, step, TimeStepCfg(), of_any_size=True) == (change == 217.0)
    assert "shorten the step" not in step.sentence
    too_long = replace(step, too_long=True)
    assert "shorten the step of the model further" in too_long.sentence
    assert too_long.to_json()["too_long"]


def test_a_step_for_impacts_says_by_how_much_their_scatter_falls():
    step = FinerTimeStep(2e-3, 2.5e-4, 27.0, 0.55, 0.55, 0.55, impacts=True)
    assert step.error == pytest.approx(0.45 * 27)
    assert "27 x noise (rms), with 0.25 ms by 12 x" in step.sentence
    assert step.to_json()["impacts"]
    # That scatter counts as noise already: what is left beyond both is no error of the step.
    last: Any = SimpleNamespace(noise_ratio=3.0)
    assert may_be_step(last, replace(step, impacts=False, change=84.0), TimeStepCfg())
    assert not may_be_step(last, step, TimeStepCfg())


def test_simulations_take_the_longest_steps_that_change_little_and_predict_what_the_given_ones_do():
    given, limits = fitted(swung(damping=0.0, timestep=FINE), timestep=FINE), TimeStepCfg(max_error_of_longer=4.0)
    found = longer_time_step(given, limits)
    factor = round(simulated_steps(found) / FINE)
    assert 1 < factor < limits.max_lengthening
    assert (found.timestep, found.delivered.scene.model.opt.timestep) == (FINE, FINE)
    np.testing.assert_allclose(residuals(found), residuals(given), atol=1e-9)
    uncorrected = noise_ratio(residuals(module.without_defects(found)) - residuals(given))
    assert uncorrected > 10 * noise_ratio(residuals(found, 0.3) - residuals(given, 0.3))
    changes = [module._change(given, with_step(given, k * FINE)) for k in (factor, factor + 1)]
    assert changes[0] <= limits.max_error_of_longer < changes[1]
    for cfg in (TimeStepCfg(max_lengthening=1), TimeStepCfg(max_error_of_longer=1e-6)):
        assert longer_time_step(given, cfg) is given


def test_an_effect_that_is_found_with_longer_steps_has_the_values_of_the_given_ones():
    given = fitted(swung(damping=DAMPING, timestep=FINE), timestep=FINE)
    longer, values = longer_time_step(given, TimeStepCfg(max_error_of_longer=4.0)), []
    for base in (given, longer):
        candidate = fit_candidate(base, screen(base, effect_class("joint_damping")("hinge")))
        values.append(renew_defects(add_candidate(base, candidate), CFG.time_step).fit.values[-1])
    assert simulated_steps(longer) > FINE
    assert values[1] == pytest.approx(values[0], rel=2e-3)
    assert values[0] == pytest.approx(DAMPING, rel=0.02)


def test_steps_stay_as_given_where_a_body_in_flight_hits_something():
    recording, _ = bounced(2, off=0.0)
    model = Model(Scene(recording.scene))
    windows = observe(model, recording)
    one = fit_baseline(model, windows, cut_blocks(windows))
    assert not all(w.smooth for w in one.windows)
    anyway = TimeStepCfg(max_error_of_longer_in_contact=1e3, max_share_of_contact=1e3)
    assert longer_time_step(one, anyway) is one


def test_steps_are_short_beside_the_time_constants_of_contacts():
    text = """
    <mujoco><option timestep="0.001"/><worldbody>
      <geom type="plane" size="1 1 1" solref="{floor} 1"/>
      <geom size="0.1" solref="0.001 1" contype="0" conaffinity="0"/>
      <body pos="0 0 1"><freejoint/><geom size="0.1" solref="-1000 -10"/></body>
    </worldbody></mujoco>"""
    for floor, longest in ((0.02, 0.004), (0.01, 0.002), (-500.0, np.inf)):
        one: Any = SimpleNamespace(model=Model(Scene(text.format(floor=floor))))
        assert module._longest_step(one, CFG.time_step) == pytest.approx(longest)
