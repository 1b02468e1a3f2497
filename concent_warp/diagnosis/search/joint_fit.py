"""The effects of a diagnosis fitted together: the values, intervals and gains that every output states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import fitted_model
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.result import Finding
from concent_warp.fit.effects.cross_validation import block_sums, bootstrap_interval
from concent_warp.fit.effects.intervals import NORMAL_QUANTILE, FittedParameter, clustered_std, formula_errors


def refit_jointly(last: FittedModel) -> FittedModel:
    """Return a model with all parameters and initial states fitted together once more, where that lowers the cost."""
    if last.fit.polished:
        return last
    solver = last.solver()
    fit = solver.polish(last.fit, thorough=True)
    if fit.cost >= last.fit.cost:
        return last
    return fitted_model(solver.p.model(fit.values), last.windows, last.blocks, fit, last.engine, last.cfg)


def joint_parameters(
    last: FittedModel, widening: Mapping[int, np.ndarray] | None = None, nominal: np.ndarray | None = None
) -> list[tuple[FittedParameter, ...]]:
    """Return the parameters of each effect of a fitted model with 95 % intervals, in the order of its effects.

    The spread is that of the joint fit, robust to correlation within and between blocks, see `clustered_std`; the error
    of the formulas themselves is included, see `formula_errors`.

    Args:
        last: The fitted model.
        widening: By how much the profile likelihood of an effect is wider than the linear fit, by the index of the
            effect, one factor a parameter.
        nominal: Standard deviations of all parameters due to errors of nominal values, in units of their scale (P,),
            see `nominal_errors`.
    """
    prediction = last.prediction()
    sums = block_sums(last.pieces, last.blocks, last.limit)
    std = clustered_std(sums, last.blocks, last.cfg.least_squares.prior)
    nominal = np.zeros(len(std)) if nominal is None else nominal
    found = []
    for k, part in enumerate(prediction.split):
        parameters, values = prediction.parameters[part], last.fit.values[part]
        formula = formula_errors(last.model.effects[k].effect, parameters, values, last.cfg.discretisation_error)
        factors = np.ones(len(parameters)) if widening is None or k not in widening else widening[k]
        spread = np.hypot(std[part] * factors, nominal[part]) * [p.scale for p in parameters]
        reaches = NORMAL_QUANTILE * np.hypot(spread, formula)
        found.append(
            tuple(
                FittedParameter.within(p, float(value), float(reach))
                for p, value, reach in zip(parameters, values, reaches, strict=True)
            )
        )
    return found


def joint_finding(
    finding: Finding, parameters: tuple[FittedParameter, ...], last: FittedModel, without: FittedModel, seed: int
) -> Finding:
    """Return an accepted effect with its values and its gain in the final model.

    Args:
        finding: The effect as it was accepted.
        parameters: Its parameters in the final model.
        last: The final model.
        without: The same without the effect, all else fitted again.
        seed: Seed of the bootstrap.
    """
    gain, rng = without.errors - last.errors, np.random.default_rng(seed)
    low, high = bootstrap_interval(gain, without.errors, last.blocks.demonstration, rng)
    share = float(gain.sum() / max(without.errors.sum(), 1e-12))
    return replace(finding, parameters=parameters, gain=share, low=low, high=high)


def with_intervals(last: FittedModel, parameters: Sequence[tuple[FittedParameter, ...]]) -> FittedModel:
    """Return a fitted model whose effects have the intervals of their parameters."""
    intervals = [(p.low, p.high) for group in parameters for p in group]
    return replace(last, model=last.prediction().model(last.fit.values, intervals))
