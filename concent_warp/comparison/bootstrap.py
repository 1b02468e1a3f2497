"""Intervals of a mean error whose samples are autocorrelated.

The rule. With fewer than `WHOLE` demonstrations, blocks of consecutive samples are drawn with replacement within each
demonstration (circular block bootstrap: Politis and Romano, "A circular block-resampling procedure for stationary
data", 1992), so the interval speaks of these demonstrations. A block is as long as twice the integrated
autocorrelation time of the error, at least the cube root of the number of samples, and at most a quarter of them. With
`WHOLE` demonstrations or more, whole demonstrations are drawn, and the interval speaks of others like them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

WHOLE = 8
"""From this number of demonstrations on, whole demonstrations are drawn instead of blocks of time."""
FEWEST = 8
"""A series with fewer samples than this has no interval."""
DRAWS = 2000
"""Bootstrap replicates."""
LEVEL = 0.95
"""Share of the replicates within the interval."""
RULE = (
    f"bootstrap of blocks of consecutive samples within each demonstration, as long as twice the autocorrelation time; "
    f"from {WHOLE} demonstrations on, of whole demonstrations"
)
"""The rule in one sentence."""


def _autocorrelation_time(series: np.ndarray) -> float:
    """Return the integrated autocorrelation time of `series` (n,) in samples, at least 1.

    1 + 2 sum of rho_k, summed up to the first autocorrelation that is not positive; n over it is the effective number
    of samples.
    """
    n = len(series)
    centred = series - series.mean()
    if n < 2 or not (variance := float(centred @ centred)):
        return 1.0
    spectrum = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[:n] / variance
    first = int(np.argmax(rho <= 0)) if (rho <= 0).any() else n
    return float(max(1.0, 1 + 2 * rho[1:first].sum()))


def _block_length(series: np.ndarray) -> int:
    """Return the length of the blocks for `series` (n,) in samples, by the rule above."""
    n = len(series)
    wanted = max(np.ceil(2 * _autocorrelation_time(series)), np.ceil(n ** (1 / 3)))
    return int(max(1, min(wanted, n // 4)))


def effective_count(parts: Sequence[np.ndarray]) -> float:
    """Return the effective number of samples of series (n_d,): each length over its autocorrelation time, summed."""
    return float(sum(len(part) / _autocorrelation_time(part) for part in parts if len(part)))


def mean_interval(parts: Sequence[np.ndarray], seed: int = 0) -> tuple[float, float]:
    """Return the `LEVEL` interval of the mean over all samples of `parts`, one series (n_d,) a demonstration.

    NaN where there are too few samples for one; infinite where a sample is.
    """
    parts = [part for part in parts if len(part)]
    if not parts or sum(map(len, parts)) < FEWEST:
        return np.nan, np.nan
    if not all(np.isfinite(part).all() for part in parts):
        return np.inf, np.inf
    draw = _drawn_demonstrations if len(parts) >= WHOLE else _drawn_blocks
    means = draw(parts, np.random.default_rng(seed))
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(means, [tail, 100 - tail])
    return float(low), float(high)


def _drawn_demonstrations(parts: Sequence[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Return the means of replicates that draw whole demonstrations, shape (DRAWS,)."""
    total = np.array([part.sum() for part in parts])
    count = np.array([len(part) for part in parts])
    chosen = rng.integers(len(parts), size=(DRAWS, len(parts)))
    return total[chosen].sum(axis=1) / count[chosen].sum(axis=1)


def _drawn_blocks(parts: Sequence[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Return the means of replicates that draw blocks within each demonstration, shape (DRAWS,)."""
    total = np.zeros(DRAWS)
    for part in parts:
        n, length = len(part), _block_length(part)
        running = np.concatenate([[0.0], np.cumsum(np.concatenate([part, part[:length]]))])
        block_sum = running[length : length + n] - running[:n]
        start = rng.integers(n, size=(DRAWS, -(-n // length)))
        total += n * block_sum[start].mean(axis=1) / length
    return total / sum(map(len, parts))
