"""A flexible correction of an effect's formula, and what an effect beside it must explain: a damped pendulum."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import add_candidate, fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import UnknownForceFound
from concent_warp.diagnosis.search import form_error
from concent_warp.diagnosis.search.form_error import (
    error_of_own_friction,
    flexible_correction,
    said_of_own_friction,
)
from concent_warp.diagnosis.search.unknown_force import with_interleaved_folds
from concent_warp.diagnosis.tasks import run_tasks
from concent_warp.effects.effect import Effect
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import DAMPING, drawing, swing_scene, swung, windows_of

CFG = DiagnoseCfg(jobs=1, explain=False)
RECORDING = swung(damping=DAMPING / 50)


def effect(name: str) -> Effect:
    return effect_class(name)("hinge")


def results(task: Any, tasks: Any) -> Any:
    return run_tasks(task, tasks, 1)


@pytest.fixture(scope="module")
def lacking() -> FittedModel:
    """Return the model as given, which lacks the damping."""
    windows = windows_of(RECORDING)
    return fit_baseline(drawing(RECORDING), windows, cut_blocks(windows), "mujoco")


def with_effect(base: FittedModel, name: str) -> FittedModel:
    return add_candidate(base, fit_candidate(base, screen(base, effect(name))))


@pytest.fixture(scope="module")
def with_friction(lacking) -> FittedModel:
    """Return the model with dry friction in the place of the damping: the wrong formula of the right variable."""
    return with_effect(lacking, "joint_friction")


def test_a_flexible_correction_takes_away_what_a_wrong_formula_leaves(with_friction):
    errors = with_interleaved_folds(with_friction).errors
    corrected = flexible_correction(with_friction, [effect("joint_friction")], CFG, results)
    assert corrected is not None
    assert corrected.shape == errors.shape
    assert corrected.sum() < 0.7 * errors.sum()
    # About the noise: as the damping itself leaves.
    assert with_friction.ratio > 1.3
    assert with_friction.ratio * np.sqrt(corrected.sum() / errors.sum()) < 1.1


def test_an_effect_of_other_variables_has_no_correction(with_friction):
    assert effect("armature").variables == ()
    assert flexible_correction(with_friction, [effect("armature")], CFG, results) is None
    assert flexible_correction(with_friction, [], CFG, results) is None


def procedure() -> Procedure:
    return Procedure(drawing(RECORDING), RECORDING, CFG)


def test_only_what_may_be_an_error_of_a_formula_is_corrected(lacking, with_friction):
    left = (with_friction.ratio**2 - 1) / (lacking.ratio**2 - 1)
    for share, ratio, corrected in ((left + 0.05, 9.0, True), (left - 0.05, 9.0, False), (left + 0.05, 1.1, False)):
        made = procedure()
        made.context.cfg = replace(CFG, max_form_error=share, form_error_ratio=ratio)
        assert (made.additions._correction(with_friction, lacking) is not None) is corrected
    assert procedure().additions._correction(lacking, lacking) is None


def test_an_effect_beside_another_must_explain_what_a_correction_of_that_does_not(with_friction):
    made = procedure()
    correction = flexible_correction(with_friction, [effect("joint_friction")], CFG, results)
    assert correction is not None
    damping = fit_candidate(with_friction, screen(with_friction, effect("joint_damping")))
    armature = fit_candidate(with_friction, screen(with_friction, effect("armature")))
    assert not made.additions._explains_more(with_friction, armature, correction)
    # The same without a correction worth the name.
    assert made.additions._explains_more(with_friction, damping, with_interleaved_folds(with_friction).errors)
    assert made.additions._is_corrected(with_friction, correction)
    assert not made.additions._is_corrected(with_friction, with_interleaved_folds(with_friction).errors)
    assert not made.additions._is_corrected(with_friction, None)


def test_a_remainder_that_a_correction_takes_away_is_an_error_of_form(lacking, with_friction):
    made = procedure()
    left = (with_friction.ratio**2 - 1) / (lacking.ratio**2 - 1)
    force = replace(CFG.unknown_force, min_share=0.0)
    made.context.cfg = replace(CFG, max_form_error=left + 0.05, form_error_ratio=9.0, unknown_force=force)
    assert not made.context.is_form_error(with_friction, lacking)
    made.record.form_corrected = True
    assert made.context.is_form_error(with_friction, lacking)
    made.context.cfg = replace(made.context.cfg, max_form_error=left - 0.05)
    assert not made.context.is_form_error(with_friction, lacking)


@pytest.mark.parametrize(
    ("ratio", "friction", "explained", "channel", "found"),
    [
        (1.5, 20.0, 0.0, 1.9, 0.056),  # sqrt(1.25) x noise beside 20
        (1.5, 20.0, 0.27, 1.9, 0.056),  # of 2.25, half of 1.25
        (1.5, 20.0, 0.29, 1.9, None),
        (1.5, 20.0, 0.0, 2.1, None),  # one channel is farther off
        (1.5, 11.0, 0.0, 1.9, None),  # more than a tenth
        (2.1, 50.0, 0.0, 1.9, None),  # too much beside the noise
        (1.0, 50.0, 0.0, 1.0, None),
        (1.5, None, 0.0, 1.9, None),  # no friction at all
    ],
)
def test_what_is_little_beside_the_models_own_friction_may_be_its_error(
    monkeypatch, with_friction, ratio, friction, explained, channel, found
):
    model = (
        with_friction.model
        if friction is None
        else Model(Scene(swing_scene().replace("damping=", "frictionloss='0.01' damping=")))
    )
    one = SimpleNamespace(model=model, ratio=ratio, noise_scale=1.0)
    seen = {"quiet": np.ones(40), "loud": np.full(40, channel)}
    monkeypatch.setattr(form_error, "channel_residuals", lambda _: seen)
    columns = np.full((100, 1), 0.05 * (friction or 1.0))
    monkeypatch.setattr(form_error, "nominal_sensitivities", lambda _: SimpleNamespace(of=lambda _kinds: columns))
    force = UnknownForceFound("a force", explained, 0.01, 1.0) if explained else None
    monkeypatch.setattr(form_error, "force_beside", lambda *_: force)
    share = error_of_own_friction(one, CFG, results)  # pyright: ignore[reportArgumentType]
    assert share == (None if found is None else pytest.approx(found, rel=0.01))
    assert bool(said_of_own_friction(share)) is (found is not None)
