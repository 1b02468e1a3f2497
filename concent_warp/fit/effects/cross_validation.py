"""Evidence by blocks of time: held-out gain of a candidate over a model, and its null distribution.

Residuals are correlated in time, so what counts as one observation is a block of time and not a row. All figures follow
from sums over blocks: with residuals r and sensitivities J of block b (initial states eliminated),
H_b = J_b' J_b, u_b = J_b' r_b and q_b = r_b' r_b.

Cross-validation: the parameters are fitted without a fold of blocks by one Newton step from the fit to all of them,
delta_f = -(H - H_f + prior)^-1 (u - u_f), and the fold's error is q_b + 2 delta_f' u_b + delta_f' H_b delta_f.
Parameters that all folds share keep their part of H_f and u_f.

Null distribution: under a complete model, residuals are noise. Blocks of what no candidate can explain, each with a
random sign (wild bootstrap: Wu, Annals of Statistics 14, 1986; by blocks: Shao, J. Am. Stat. Assoc. 105, 2010), are
noise with the recording's own correlation. The largest gain of all candidates on such data is a sample of the null
distribution of the best candidate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from concent_warp.checks import Bounds, Count, PositiveDuration
from concent_warp.fit.effects.least_squares import LeastSquaresCfg, Linear
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.robust import huber_weight


@dataclass(frozen=True)
class BlockCfg:
    """How a recording is cut into blocks and folds."""

    folds: Annotated[int, Bounds(2, 1000)] = 5
    """Folds of the cross-validation [-]: the usual 5 to 10 (Hastie, Tibshirani and Friedman, "The Elements of
    Statistical Learning", 2009, section 7.10)."""
    min_blocks: Count = 12
    """Least blocks that a recording is cut into [-], at the cost of shorter blocks: the smallest p-value of a sign-flip
    test is then 1 / 4096."""
    max_blocks: Count = 60
    """Most blocks [-]."""
    min_length: PositiveDuration = 0.1
    """Shortest block [s], unless there are fewer than `min_blocks`: residuals are correlated over shorter times."""


@dataclass(frozen=True)
class Blocks:
    """How the residuals of all windows fall into blocks and folds."""

    of_row: tuple[np.ndarray, ...]
    """Block of each residual, one (count,) a window."""
    fold: np.ndarray
    """Fold of each block, shape (B,)."""
    demonstration: np.ndarray
    """Demonstration of each block, shape (B,)."""
    start: np.ndarray
    """When each block begins in its demonstration [s], shape (B,)."""
    end: np.ndarray
    """When it ends."""

    @property
    def count(self) -> int:
        """Number of blocks, B."""
        return len(self.fold)


def cut_blocks(windows: Sequence[Window], cfg: BlockCfg | None = None) -> Blocks:
    """Return windows cut into blocks of about the same length, and assigned to folds.

    Folds are whole demonstrations where there are at least as many as folds; else blocks in turn, so that every phase
    of a motion is in each.
    """
    cfg = cfg or BlockCfg()
    total = sum(w.end - w.start for w in windows)
    length = max(total / cfg.max_blocks, cfg.min_length)
    if total / length < cfg.min_blocks:
        length = total / cfg.min_blocks
    of_row, demonstration, starts, ends = [], [], [], []
    for w in windows:
        parts = max(round((w.end - w.start) / length), 1)
        width = (w.end - w.start) / parts
        index = np.clip(((w.clock - w.start) / width).astype(int), 0, parts - 1)
        of_row.append(len(starts) + index)
        for k in range(parts):
            demonstration.append(w.number)
            starts.append(w.start + k * width)
            ends.append(w.start + (k + 1) * width)
    numbers = np.array(demonstration)
    known, place = np.unique(numbers, return_inverse=True)
    fold = place % cfg.folds if len(known) >= cfg.folds else np.arange(len(starts)) % cfg.folds
    return Blocks(tuple(of_row), fold, numbers, np.array(starts), np.array(ends))


@dataclass(frozen=True)
class Sums:
    """Sums over the blocks, weighted by a robust weight of each row."""

    normal: np.ndarray
    """H_b, shape (B, P, P)."""
    slope: np.ndarray
    """u_b, shape (B, P)."""
    square: np.ndarray
    """q_b, shape (B,)."""


def block_sums(linear: Sequence[Linear], blocks: Blocks, limit: float) -> Sums:
    """Return the sums of projected residuals and sensitivities, one piece a window."""
    size = linear[0].jacobian.shape[1]
    normal, slope = np.zeros((blocks.count, size, size)), np.zeros((blocks.count, size))
    square = np.zeros(blocks.count)
    for of_window, rows in zip(linear, blocks.of_row, strict=True):
        weight = np.sqrt(huber_weight(of_window.residual, limit))
        j, r = of_window.jacobian * weight[:, None], of_window.residual * weight
        for b in np.unique(rows):
            mine = rows == b
            normal[b] = j[mine].T @ j[mine]
            slope[b] = j[mine].T @ r[mine]
            square[b] = r[mine] @ r[mine]
    return Sums(normal, slope, square)


class HeldOut:
    """Held-out errors of one candidate, for its own residuals or for others."""

    def __init__(
        self, sums: Sums, blocks: Blocks, prior: float = LeastSquaresCfg.prior, shared: np.ndarray | None = None
    ) -> None:
        """Prepare the fits without each fold.

        Args:
            sums: Sums over the blocks.
            blocks: The blocks.
            prior: See `LeastSquaresCfg.prior`.
            shared: Which parameters are those of all data in every fold, shape (P,) bool; by default none.
        """
        self.sums, self.blocks = sums, blocks
        size = sums.slope.shape[1]
        self._shared = np.zeros(size, dtype=bool) if shared is None else shared
        both, self._inverse = np.outer(self._shared, self._shared), []
        for f in range(int(blocks.fold.max()) + 1):
            out = blocks.fold == f
            kept = sums.normal[~out].sum(axis=0) + np.eye(size) / prior**2 + both * sums.normal[out].sum(axis=0)
            self._inverse.append(np.linalg.pinv(kept, hermitian=True))

    def errors(self, slope: np.ndarray, square: np.ndarray) -> np.ndarray:
        """Return the held-out error of each block, shape (..., B), for u_b (..., B, P) and q_b (..., B)."""
        errors = np.empty(np.broadcast_shapes(slope.shape[:-1], square.shape))
        for f, inverse in enumerate(self._inverse):
            out = self.blocks.fold == f
            left = slope[..., ~out, :].sum(axis=-2) + self._shared * slope[..., out, :].sum(axis=-2)
            delta = -np.einsum("ij,...j->...i", inverse, left)
            linear = 2 * np.einsum("...bi,...i->...b", slope[..., out, :], delta)
            curved = np.einsum("bij,...i,...j->...b", self.sums.normal[out], delta, delta)
            errors[..., out] = square[..., out] + linear + curved
        return errors

    def own(self) -> np.ndarray:
        """Return the held-out error of each block, shape (B,), for the residuals that the sums are of."""
        return self.errors(self.sums.slope, self.sums.square)

    def of_fit(self) -> np.ndarray:
        """Return the held-out error of each block, shape (B,), of the fit that the sums are of.

        What a linear step promises that the fit could not take is no gain: where less is left held out than in the fit,
        the error is that of the fit.
        """
        found = self.own()
        return self.sums.square if found.sum() < self.sums.square.sum() else found


def sign_flip_p(gain: np.ndarray, rng: np.random.Generator, samples: int = 20000) -> float:
    """Return the probability of a mean gain at least this large if the sign of each block's gain were random.

    Args:
        gain: Gain of each block, shape (B,).
        rng: Source of the signs.
        samples: Number of random sign vectors; with up to 14 blocks all of them are enumerated.
    """
    if len(gain) <= 14:
        signs = 1.0 - 2.0 * ((np.arange(2 ** len(gain))[:, None] >> np.arange(len(gain))) & 1)
        return float(np.mean(signs @ gain >= gain.sum() - 1e-12))
    signs = rng.choice([-1.0, 1.0], size=(samples, len(gain)))
    return float((1 + np.sum(signs @ gain >= gain.sum())) / (samples + 1))


def bootstrap_interval(
    gain: np.ndarray, error: np.ndarray, group: np.ndarray, rng: np.random.Generator, samples: int = 2000
) -> tuple[float, float]:
    """Return the 95 % interval of sum(gain) / sum(error) by bootstrap over blocks, or 8 or more demonstrations.

    Args:
        gain: Gain of each block, shape (B,).
        error: Error of each block without the candidate, shape (B,).
        group: Demonstration of each block, shape (B,).
        rng: Source of the samples.
        samples: Number of bootstrap samples.
    """
    known, place = np.unique(group, return_inverse=True)
    if len(known) >= 8:
        gain, error = np.bincount(place, gain), np.bincount(place, error)
    chosen = rng.integers(len(gain), size=(samples, len(gain)))
    share = gain[chosen].sum(axis=1) / np.maximum(error[chosen].sum(axis=1), 1e-12)
    low, high = np.percentile(share, [2.5, 97.5])
    return float(low), float(high)
