"""Intervals of a mean error whose samples are autocorrelated.

With few demonstrations, blocks of consecutive samples are resampled with replacement within each demonstration
(circular block bootstrap: Politis and Romano, "A circular block-resampling procedure for stationary data", 1992), and
the interval is one for these demonstrations. A block is as long as twice the integrated autocorrelation time of the
error, at least the cube root of the number of samples, and at most a quarter of them. With
`BootstrapCfg.min_demonstrations` or more, whole demonstrations are resampled, and the interval is one for others like
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.checks import Count, OpenShare


@dataclass(frozen=True)
class BootstrapCfg:
    """Settings of the intervals of mean errors."""

    min_demonstrations: Count = 8
    """Number of demonstrations from which on whole ones are resampled instead of blocks of time [-]: fewer have too few
    different samples for a 95 % interval."""
    min_samples: Count = 8
    """Samples below which there is no interval [-]: a block would be shorter than two samples."""
    replicates: Count = 2000
    """Bootstrap replicates [-]: 50 of them lie beyond each end of a 95 % interval."""
    level: OpenShare = 0.95
    """Share of the replicates within the interval [-]."""

    @property
    def rule(self) -> str:
        """The rule in one sentence."""
        return (
            "bootstrap of blocks of consecutive samples within each demonstration, as long as twice the "
            f"autocorrelation time; from {self.min_demonstrations} demonstrations on, of whole demonstrations"
        )


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
    length = max(np.ceil(2 * _autocorrelation_time(series)), np.ceil(n ** (1 / 3)))
    return int(max(1, min(length, n // 4)))


def effective_count(parts: Sequence[np.ndarray]) -> float:
    """Return the effective number of samples of series (n_d,): each length over its autocorrelation time, summed."""
    return float(sum(len(part) / _autocorrelation_time(part) for part in parts if len(part)))


def mean_interval(parts: Sequence[np.ndarray], seed: int = 0, cfg: BootstrapCfg | None = None) -> tuple[float, float]:
    """Return the interval of the mean over all samples of `parts`, one series (n_d,) a demonstration.

    NaN where there are too few samples for one; infinite where a sample is.
    """
    cfg = cfg or BootstrapCfg()
    parts = [part for part in parts if len(part)]
    if not parts or sum(map(len, parts)) < cfg.min_samples:
        return np.nan, np.nan
    if not all(np.isfinite(part).all() for part in parts):
        return np.inf, np.inf
    resample = _resampled_demonstrations if len(parts) >= cfg.min_demonstrations else _resampled_blocks
    means = resample(parts, np.random.default_rng(seed), cfg.replicates)
    tail = 50 * (1 - cfg.level)
    low, high = np.percentile(means, [tail, 100 - tail])
    return float(low), float(high)


def _resampled_demonstrations(parts: Sequence[np.ndarray], rng: np.random.Generator, replicates: int) -> np.ndarray:
    """Return the means of replicates of whole demonstrations, shape (replicates,)."""
    total = np.array([part.sum() for part in parts])
    count = np.array([len(part) for part in parts])
    chosen = rng.integers(len(parts), size=(replicates, len(parts)))
    return total[chosen].sum(axis=1) / count[chosen].sum(axis=1)


def _resampled_blocks(parts: Sequence[np.ndarray], rng: np.random.Generator, replicates: int) -> np.ndarray:
    """Return the means of replicates of blocks within each demonstration, shape (replicates,)."""
    total = np.zeros(replicates)
    for part in parts:
        n, length = len(part), _block_length(part)
        running = np.concatenate([[0.0], np.cumsum(np.concatenate([part, part[:length]]))])
        block_sum = running[length : length + n] - running[:n]
        start = rng.integers(n, size=(replicates, -(-n // length)))
        total += n * block_sum[start].mean(axis=1) / length
    return total / sum(map(len, parts))
