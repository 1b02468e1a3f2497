"""The effects of a diagnosis fitted together: the values, intervals and gains that every output states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import errors_like, fitted_model
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.result import Finding
from concent_warp.effects.posterior import JointPosterior
from concent_warp.fit.effects.cross_validation import Sums, block_sums, bootstrap_interval
from concent_warp.fit.effects.intervals import (
    NORMAL_QUANTILE,
    FittedParameter,
    clustered_std,
    covariance,
    excludes_null,
    formula_errors,
    joint_posterior,
)
from concent_warp.fit.effects.prediction import Prediction


def refit_jointly(last: FittedModel) -> FittedModel:
    """Return a model with all parameters and initial states fitted together once more, where that lowers the cost."""
    solver = last.solver()
    begun = solver.better_from_measured_states(last.fit)
    if begun.polished:
        return last
    fit = solver.polish(begun, thorough=True)
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
    errors = _errors(last, prediction, sums, widening, nominal)
    found = []
    for part in prediction.split:
        parameters, values = prediction.parameters[part], last.fit.values[part]
        spread = np.hypot(errors.data[part], errors.nominal[part]) * [p.scale for p in parameters]
        reaches = NORMAL_QUANTILE * np.hypot(spread, errors.formula[part])
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
    gain, rng = without.errors - errors_like(last, without), np.random.default_rng(seed)
    low, high = bootstrap_interval(gain, without.errors, last.blocks.demonstration, rng)
    share = float(gain.sum() / max(without.errors.sum(), 1e-12))
    return replace(finding, parameters=parameters, gain=share, low=low, high=high)


def with_intervals(
    last: FittedModel,
    parameters: Sequence[tuple[FittedParameter, ...]],
    widening: Mapping[int, np.ndarray] | None = None,
    nominal: np.ndarray | None = None,
) -> FittedModel:
    """Return a fitted model whose effects have the intervals of their parameters, and their joint posterior.

    Args:
        last: The fitted model.
        parameters: What `joint_parameters` returned for it.
        widening: As given to that.
        nominal: As given to that.
    """
    prediction, fitted = last.prediction(), [p for group in parameters for p in group]
    posterior = _posterior(last, prediction, fitted, widening, nominal)
    return replace(last, model=prediction.model(last.fit.values, [(p.low, p.high) for p in fitted], posterior))


def established_effects(
    last: FittedModel,
    parameters: Sequence[tuple[FittedParameter, ...]],
    dependent_share: float,
    widening: Mapping[int, np.ndarray] | None = None,
    nominal: np.ndarray | None = None,
) -> list[bool]:
    """Return for each effect of a fitted model whether its values are not its null values, see `excludes_null`.

    Args:
        last: The fitted model.
        parameters: What `joint_parameters` returned for it.
        dependent_share: `SearchCfg.dependent_share`.
        widening: As given to `joint_parameters`.
        nominal: As given to that.
    """
    prediction, fitted = last.prediction(), [p for group in parameters for p in group]
    covered = _posterior(last, prediction, fitted, widening, nominal).matrix
    return [
        excludes_null(group, covered[part, part], dependent_share)
        for group, part in zip(parameters, prediction.split, strict=True)
    ]


def _posterior(
    last: FittedModel,
    prediction: Prediction,
    fitted: Sequence[FittedParameter],
    widening: Mapping[int, np.ndarray] | None,
    nominal: np.ndarray | None,
) -> JointPosterior:
    """Return the posterior of all parameters of a fitted model, see `joint_parameters`."""
    sums, prior = block_sums(last.pieces, last.blocks, last.limit), last.cfg.least_squares.prior
    errors, scale = _errors(last, prediction, sums, widening, nominal), [p.scale for p in prediction.parameters]
    independent = np.hypot(errors.nominal, errors.formula / scale)
    covered = covariance(sums, last.blocks, prior)
    return joint_posterior(prediction.parameters, fitted, covered, errors.data, independent)


@dataclass(frozen=True)
class _Errors:
    """Standard deviations of the parameters of a joint fit by their source, shape (P,) each."""

    data: np.ndarray
    """What the data leave, widened by the profile likelihood, in units of scale."""
    nominal: np.ndarray
    """Due to errors of nominal values, in units of scale."""
    formula: np.ndarray
    """Due to the form of the effects, in the units of the parameters."""


def _errors(
    last: FittedModel,
    prediction: Prediction,
    sums: Sums,
    widening: Mapping[int, np.ndarray] | None,
    nominal: np.ndarray | None,
) -> _Errors:
    """Return what leaves the parameters of a joint fit uncertain, see `joint_parameters`."""
    data = clustered_std(sums, last.blocks, last.cfg.least_squares.prior)
    formula = np.zeros(len(data))
    for k, part in enumerate(prediction.split):
        effect, values = last.model.effects[k].effect, last.fit.values[part]
        formula[part] = formula_errors(
            effect, prediction.parameters[part], values, last.cfg.discretisation_error, last.timestep
        )
        if widening is not None and k in widening:
            data[part] = data[part] * widening[k]
    return _Errors(data, np.zeros(len(data)) if nominal is None else nominal, formula)
