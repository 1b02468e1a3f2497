"""Statistics of features as LeRobotDataset defines them: of each episode, and of all episodes from those."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Statistics = dict[str, np.ndarray]
"""By name: min, max, mean, std, the quantiles, and count, shape (1,)."""


def statistics_of_values(values: np.ndarray) -> Statistics:
    """Return the statistics of values (T, n), each of shape (n,)."""
    values = np.asarray(values, dtype=float)
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    found |= {name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()}
    return found | {"count": np.array([len(values)])}


class ImageHistogram:
    """Counts of the 256 levels of each colour, from which all statistics of an episode's images follow exactly."""

    def __init__(self, every: int = 1) -> None:
        """Look at every so many rows and columns."""
        self._counts, self._frames, self._every = np.zeros((3, 256), dtype=np.int64), 0, every

    def add(self, image: np.ndarray) -> None:
        """Count an image, shape (H, W, 3) uint8."""
        for counts, level in zip(self._counts, np.moveaxis(image[:: self._every, :: self._every], 2, 0), strict=True):
            counts += np.bincount(level.ravel(), minlength=256)
        self._frames += 1

    def statistics(self) -> Statistics:
        """Return the statistics of colours in 0..1, each of shape (3, 1, 1)."""
        level, total = np.arange(256) / 255, self._counts.sum(1)
        mean = (self._counts * level).sum(1) / total
        std = np.sqrt((self._counts * (level - mean[:, None]) ** 2).sum(1) / total)
        below = np.cumsum(self._counts, axis=1)
        low = np.array([level[np.flatnonzero(c)[0]] for c in self._counts])
        high = np.array([level[np.flatnonzero(c)[-1]] for c in self._counts])
        found = {"min": low, "max": high, "mean": mean, "std": std}
        for name, share in QUANTILES.items():
            rows = [int(np.searchsorted(b, share * t)) for b, t in zip(below, total, strict=True)]
            found[name] = level[rows]
        return {name: value.reshape(3, 1, 1) for name, value in found.items()} | {"count": np.array([self._frames])}


def merged_statistics(parts: Sequence[Mapping[str, np.ndarray]]) -> Statistics:
    """Return the statistics of all episodes from those of each.

    Means and deviations are exact; quantiles are the mean of the episodes' quantiles by their lengths, as LeRobot
    merges them.
    """
    count = np.array([float(part["count"][0]) for part in parts])
    share = count / count.sum()

    def mean_of(name: str) -> np.ndarray:
        return np.tensordot(share, np.stack([part[name] for part in parts]), axes=1)

    mean = mean_of("mean")
    spread = [np.square(part["std"]) + np.square(part["mean"] - mean) for part in parts]
    found = {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(np.tensordot(share, np.stack(spread), axes=1)),
    }
    found |= {name: mean_of(name) for name in QUANTILES}
    return found | {"count": np.array([int(count.sum())])}
