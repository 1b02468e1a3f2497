"""Dry friction that creeps, or depends on direction, by the simulator's default constants: no missing effect.

Where a model leaves these constants at their defaults, the same model with friction that holds, or with elliptic cones,
is a rival of every effect; it has no parameters and therefore comes first where it explains more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from concent_warp.diagnosis.candidates.baseline import errors_like
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.screening import robust_sum
from concent_warp.diagnosis.cfg import DiagnoseCfg, TimeStepCfg
from concent_warp.diagnosis.result import HoldingFriction
from concent_warp.diagnosis.search.time_step import explains_more, projected_residuals, refitted, renew_defects
from concent_warp.fit.effects.cross_validation import bootstrap_interval
from concent_warp.scene.holding import Holding, contact_constants, joint_constants, with_holding_friction
from concent_warp.scene.scene import Scene


def hold(
    base: FittedModel, known: Sequence[HoldingFriction], cfg: DiagnoseCfg
) -> tuple[FittedModel, tuple[HoldingFriction, ...]]:
    """Return a fitted model with dry friction that holds wherever that explains significantly more, and where it does.

    Args:
        base: The fitted model.
        known: Where friction holds already.
        cfg: Settings.
    """
    found, tried = tuple(known), {h.where for h in known}
    for where in get_args(Holding):
        if where not in tried and (better := _holding(base, where, cfg)) is not None:
            found, base = (*found, _finding(base, better, where, cfg.seed)), better
    return base, found


def with_scene(last: FittedModel, scene: Scene, cfg: TimeStepCfg) -> FittedModel:
    """Return a fitted model with another scene but for the time step, all parameters fitted again."""
    scene = scene.with_timestep(last.model.scene.model.opt.timestep)
    return renew_defects(refitted(replace(last, model=replace(last.model, scene=scene))), cfg)


def _holding(base: FittedModel, where: Holding, cfg: DiagnoseCfg) -> FittedModel | None:
    """Return a fitted model with friction that holds if that explains significantly more, else None."""
    scene = with_holding_friction(base.model.scene, where)
    if scene is None:
        return None
    other = replace(base, model=replace(base.model, scene=scene))
    before = robust_sum(base, [piece.residual for piece in base.pieces])
    after = robust_sum(base, projected_residuals(base, other))
    if not after <= (1 - cfg.search.min_expected_gain * cfg.min_gain) * before:  # or not finite
        return None
    found = renew_defects(refitted(other), cfg.time_step)
    return found if explains_more(base, found, cfg) else None


def _finding(base: FittedModel, better: FittedModel, where: Holding, seed: int) -> HoldingFriction:
    """Return what friction that holds changes."""
    gain = base.errors - errors_like(better, base)
    low, high = bootstrap_interval(gain, base.errors, base.blocks.demonstration, np.random.default_rng(seed))
    scene = base.model.scene
    settings = joint_constants(scene) if where == "joints" else contact_constants(scene, where)
    return HoldingFriction(where, settings, float(gain.sum() / max(base.errors.sum(), 1e-12)), low, high)
