"""Null distribution of the best candidate's gain: what the whole search finds on data that lack nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedModel, ScreenedCandidate
from concent_warp.fit.effects.robust import huber_weight


def max_gain_under_null(
    base: FittedModel, screened: Sequence[ScreenedCandidate], samples: int, seed: int
) -> np.ndarray:
    """Return the largest gain of all candidates on sign-flipped residuals, as a share of the error, shape (samples,).

    The signs of whole blocks of the baseline's residuals are flipped at random (wild bootstrap by blocks, see
    `concent_warp.fit.effects.cross_validation`).

    Args:
        base: The fitted baseline.
        screened: All candidates.
        samples: Number of sign-flipped data sets.
        seed: Seed of the signs.
    """
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], size=(samples, base.blocks.count))
    weight = [np.sqrt(huber_weight(piece.residual, base.limit)) for piece in base.pieces]
    square = np.zeros(base.blocks.count)
    for piece, w, rows in zip(base.pieces, weight, base.blocks.of_row, strict=True):
        square += np.bincount(rows, (piece.residual * w) ** 2, minlength=base.blocks.count)
    own = base.held_out(base.pieces)
    before = own.errors(signs[..., None] * own.sums.slope, square).sum(axis=1)
    best = np.full(samples, -np.inf)
    for s in screened:
        held = base.held_out(s.pieces)
        after = held.errors(signs[..., None] * held.sums.slope, square).sum(axis=1)
        best = np.maximum(best, (before - after) / np.maximum(before, 1e-12))
    return best


def null_p_value(null: np.ndarray, gain: float) -> float:
    """Return the p-value of a gain under a null distribution (n,): at least 1 / (n + 1)."""
    return float((1 + np.sum(null >= gain)) / (len(null) + 1))
