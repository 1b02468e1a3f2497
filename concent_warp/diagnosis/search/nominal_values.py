"""Nominal values within their tolerance: those that show in the data are fitted before effects are searched for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.cfg import NominalCfg
from concent_warp.diagnosis.search.baseline import fitted_model
from concent_warp.diagnosis.search.candidate import FittedModel
from concent_warp.effects.effect import AddedEffect, Effect
from concent_warp.effects.registry import NOMINAL
from concent_warp.fit.effects.cross_validation import HeldOut, block_sums
from concent_warp.fit.effects.intervals import FittedParameter
from concent_warp.model import Model


def with_nominal_values(base: FittedModel, cfg: NominalCfg) -> FittedModel | None:
    """Return a fitted model with the nominal values that the data show within their tolerance, before other effects.

    It is None where none shows, where they predict held-out data no better, or where one runs to its bound and more
    than noise is left: then something larger is missing.

    Args:
        base: The fitted model.
        cfg: Settings.
    """
    visible = _visible(base, cfg)
    if not visible:
        return None
    compiled = base.model.compile()
    added = [AddedEffect(e, tuple(p.null for p in e.parameters(compiled))) for e in visible]
    solver = replace(base, model=replace(base.model, effects=(*added, *base.model.effects))).solver()
    nominal = len(solver.p.start) - len(base.fit.values)
    start = np.concatenate([solver.p.start[:nominal], base.fit.values])
    # Within the tolerance residuals are in proportion to the values: no polish is needed.
    fit = solver.fit(start, base.fit.offsets, base.fit.starts)
    found = fitted_model(solver.p.model(fit.values), base.windows, base.blocks, fit, base.engine, base.cfg)
    bounded = [
        FittedParameter.within(p, v, 0.0) for p, v in zip(solver.p.parameters[:nominal], fit.values, strict=False)
    ]
    inside = found.ratio <= cfg.bounded_ratio or not any(p.at_bound for p in bounded)
    sums, prior = block_sums(found.pieces, found.blocks, found.limit), base.cfg.least_squares.prior
    # Here the values themselves are judged: each fold is predicted from those of the others.
    errors = HeldOut(sums, found.blocks, prior).own()
    return found if inside and errors.sum() < base.errors.sum() else None


def nominal_effects(model: Model) -> list[int]:
    """Return which of a model's effects are nominal values, by their indices."""
    return [i for i, added in enumerate(model.effects) if added.effect.nominal]


def without_nominal_values(last: FittedModel) -> FittedModel:
    """Return the fitted model with its nominal values as given, all that is left fitted again."""
    dropped = nominal_effects(last.model)
    effects = tuple(a for i, a in enumerate(last.model.effects) if i not in dropped)
    solver = replace(last, model=replace(last.model, effects=effects)).solver()
    fit = solver.fit(offsets=last.fit.offsets, starts=last.fit.starts)
    return fitted_model(solver.p.model(fit.values), last.windows, last.blocks, fit, last.engine, last.cfg)


def _visible(base: FittedModel, cfg: NominalCfg) -> list[Effect]:
    """Return the nominal values that change the predictions measurably within their tolerance, as effects.

    Values whose changes the others can produce are left out, the least visible first.
    """
    compiled, present = base.model.compile(), {a.effect.name for a in base.model.effects}
    kinds = [kind(*names) for kind in NOMINAL if kind.name not in present for names in kind.targets(compiled)]
    columns, owners = [], []
    for effect in kinds:
        solver = base.solver(effect)
        linear = solver.linearise(solver.p.start, base.fit.offsets)
        pieces = base.projected(replace(base.fit, linear=linear))
        stacked = np.concatenate([piece.jacobian[:, solver.p.owned :] for piece in pieces])
        columns.append(base.cfg.least_squares.prior * stacked)
        owners += [(effect, target) for target in effect.target]
    if not owners:
        return []
    chosen = _independent(np.hstack(columns), cfg)
    found = []
    for effect in kinds:
        names = [owners[k][1] for k in sorted(chosen) if owners[k][0] is effect]
        if names:
            found.append(type(effect)(*names))
    return found


def _independent(columns: np.ndarray, cfg: NominalCfg) -> Sequence[int]:
    """Return which columns (n, K) change the residuals by more than `min_change` beyond those chosen before them.

    Gram-Schmidt with pivoting (Golub and Van Loan, "Matrix Computations", 2013, section 5.4).
    """
    left, chosen = np.nan_to_num(columns, posinf=0.0, neginf=0.0), []
    least = cfg.min_change * np.sqrt(len(columns))
    while len(chosen) < cfg.max_values:
        sizes = np.linalg.norm(left, axis=0)
        k = int(np.argmax(sizes))
        if sizes[k] < least:
            break
        chosen.append(k)
        direction = left[:, k] / sizes[k]
        left = left - np.outer(direction, direction @ left)
        left[:, k] = 0.0
    return chosen
