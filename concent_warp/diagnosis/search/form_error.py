"""Errors in the formulas of accepted effects, told by a flexible correction from another effect that is missing.

No formula is exact outside a simulator. What the right effect leaves depends on the variables of its formula: a force
of no known form (`concent_warp.diagnosis.search.unknown_force`) in these variables explains it. Another effect is
missing only if it explains what such a correction does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search.unknown_force import Results, combined, forces, held_out, with_interleaved_folds
from concent_warp.effects.effect import Effect, Variable
from concent_warp.effects.force_model import ForceModel
from concent_warp.effects.unknown_force import UnknownJointForce


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


def _variable(force: ForceModel | None) -> Variable | None:
    """Return the variable of a force of no known form, None where it is none of a formula."""
    return "joint velocity" if isinstance(force, UnknownJointForce) and force.moving else None
