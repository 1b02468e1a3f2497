"""What unexplained forces depend on: correlations with p-values by sign flips of blocks.

If the model lacks nothing, the residual is noise with a symmetric distribution, independent between blocks of windows.
The p-value of a correlation is the share of random sign flips of whole blocks that exceed it; the maximum over all
features (Westfall and Young's max-T) corrects for their number. Features are then selected one by one, each tested with
the previous ones projected out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.diagnosis.forces.cfg import DependenceCfg


@dataclass(frozen=True)
class Dependence:
    """Dependence of an unexplained force on one feature."""

    feature: str
    correlation: float
    """-1..1, of the values as they are, about 0 rather than about their means."""
    slope: float
    """Least-squares factor: force over the feature's unit."""
    slope_std: float
    """Its standard deviation, from the scatter between blocks."""
    p: float
    """p-value of the correlation, corrected for the number of features [-]."""


@dataclass(frozen=True)
class Pattern:
    """A feature that explains a significant part of a force, beyond the previous patterns."""

    feature: str
    slope: float
    slope_std: float
    share: float
    """Share of the force's weighted square that it explains in addition, 0..1."""
    p: float
    """p-value, corrected for the number of features [-]."""
    alternatives: tuple[str, ...]
    """Features that explain as much within the standard error."""
    smallest_p: float = 0.0
    """Smallest `p` that the sign flips can give [-]."""


@dataclass(frozen=True)
class Dependences:
    """What one force depends on."""

    all: tuple[Dependence, ...]
    """Every tested feature, the largest correlation first; empty where there were too few blocks."""
    patterns: tuple[Pattern, ...]
    """Significant features, the most important first."""

    @property
    def p(self) -> float:
        """Corrected p-value of the strongest dependence [-]; 1 where nothing was tested."""
        return min((d.p for d in self.all), default=1.0)


def dependences(
    force: np.ndarray,
    std: np.ndarray,
    features: Mapping[str, np.ndarray],
    blocks: np.ndarray,
    seed: int = 0,
    cfg: DependenceCfg | None = None,
    *,
    in_contact: bool = False,
) -> Dependences:
    """Return what a force depends on.

    Args:
        force: Unexplained force, shape (K, d): one component, or a vector with features along it.
        std: Its standard deviation, shape (K,).
        features: Values of the features, shape (K, d) each.
        blocks: Block of each window, shape (K,) int; see `blocks_of`.
        seed: Seed of the flips.
        cfg: Settings.
        in_contact: Whether contacts act, which raises the share that a feature must explain.
    """
    cfg = cfg or DependenceCfg()
    valid = np.isfinite(force).all(axis=1) & (std > 0)
    kept = {n: f[valid] for n, f in features.items() if np.isfinite(f[valid]).all() and np.any(f[valid])}
    labels, block = np.unique(blocks[valid], return_inverse=True)
    if len(labels) < cfg.min_blocks or not kept:
        return Dependences((), ())
    weight = 1 / std[valid][:, None]
    y = (force[valid] * weight).ravel()
    names = list(kept)
    x = np.stack([(kept[n] * weight).ravel() for n in names])
    block = np.repeat(block, force.shape[1])
    signs = flips(len(labels), np.random.default_rng(seed), cfg)
    p = _max_p(y, x, block, signs)
    found = []
    for i, name in enumerate(names):
        slope, slope_std = _slope_of(y, x[i], block)
        found.append(Dependence(name, _correlation(y, x[i]), slope, slope_std, float(p[i])))
    found.sort(key=lambda d: -abs(d.correlation))
    return Dependences(tuple(found), _patterns(y, x, names, block, signs, cfg, in_contact))


def _patterns(
    y: np.ndarray,
    x: np.ndarray,
    names: Sequence[str],
    block: np.ndarray,
    signs: np.ndarray,
    cfg: DependenceCfg,
    in_contact: bool,
) -> tuple[Pattern, ...]:
    """Return the features that explain `y` (n,), one after the other, of candidates `x` (F, n)."""
    found: list[Pattern] = []
    total = float(y @ y)
    left, candidates, chosen = y, x, np.zeros((0, len(y)))
    for _ in range(cfg.max_patterns):
        p = _max_p(left, candidates, block, signs)
        strength = np.abs([_correlation(left, c) for c in candidates])
        best = int(np.argmax(strength))
        if p[best] > cfg.level:
            break
        share = strength[best] ** 2 * float(left @ left) / total
        if share < min_share(cfg, in_contact) and not found:
            break
        slope, slope_std = _slope_of(left, candidates[best], block)
        alternatives = tuple(
            str(names[i])
            for i in np.argsort(-strength)
            if i != best
            and names[i] not in {f.feature for f in found}
            and _explains_as_much(left, candidates[best], candidates[i], block, cfg.equal_standard_errors)
        )
        found.append(Pattern(names[best], slope, slope_std, share, float(p[best]), alternatives, 1 / len(signs)))
        chosen = np.concatenate([chosen, x[best][None]])
        left, candidates = _without(y, chosen), np.stack([_without(c, chosen) for c in x])
        small = (candidates**2).sum(axis=1) < 1e-3 * (x**2).sum(axis=1)
        candidates[small] = 0
    return tuple(found)


def min_share(cfg: DependenceCfg, in_contact: bool) -> float:
    """Return the share of a force that a feature must explain [-]."""
    return cfg.min_share_in_contact if in_contact else cfg.min_share


def blocks_of(counts: Sequence[int], cfg: DependenceCfg) -> np.ndarray:
    """Return the block of each window of demonstrations with `counts` windows, shape (sum,); none spans two."""
    wanted = sum(counts) // cfg.wanted_blocks
    size = int(np.clip(wanted, cfg.min_windows_per_block, cfg.max_windows_per_block))
    labels, first = [], 0
    for count in counts:
        number = max(round(count / size), 1)
        labels.append(first + np.minimum(np.arange(count) * number // max(count, 1), number - 1))
        first += number
    return np.concatenate(labels) if labels else np.zeros(0, dtype=int)


def flips(count: int, rng: np.random.Generator, cfg: DependenceCfg) -> np.ndarray:
    """Return signs of `count` blocks, shape (n, count): all combinations where they are few; unflipped first."""
    if count <= cfg.exact_blocks:
        bits = (np.arange(2 ** (count - 1))[:, None] >> np.arange(count)) & 1
        return 1.0 - 2.0 * bits
    return np.concatenate([np.ones((1, count)), rng.choice([-1.0, 1.0], size=(cfg.flips, count))])


def _max_p(y: np.ndarray, x: np.ndarray, block: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Return the p-value of the correlation of `y` (n,) with each of `x` (F, n), corrected for their number."""
    size = np.sqrt((x**2).sum(axis=1))
    product = np.stack([np.bincount(block, weights=c * y, minlength=signs.shape[1]) for c in x])
    statistic = np.abs(signs @ product.T) / np.where(size > 0, size, np.inf)
    highest = statistic.max(axis=1)
    return (highest[:, None] >= statistic[0] * (1 - 1e-12)).mean(axis=0)


def _correlation(y: np.ndarray, x: np.ndarray) -> float:
    """Return the correlation of `y` and `x` (n,) about 0."""
    size = np.sqrt((y @ y) * (x @ x))
    return float(y @ x / size) if size > 0 else 0.0


def _slope_of(y: np.ndarray, x: np.ndarray, block: np.ndarray) -> tuple[float, float]:
    """Return the least-squares slope of `y` on `x` (n,) and its standard deviation from the scatter between blocks."""
    square = float(x @ x)
    slope = float(x @ y) / square
    score = np.bincount(block, weights=x * (y - slope * x))
    count = len(score)
    return slope, float(np.sqrt((score**2).sum() * count / max(count - 1, 1)) / square)


def _explains_as_much(
    y: np.ndarray, best: np.ndarray, other: np.ndarray, block: np.ndarray, standard_errors: float
) -> bool:
    """Return whether `other` explains `y` as well as `best` within the scatter between blocks, (n,) each."""
    if not np.any(other):
        return False
    explained = [x * (x @ y) / (x @ x) for x in (best, other)]
    gain = np.bincount(block, weights=(y - explained[1]) ** 2 - (y - explained[0]) ** 2)
    return bool(gain.sum() <= standard_errors * np.sqrt(len(gain)) * gain.std(ddof=1)) if len(gain) > 1 else True


def _without(y: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return `y` (n,) with its part along the rows of `chosen` (F, n) taken out."""
    return y - chosen.T @ np.linalg.lstsq(chosen.T, y, rcond=None)[0]
