"""Residuals in units of a model's own error: what is told of them stays in units of the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search import time_step
from concent_warp.diagnosis.search.adequacy import discrepancies, is_adequate, is_lacking
from concent_warp.diagnosis.search.nominal_values import nominal_errors
from concent_warp.effects.library.joints import JointDamping
from concent_warp.fit.effects.cross_validation import cut_blocks
from tests.scenes.swinging import TIMESTEP, drawing, swung, windows_of

SCALE = 4.0
RECORDING = swung(seconds=1.0)
CFG = DiagnoseCfg(jobs=1)


def in_units_of_its_error(one: FittedModel) -> FittedModel:
    """Return the same fitted model with residuals in units of `SCALE` times the noise."""
    windows = tuple(
        replace(
            w,
            noise_scale=SCALE,
            readings=tuple(replace(r, std=SCALE * r.std) for r in w.readings),
            defect=w.defect and replace(w.defect, residual=w.defect.residual / SCALE),
        )
        for w in one.windows
    )
    pieces = tuple(replace(p, residual=p.residual / SCALE, jacobian=p.jacobian / SCALE) for p in one.pieces)
    return replace(one, windows=windows, pieces=pieces, limit=one.limit / SCALE)


@pytest.fixture(scope="module")
def plain() -> FittedModel:
    """Return a pendulum that lacks its damping, fitted."""
    windows = windows_of(RECORDING)
    return fit_baseline(drawing(RECORDING), windows, cut_blocks(windows))


def test_noise_ratios_and_discrepancies_are_those_beside_the_noise(plain):
    scaled = in_units_of_its_error(plain)
    assert (plain.noise_scale, scaled.noise_scale) == (1.0, SCALE)
    assert plain.noise_ratio > 5
    assert scaled.noise_ratio == pytest.approx(plain.noise_ratio)
    # So small that no residual counts as an outlier in either unit.
    near = replace(plain, pieces=tuple(replace(p, residual=p.residual / 1000) for p in plain.pieces))
    assert in_units_of_its_error(near).ratio == pytest.approx(near.ratio)
    assert discrepancies(scaled, scaled) == pytest.approx(discrepancies(plain, plain))
    assert not is_adequate(scaled, {}, CFG)
    assert is_lacking(scaled, {}, CFG)


def test_the_noise_ratio_of_a_candidate_is_that_beside_the_noise(plain):
    ratios = []
    for unit in (1.0, SCALE):
        windows = [
            replace(w, noise_scale=unit, readings=tuple(replace(r, std=unit * r.std) for r in w.readings))
            for w in plain.windows
        ]
        base = fit_baseline(plain.model, windows, plain.blocks)
        found = fit_candidate(base, screen(base, JointDamping("hinge")))
        ratios.append(found.ratio)
        assert 0.8 < found.ratio < 1.1
    assert ratios[1] == pytest.approx(ratios[0], rel=0.05)


def test_errors_of_nominal_values_do_not_depend_on_the_unit_of_residuals(plain):
    model = plain.model.add(JointDamping("hinge"), [0.02])
    windows = windows_of(RECORDING)
    fitted = fit_baseline(model, windows, cut_blocks(windows))
    found, scaled = nominal_errors(fitted, CFG), nominal_errors(in_units_of_its_error(fitted), CFG)
    assert found.min() > 0
    assert scaled == pytest.approx(found, rel=0.05)


def test_the_change_by_a_shorter_time_step_is_told_in_units_of_the_noise(plain):
    finer = time_step._with_defects(plain, TIMESTEP / 2)
    told = time_step.finding(plain, finer, seed=0)
    scaled = time_step.finding(in_units_of_its_error(plain), in_units_of_its_error(finer), seed=0)
    assert told.change > 1
    assert scaled.change == pytest.approx(told.change, rel=0.05)
    assert np.isclose(scaled.gain, told.gain)
