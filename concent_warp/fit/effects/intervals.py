"""How sharply data determine the parameters of effects: covariance, and what the form of an effect leaves open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri, stdtrit

from concent_warp.effects.effect import Effect, Parameter
from concent_warp.effects.posterior import JointPosterior
from concent_warp.fit.effects.cross_validation import Blocks, Sums
from concent_warp.fit.effects.least_squares import LeastSquaresCfg

NORMAL_QUANTILE = 1.96
"""Half width of a 95 % interval of the normal distribution, in standard deviations [-]."""


@dataclass(frozen=True)
class FittedParameter:
    """A parameter of an effect, fitted."""

    name: str
    value: float
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end."""
    unit: str
    null: float
    """Value at which the effect does nothing."""
    at_bound: bool = False
    """Whether it has run to a bound that is not the null value; of `Parameter.is_side` it does not count."""

    @staticmethod
    def within(p: Parameter, value: float, reach: float) -> FittedParameter:
        """Return a parameter with the interval of a half width about its value, cut at its bounds."""
        low, high = max(value - reach, p.low), min(value + reach, p.high)
        bounds = [b for b in (p.low, p.high) if abs(b - p.null) > 1e-3 * p.scale]
        at_bound = not p.is_side and any(abs(value - b) < 1e-3 * p.scale for b in bounds)
        return FittedParameter(p.name, value, float(low), float(high), p.unit, p.null, at_bound)

    @property
    def excludes_null(self) -> bool:
        """Whether the interval excludes the null value; a limit that is infinite by default is excluded if finite."""
        return bool(np.isfinite(self.high)) if np.isinf(self.null) else not self.low <= self.null <= self.high


def covariance(sums: Sums, blocks: Blocks, prior: float = LeastSquaresCfg.prior) -> np.ndarray:
    """Return the covariance of the parameters, in units of their scale, robust to correlation within blocks (P, P).

    H^-1 (sum_b u_b u_b') H^-1 B / (B - P), the sandwich of Liang and Zeger, Biometrika 73, 1986, but not below H^-1,
    what independent noise of the stated size would leave. `prior` is `LeastSquaresCfg.prior`: combinations of which the
    data say less, such as the difference of two joints that move as one, have no scores, and keep its variance.
    """
    size, normal = sums.slope.shape[1], sums.normal.sum(axis=0)
    inverse = np.linalg.pinv(normal + np.eye(size) / prior**2, hermitian=True)
    scores = (sums.slope - sums.slope.mean(axis=0)) @ inverse
    correction = blocks.count / max(blocks.count - size, 1)
    robust = scores.T @ scores * correction + _left_to_the_prior(normal, prior)
    wider = np.sqrt(np.maximum(np.diag(robust), np.diag(inverse)))
    spread = np.sqrt(np.maximum(np.diag(robust), 1e-300))
    found = robust * np.outer(wider / spread, wider / spread)
    np.fill_diagonal(found, wider**2)  # also of parameters that nothing depends on, whose scores are all zero
    return found


def _left_to_the_prior(normal: np.ndarray, prior: float) -> np.ndarray:
    """Return the covariance of the combinations of parameters of which data say less than the prior, shape (P, P).

    Args:
        normal: Sum of squared sensitivities to the parameters in units of their scale, shape (P, P).
        prior: See `LeastSquaresCfg.prior`.
    """
    curvature, axes = np.linalg.eigh(normal)
    loose = curvature < 1 / prior**2
    return (axes[:, loose] / (np.maximum(curvature[loose], 0.0) + 1 / prior**2)) @ axes[:, loose].T


def excludes_null(fitted: Sequence[FittedParameter], covered: np.ndarray, dependent_share: float) -> bool:
    """Return whether an interval of a parameter excludes its null value, or that of a combination of parameters does.

    Where parameters stand in for one another, as the friction of two joints that move as one, each by itself may be
    at its null value, but not all of them. The combinations are the principal axes of the parameters' correlations,
    those of which the data leave a small share of what they leave of the parameters one by one. All together exclude
    null values that are true as seldom as one interval does (Bonferroni).

    Args:
        fitted: Parameters of one effect.
        covered: Their covariance, in their units, shape (P, P).
        dependent_share: Variance of a combination, over that of the same combination of independent parameters, below
            which it counts [-].
    """
    if any(q.excludes_null for q in fitted):
        return True
    std = np.sqrt(np.maximum(np.diag(covered), 0.0))
    known = [k for k, q in enumerate(fitted) if np.isfinite([q.value, q.null, std[k]]).all() and std[k] > 0]
    if len(known) < 2:
        return False
    away = np.array([fitted[k].value - fitted[k].null for k in known]) / std[known]
    variance, axes = np.linalg.eigh(covered[np.ix_(known, known)] / np.outer(std[known], std[known]))
    counts = variance < dependent_share
    quantile = -ndtri(ndtr(-NORMAL_QUANTILE) / max(np.count_nonzero(counts), 1))
    reach = quantile * np.sqrt(np.maximum(variance[counts], 0.0))
    return bool((np.abs(away @ axes[:, counts]) > np.maximum(reach, 1e-9)).any())


def joint_posterior(
    parameters: Sequence[Parameter],
    fitted: Sequence[FittedParameter],
    covered: np.ndarray,
    std: np.ndarray,
    independent: np.ndarray,
) -> JointPosterior:
    """Return the posterior of P parameters that were fitted together.

    Args:
        parameters: The parameters.
        fitted: Their values and intervals; those that are not finite get no variance.
        covered: `covariance` of the fit, from which the correlations are taken, shape (P, P).
        std: Standard deviations that the data leave, in units of the parameters' scale, shape (P,).
        independent: Standard deviations from other sources, such as the form of an effect, likewise, shape (P,).
    """
    spread = np.sqrt(np.maximum(np.diag(covered), 1e-300))
    known = np.array([np.isfinite([q.value, q.low, q.high]).all() for q in fitted], dtype=float)
    own = std * known
    found = covered / np.outer(spread, spread) * np.outer(own, own) + np.diag((independent * known) ** 2)
    found = 0.5 * (found + found.T)
    return JointPosterior(
        tuple(float(p.scale) for p in parameters),
        tuple(tuple(float(v) for v in row) for row in found),
        tuple(float(p.low) for p in parameters),
        tuple(float(p.high) for p in parameters),
    )


def clustered_std(sums: Sums, blocks: Blocks, prior: float = LeastSquaresCfg.prior) -> np.ndarray:
    """Return standard deviations of the parameters in units of their scale, (P,), for intervals of `NORMAL_QUANTILE`.

    As `covariance`, but also robust to correlation between neighbouring blocks of a demonstration, which an error in a
    formula leaves: autocovariances of the blocks' scores over floor(4 (B / 100)^(2/9)) blocks with Bartlett's weights
    (Newey and West, Econometrica 55, 1987; Review of Economic Studies 61, 1994), where they increase the variance. Few
    blocks have Student's distribution of B - 1 degrees of freedom (Cameron and Miller, J. Human Resources 50, 2015).
    None is above the `prior`.
    """
    size, count = sums.slope.shape[1], blocks.count
    inverse = np.linalg.pinv(sums.normal.sum(axis=0) + np.eye(size) / prior**2, hermitian=True)
    scores = (sums.slope - sums.slope.mean(axis=0)) @ inverse
    added, lags = np.zeros(size), int(4 * (count / 100) ** (2 / 9))
    for k in range(1, min(lags, count - 1) + 1):
        near = (blocks.demonstration[k:] == blocks.demonstration[:-k])[:, None]
        added += 2 * (1 - k / (lags + 1)) * (scores[k:] * scores[:-k] * near).sum(axis=0)
    added *= count / max(count - size, 1)
    variance = np.diag(covariance(sums, blocks, prior)) + np.maximum(added, 0.0)
    few = stdtrit(max(count - 1, 1), 0.975) / stdtrit(np.inf, 0.975)
    return np.minimum(np.sqrt(variance) * few, prior)


def formula_errors(
    effect: Effect,
    parameters: Sequence[Parameter],
    values: np.ndarray,
    discretisation_error: float,
    timestep: float = 0.0,
    *,
    null_known: bool = False,
) -> np.ndarray:
    """Return standard deviations of an effect's values due to its formula, in the units of these, shape (P,).

    Those of `discretisation_errors`, together with `Effect.formula_error` times each parameter's difference from its
    null value, `Effect.null_error` times that, unless the null value is taken to be known, and `Effect.step_error`
    times the model's time step [s].
    """
    null = np.array([p.null if np.isfinite(p.null) else 0.0 for p in parameters])
    own = np.where(np.isfinite(values), np.abs(values - null), 0.0)
    scatter = 0.0 if null_known else effect.null_error
    form = np.hypot(np.hypot(effect.formula_error * own, scatter * null), effect.step_error * timestep)
    return np.hypot(discretisation_errors(parameters, values, discretisation_error), form)


def discretisation_errors(parameters: Sequence[Parameter], values: np.ndarray, relative_error: float) -> np.ndarray:
    """Return standard deviations of an effect's values due to time discretisation, in the units of these, (P,).

    `relative_error` times the effect's size, which is the largest difference of a parameter from its null value in
    units of its scale, for every parameter. It does not depend on the data: a force model fitted to data from another
    time-stepping scheme of the same model is off by about this much (type B evaluation: Guide to the Expression of
    Uncertainty in Measurement, 2008, section 4.3).
    """
    scale = np.array([p.scale for p in parameters])
    null = np.array([p.null if np.isfinite(p.null) else 0.0 for p in parameters])
    finite = np.where(np.isfinite(values), values, null)
    return relative_error * scale * float(np.abs((finite - null) / scale).max())
