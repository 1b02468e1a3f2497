"""Constraints that give way, or depend on direction, by the simulator's default constants: no missing effect.

Where a model leaves these constants at their defaults, the same model with constraints that hold (friction, equality
constraints, limits of joints), or with elliptic cones, is a rival of every effect; it has no parameters and therefore
comes first where it explains more. A coefficient of friction that is wrong hides what the cones do: with a pyramid no
coefficient fits, and with an ellipse the wrong one may fit worse. Cones are therefore compared beside a fitted
coefficient, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from concent_warp.diagnosis.candidates.baseline import errors_like, fitted_model
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.diagnosis.candidates.screening import robust_sum
from concent_warp.diagnosis.cfg import DiagnoseCfg, TimeStepCfg
from concent_warp.diagnosis.constants import HoldingConstraint
from concent_warp.diagnosis.search.time_step import explains_more, projected_residuals, refitted, renew_defects
from concent_warp.effects.effect import Effect
from concent_warp.fit.effects.cross_validation import bootstrap_interval
from concent_warp.scene.holding import Holding, holding_constants, with_holding_constraints
from concent_warp.scene.scene import Scene

COEFFICIENT = "sliding_friction"
"""Effect beside which cones are compared."""


def hold(
    base: FittedModel, known: Sequence[HoldingConstraint], cfg: DiagnoseCfg
) -> tuple[FittedModel, tuple[HoldingConstraint, ...]]:
    """Return a fitted model with constraints that hold wherever that explains significantly more, and which do.

    Args:
        base: The fitted model.
        known: Constraints that hold already.
        cfg: Settings.
    """
    found, tried = tuple(known), {h.where for h in known}
    for where in get_args(Holding):
        if where in tried:
            continue
        if (better := _holding(base, where, cfg)) is not None:
            found, base = (*found, _finding(base, better, where, cfg.seed)), better
        elif where == "cones" and (pair := _beside_coefficient(base, where, cfg)) is not None:
            one, better, base = pair
            found = (*found, replace(_finding(one, better, where, cfg.seed), beside=COEFFICIENT))
    return base, found


def with_scene(last: FittedModel, scene: Scene, cfg: TimeStepCfg) -> FittedModel:
    """Return a fitted model with another scene but for the time step, all parameters fitted again."""
    scene = scene.with_timestep(last.model.scene.model.opt.timestep)
    return renew_defects(refitted(replace(last, model=replace(last.model, scene=scene))), cfg)


def _holding(base: FittedModel, where: Holding, cfg: DiagnoseCfg) -> FittedModel | None:
    """Return a fitted model with constraints that hold if that explains significantly more, else None."""
    scene = with_holding_constraints(base.model.scene, where)
    if scene is None:
        return None
    other = replace(base, model=replace(base.model, scene=scene))
    before = robust_sum(base, [piece.residual for piece in base.pieces])
    after = robust_sum(base, projected_residuals(base, other))
    if not after <= (1 - cfg.search.min_expected_gain * cfg.min_gain) * before:  # or not finite
        return None
    found = renew_defects(refitted(other), cfg.time_step)
    return found if explains_more(base, found, cfg) else None


def _beside_coefficient(
    base: FittedModel, where: Holding, cfg: DiagnoseCfg
) -> tuple[FittedModel, FittedModel, FittedModel] | None:
    """Return fitted models with other friction where a coefficient of friction explains significantly more with it.

    They are the model as it is and the one with other friction, both with a fitted coefficient, and the latter without;
    None where the other friction explains no more, or where no coefficient may be wrong.
    """
    scene = with_holding_constraints(base.model.scene, where)
    kinds = [] if scene is None else candidates(base.model, (), (COEFFICIENT,))
    if scene is None or not kinds:
        return None
    other = replace(base, model=replace(base.model, scene=scene))
    without, with_it = (_with_effect(one, kinds[0]) for one in (base, other))
    if not (explains_more(without, with_it, cfg) and explains_more(base, with_it, cfg)):
        return None
    return without, with_it, renew_defects(refitted(other), cfg.time_step)


def _with_effect(base: FittedModel, effect: Effect) -> FittedModel:
    """Return a fitted model with one effect more, all parameters fitted."""
    solver = base.solver(effect)
    start = np.concatenate([base.fit.values, solver.p.start[solver.p.owned :]])
    fit = solver.improve_initial_states(solver.fit(start, base.fit.offsets, base.fit.starts), [])
    return fitted_model(solver.p.model(fit.values), base.windows, base.blocks, fit, base.engine, base.cfg)


def _finding(base: FittedModel, better: FittedModel, where: Holding, seed: int) -> HoldingConstraint:
    """Return what constraints that hold change."""
    gain = base.errors - errors_like(better, base)
    low, high = bootstrap_interval(gain, base.errors, base.blocks.demonstration, np.random.default_rng(seed))
    settings = holding_constants(base.model.scene, where)
    return HoldingConstraint(where, settings, float(gain.sum() / max(base.errors.sum(), 1e-12)), low, high)
