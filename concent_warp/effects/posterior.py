"""Posterior of parameters that were fitted together: a normal distribution, truncated at bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

PROPOSALS = 32
"""Proposals for each sample, of which one is taken."""
JITTER = 1e-12
"""Relative to the largest variance, what is added to variances so that a covariance of lower rank has a root."""


@dataclass(frozen=True)
class JointPosterior:
    """Normal distribution of P parameters about their fitted values, truncated at their bounds.

    Example:
        >>> import numpy as np
        >>> from concent_warp.effects.posterior import JointPosterior
        >>> posterior = JointPosterior((0.1, 1.0), ((4.0, 1.9), (1.9, 1.0)), (0.0, 0.0), (np.inf, np.inf))
        >>> rows = posterior.sample(np.array([0.5, 3.0]), 1000, np.random.default_rng(0))
        >>> rows.shape, bool(np.corrcoef(rows.T)[0, 1] > 0.9), bool((rows >= 0).all())
        ((1000, 2), True, True)
    """

    scale: tuple[float, ...]
    """Units of the covariance: `Parameter.scale`, the steps of the fit, in the unit of each parameter."""
    covariance: tuple[tuple[float, ...], ...]
    """In units of `scale`, shape (P, P); zero for a parameter whose value is certain, or not known at all."""
    low: tuple[float, ...]
    """Lower bounds, in the unit of each parameter."""
    high: tuple[float, ...]
    """Upper bounds."""

    @cached_property
    def matrix(self) -> np.ndarray:
        """The covariance in the units of the parameters, shape (P, P)."""
        scale = np.array(self.scale)
        return np.array(self.covariance).reshape(len(scale), len(scale)) * np.outer(scale, scale)

    def sample(self, mean: np.ndarray, count: int, rng: np.random.Generator, of: Sequence[int] = ()) -> np.ndarray:
        """Return samples, shape (count, P).

        Each is chosen from `PROPOSALS` sequential ones, in which a parameter has its truncated distribution given those
        before it, by the probabilities of these truncations (Geweke, Computing Science and Statistics 23, 1991;
        sampling importance resampling: Rubin, Bayesian Statistics 3, 1988).

        Args:
            mean: Fitted values of the parameters, shape (P,).
            count: Number of samples.
            rng: Random numbers.
            of: Indices of the parameters that are sampled, all by default; the others keep their value.
        """
        rows = np.tile(mean, (count, 1))
        chosen = np.array([k for k in of or range(len(mean)) if self.matrix[k, k] > 0 and np.isfinite(mean[k])], int)
        if not len(chosen):
            return rows
        covariance = self.matrix[np.ix_(chosen, chosen)]
        std = np.sqrt(np.diag(covariance))
        root = np.linalg.cholesky(covariance / np.outer(std, std) + JITTER * np.eye(len(std)))
        ends = [(np.array(end)[chosen] - mean[chosen]) / std for end in (self.low, self.high)]
        proposals, weight = _sequential(root, np.minimum(ends[0], 0), np.maximum(ends[1], 0), PROPOSALS * count, rng)
        # Systematic resampling; without bounds all weights are equal, and all samples distinct.
        order = rng.permutation(len(weight))
        total = np.cumsum(weight[order])
        picks = np.searchsorted(total, total[-1] * (np.arange(count) + rng.uniform()) / count, side="right")
        taken = proposals[order[np.minimum(picks, len(weight) - 1)]]
        rows[:, chosen] = np.clip(mean[chosen] + taken * std, np.array(self.low)[chosen], np.array(self.high)[chosen])
        return rows[rng.permutation(count)]


def _sequential(
    root: np.ndarray, low: np.ndarray, high: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return sequential truncated proposals, shape (count, P), and their weights, shape (count,).

    Args:
        root: Cholesky factor of the covariance, shape (P, P).
        low: Lower bounds less the mean, shape (P,).
        high: Upper bounds less the mean, shape (P,).
        count: Number of proposals.
        rng: Random numbers.
    """
    from scipy.special import ndtr, ndtri

    z, weight = np.zeros((count, len(root))), np.ones(count)
    for k in range(len(root)):
        before = z[:, :k] @ root[k, :k]
        begin, end = ndtr((low[k] - before) / root[k, k]), ndtr((high[k] - before) / root[k, k])
        weight *= end - begin
        share = begin + rng.uniform(size=count) * (end - begin)
        z[:, k] = ndtri(np.clip(share, 1e-16, 1 - 1e-16))
    return z @ root.T, weight
