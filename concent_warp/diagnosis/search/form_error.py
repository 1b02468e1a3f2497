"""Errors in the formulas of accepted effects, told by a flexible correction from another effect that is missing.

No formula is exact outside a simulator. What the right effect leaves depends on the variables of its formula: a force
of no known form (`concent_warp.diagnosis.search.unknown_force`) in these variables explains it. Another effect is
missing only if it explains what such a correction does not.

Nor are the formulas exact that the model has. Dry friction is the roughest of them: what no effect explains, and is
little beside what the model's own friction does, may be its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search.adequacy import channel_residuals
from concent_warp.diagnosis.search.nominal_values import nominal_sensitivities
from concent_warp.diagnosis.search.unknown_force import (
    Results,
    combined,
    force_beside,
    forces,
    held_out,
    with_interleaved_folds,
)
from concent_warp.effects.effect import Effect, Variable
from concent_warp.effects.force_model import ForceModel
from concent_warp.effects.library.nominal import FRICTION_TOLERANCE, NominalFriction
from concent_warp.effects.unknown_force import UnknownJointForce
from concent_warp.fit.effects.nominal import possible_nominal_effects
from concent_warp.fit.effects.robust import robust_noise_ratio


def flexible_correction(
    one: FittedModel, effects: Sequence[Effect], cfg: DiagnoseCfg, results: Results
) -> np.ndarray | None:
    """Return the held-out error of a model with a flexible correction of some of its effects, None without one.

    The correction is a linear step in forces of no known form over the variables of the effects' formulas.

    Args:
        one: The fitted model.
        effects: The effects that are corrected.
        cfg: Settings of the diagnosis.
        results: Runs the simulations, see `Results`.

    Returns:
        The error of each block, those assigned to folds in turn, shape (B,).
    """
    wanted = {variable for effect in effects for variable in effect.variables}
    if not wanted or not all("mujoco" in added.effect.engines for added in one.model.effects):
        return None
    one = with_interleaved_folds(replace(one, engine="mujoco"))
    m = one.model.compile()
    chosen = [f for f in forces(one, cfg.unknown_force) if _variable(f.force_model(m)) in wanted]
    screened = list(results(screen, [(one, f, cfg.search) for f in chosen]))
    if not screened:
        return None
    found = [held_out(one, combined(one, screened, share)) for share in cfg.unknown_force.expected_shares]
    return min(found, key=np.sum)


def error_of_own_friction(last: FittedModel, cfg: DiagnoseCfg, results: Results) -> float | None:
    """Return what a model leaves over what its own dry friction does, where it may be the error of that formula.

    Both are RMS changes of the predictions. It is None where more is left than `DiagnoseCfg.form_error_ratio`, in any
    channel, or than a tenth of what friction does, see `DiagnoseCfg.small_form_error`; and where a force of no known
    form explains most of it, which other variables than those of friction may cause.

    Args:
        last: The fitted model, to which no effect was added.
        cfg: Settings of the diagnosis.
        results: Runs the simulations, see `Results`.
    """
    left = last.ratio**2 - 1
    kinds = [kind for kind in possible_nominal_effects(last.model) if isinstance(kind, NominalFriction)]
    runs = all("mujoco" in added.effect.engines for added in last.model.effects)
    if last.ratio > cfg.form_error_ratio or left <= 0 or not kinds or not runs:
        return None
    worst = max(robust_noise_ratio([r]) for r in channel_residuals(last).values())
    if last.noise_scale * worst > cfg.form_error_ratio:
        return None
    columns = nominal_sensitivities(last).of(kinds) / FRICTION_TOLERANCE
    share = float(np.sqrt(left / max((np.nan_to_num(columns) ** 2).sum(axis=1).mean(), 1e-12)))
    if share**2 > cfg.small_form_error:
        return None
    force = force_beside(last, cfg, results)
    explained = 0.0 if force is None else force.gain * last.ratio**2
    return None if explained > cfg.min_remainder_gain * left else share


def said_of_own_friction(share: float | None) -> tuple[str, ...]:
    """Return the sentence that goes with `error_of_own_friction`, none where that is None."""
    if share is None:
        return ()
    said = (
        f"What is left is {100 * share:.2g} % of what the model's own dry friction does, and may be the error of its "
        "formula: no effect explains it, and no force that depends on positions or velocities explains most of it."
    )
    return (said,)


def _variable(force: ForceModel | None) -> Variable | None:
    """Return the variable of a force of no known form, None where it is none of a formula."""
    return "joint velocity" if isinstance(force, UnknownJointForce) and force.moving else None
