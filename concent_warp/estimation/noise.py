"""Measurement noise of a channel: as its instrument states it, else estimated from the readings themselves.

The model plays no part. Two estimates, the first that applies. At rest: the scatter about the mean of stretches in
which nothing moves, which sees slow noise too. From differences: the third difference of independent noise has 20 times
its variance at every lag (of first differences: von Neumann, "Distribution of the ratio of the mean square successive
difference to the variance", Ann. Math. Stat. 12, 1941), that of a smooth motion grows with the sixth power of the lag,
and that of noise which is correlated over some samples grows slowly until the lag exceeds its correlation time. The
noise is read off at the largest lag before the motion takes over; what is left open between it and the motion is the
interval. Differences are divided by those of the times, so that uneven steps, which clocks of robots have, make no
noise of a motion. Neither estimate falls below what the resolution of the readings leaves, a step / sqrt(12).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from concent_warp.checks import MAX_COUNT, Bounds, Count, Factor, Share
from concent_warp.estimation.rotations import rotation_vectors
from concent_warp.estimation.sample_noise import covariance_std
from concent_warp.estimation.sensors import Kind

if TYPE_CHECKING:
    from concent_warp.recording.recording import Channel

Source = Literal["stated", "rest", "differences", "resolution", "points", "unknown"]
"""Where a noise figure is from."""
WORDS: dict[Source, str] = {
    "stated": "as stated",
    "rest": "estimated where nothing moves",
    "differences": "estimated from differences between samples",
    "resolution": "from the resolution of the readings",
    "points": "estimated from the scatter of the first sightings of each point",
    "unknown": "not known",
}
"""The sources in words."""


EVEN = 1e-6
"""Deviation of the weights of differences from those for even steps that is rounding [-]."""


SAME = 1e-6
"""Differences over their scale that are rounding [-]."""
SAME_LEVEL = 1e-9
"""Difference of two readings over the range of all that is rounding of numbers [-]."""
MIN_GAPS = 20
"""Fewest gaps between readings, most of which never repeat, from which a step is found."""
UNIFORM_SHARE = 0.9
"""Share of differences between readings that are as the one before [-], above which the motion is uniform."""
STEPS_OF_GAPS = (1, 4, 16, 64, 256, 1024, 4096)
"""Largest gaps that refine the step, in steps, one after the other."""
OFF_STEP = 0.1
"""Distance of a reading from a multiple of the step, over the step, up to which it is one [-]."""
MAX_CLIPPINGS = 20
"""Steps after which the scale of the smallest differences is settled."""


@dataclass(frozen=True)
class NoiseCfg:
    """Settings of the estimation of noise."""

    rest_length: Annotated[int, Bounds(4, MAX_COUNT)] = 20
    """Readings of a window that is tested for rest."""
    rest_windows: Count = 3
    """Fewest consecutive windows of a stretch of rest."""
    rest_scatter: float = 2.5
    """Largest scatter of a window at rest, and difference of its halves, over the noise seen in differences [-]."""
    min_readings: Count = 8
    """Fewest readings from which noise is estimated."""
    lags: tuple[Count, ...] = (1, 2, 4, 8, 16)
    """Lags of the third differences [samples]; each twice the one before."""
    max_growth: Factor = 2.0
    """Growth of the differences from one lag to the next up to which they count as noise [-]: 1 for independent noise,
    1.4 for noise that is slow against both lags, 8 for smooth motion."""
    max_share: Share = 0.05
    """Share of the standard deviation of a channel up to which differences over more than one sample may be noise [-]:
    differences over a good part of a period of the motion grow no more, and are no noise."""
    max_outer_scale: Factor = 3.0
    """Scale of the median difference over that of the smallest ones [-], above which most differences are not noise
    but motion in steps, as of a stiff servo behind coarse set-points. Of noise alone it is 1."""
    clip: Factor = 3.0
    """Standard deviations up to which differences belong to the smallest ones [-]."""
    rounding: float = 1e-9
    """Scatter below this share of the largest reading is rounding, as of simulated readings without noise [-]."""


@dataclass(frozen=True)
class Noise:
    """Standard deviation of the measurement noise of a channel."""

    std: float
    """Per component, in the channel's unit; of an orientation per component of the rotation vector [rad], twice that of
    a component of the quaternion. NaN where the readings do not determine it."""
    source: Source
    """Where it is from."""
    low: float = -np.inf
    """Lower end of a 95 % interval; `std` where it is stated. What the resolution leaves, 0 for readings without steps,
    where they show no noise beside the motion."""
    high: float = np.inf
    """Upper end: noise that is slow against the sampling may be as large, and not larger."""

    def __post_init__(self) -> None:
        """Fill in the interval of a value that is exact."""
        for name in ("low", "high"):
            if np.isinf(getattr(self, name)):
                object.__setattr__(self, name, self.std)

    @property
    def words(self) -> str:
        """Where it is from, in words."""
        return WORDS[self.source]

    @property
    def factor(self) -> float:
        """By how much the noise may be larger than `std` [-]."""
        return max(self.high / self.std, 1.0) if np.isfinite(self.high) and self.std > 0 else 1.0


def channel_noise(channel: Channel, kind: Kind, cfg: NoiseCfg | None = None) -> Noise:
    """Return the noise of a channel.

    Args:
        channel: Values (T, dim); of an orientation quaternions wxyz (T, 4).
        kind: What it measures.
        cfg: Settings.
    """
    return pooled_noise((channel,), kind, cfg)


def pooled_noise(channels: Sequence[Channel], kind: Kind, cfg: NoiseCfg | None = None) -> Noise:
    """Return the noise of one instrument from its channels in several demonstrations; rest in any of them counts.

    Args:
        channels: Values (T, dim) each.
        kind: What they measure.
        cfg: Settings.
    """
    cfg = cfg or NoiseCfg()
    stated = [std for c in channels if (std := c.noise_std or covariance_std(c))]
    if stated:
        return Noise(float(np.sqrt(np.mean(np.square(stated)))), "stated")
    if kind != "orientation" and any(map(_is_partial, channels)):
        return _noise_of_components(channels, kind, cfg)
    timed = [piece for c in channels for piece in _finite_pieces(c)]
    pieces = [piece for _, piece in timed]
    if sum(len(piece) for piece in pieces) < cfg.min_readings:
        return Noise(np.nan, "unknown")
    floor = 0.0 if kind == "orientation" else _resolution(pieces) / np.sqrt(12)
    found = _noise_in_differences(timed, kind, floor, cfg)
    (fast,) = _difference_stds(timed, kind, (1,), floor, cfg)
    if (rest := _rest_std(pieces, kind, max(fast, floor), cfg)) is not None:
        scatter, freedom = rest
        std, error = max(scatter, fast), 2 / np.sqrt(2 * freedom)
        found = Noise(std, "rest", std * (1 - error), std * (1 + error))
    if found.std < floor:
        return Noise(floor, "resolution", floor, max(floor, found.high))
    size = max(float(np.abs(piece).max()) for piece in pieces)
    return found if found.std > cfg.rounding * size else Noise(np.nan, "unknown")


def _is_partial(channel: Channel) -> bool:
    """Return whether some components of a sample are missing and others are not."""
    known = np.isfinite(np.asarray(channel.value, dtype=float).reshape(len(channel.value), -1))
    return bool((known.any(axis=1) & ~known.all(axis=1)).any())


def _noise_of_components(channels: Sequence[Channel], kind: Kind, cfg: NoiseCfg) -> Noise:
    """Return the root mean square of the noises of the components, each from its own readings, as `pooled_noise`."""
    found = []
    for column in range(channels[0].value.shape[1]):
        parts = [replace(c, value=c.value[:, [column]]) for c in channels]
        if any(np.isfinite(part.value).any() for part in parts):
            found.append(pooled_noise(parts, kind, cfg))
    known = [noise for noise in found if np.isfinite(noise.std)]
    if not known:
        return Noise(np.nan, "unknown")
    largest = max(known, key=lambda noise: noise.std)
    std, low, high = (
        float(np.sqrt(np.mean([value**2 for value in values])))
        for values in ([n.std for n in known], [n.low for n in known], [n.high for n in known])
    )
    return Noise(std, largest.source, low, high)


def _finite_pieces(channel: Channel) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times (n,) and values (n, dim) of the stretches of a channel without missing readings."""
    value = np.asarray(channel.value, dtype=float).reshape(len(channel.value), -1)
    valid = np.asarray(np.isfinite(value).all(axis=1))
    edges = np.flatnonzero(np.diff(valid)) + 1
    parts = np.split(np.arange(len(value)), edges)
    return [(channel.time[rows], value[rows]) for rows in parts if len(rows) and bool(valid[rows].all())]


def _noise_in_differences(
    timed: Sequence[tuple[np.ndarray, np.ndarray]], kind: Kind, floor: float, cfg: NoiseCfg
) -> Noise:
    """Return the noise per component seen in third differences over several lags.

    Of two lags h and 2 h, noise s and smooth motion m h^3 leave s^2 = (64 v(h) - v(2 h)) / 63 of the variances v.
    """
    pieces = [piece for _, piece in timed]
    lags = [h for h in cfg.lags if sum(max(len(piece) - 3 * h, 0) for piece in pieces) >= cfg.min_readings]
    values = _difference_stds(timed, kind, lags or cfg.lags[:1], floor, cfg)
    std, low, high = values[0], 0.0, values[0]
    most = cfg.max_share * _spread(pieces, kind)
    for k, (near, far) in enumerate(pairwise(values)):
        if far <= cfg.max_growth * near and near > 0 and (k == 0 or near <= most):
            std = max(std, float(np.sqrt(max(64 * near**2 - far**2, 0.0) / 63)))
            low, high = values[0], max(high, near, far if far <= most else near)
    error = 2 / np.sqrt(sum(len(piece) for piece in pieces))
    return Noise(std, "differences", max(low * (1 - error), min(floor, std)), max(high, std) * (1 + error))


def _spread(pieces: Sequence[np.ndarray], kind: Kind) -> float:
    """Return the standard deviation of a component of readings about their mean, root mean square."""
    centred = np.concatenate([_centred(piece, kind) for piece in pieces])
    return float(np.sqrt(np.mean(centred**2)))


def _difference_stds(
    timed: Sequence[tuple[np.ndarray, np.ndarray]], kind: Kind, lags: Sequence[int], floor: float, cfg: NoiseCfg
) -> list[float]:
    """Return the noise per component seen in third differences over each lag, by their median size, so that impacts
    count little, or by the smallest where most are motion in steps (`NoiseCfg.max_outer_scale`). No noise is below
    `floor`, what the resolution leaves.

    Where the median tells the noise at one lag, it does at all larger ones: the smallest differences over a larger lag
    are of other moments, and the two scales are no growth from one lag to the next.
    """
    found: list[float] = []
    in_steps: np.ndarray | bool = True
    for lag in lags:
        third = _third_differences(timed, kind, lag)
        if third is None:
            found.append(np.nan)
            continue
        inner, outer = np.array([_scales(column, np.sqrt(20) * floor, cfg) for column in np.abs(third).T]).T
        in_steps = in_steps & (outer > cfg.max_outer_scale * inner)
        found.append(float(np.sqrt(np.mean(np.where(in_steps, inner, outer) ** 2) / 20)))
    return found


def _third_differences(timed: Sequence[tuple[np.ndarray, np.ndarray]], kind: Kind, lag: int) -> np.ndarray | None:
    """Return the third differences over a lag, shape (n, dim), None where readings are too few.

    Of orientations the first difference is the rotation vector from one reading to a later one.
    """
    third = []
    for time, piece in timed:
        if len(piece) > 3 * lag:
            first = (
                rotation_vectors(piece[:-lag], piece[lag:])
                if kind == "orientation"
                else np.asarray(piece[lag:] - piece[:-lag])
            )
            before, middle, after = _weights(time, lag)
            third.append(after * first[2 * lag :] + middle * first[lag:-lag] + before * first[: -2 * lag])
    return np.concatenate(third) if third else None


def _scales(sizes: np.ndarray, floor: float, cfg: NoiseCfg) -> tuple[float, float]:
    """Return the standard deviation of a normal distribution by the sizes of differences, shape (n,), in two ways.

    First by the smallest: their root mean square, of all that are within `NoiseCfg.clip` of it. Then by the median.
    """
    inner, outer = (float(np.quantile(sizes, q)) / z for q, z in ((0.1, 0.12566), (0.5, 0.67449)))
    apart = sizes[sizes > SAME * outer]
    # Readings that come in steps differ by none, or by one of these at least.
    floor = max(floor, float(np.quantile(apart, 0.05)) if len(apart) else 0.0)
    scale = max(inner, floor)
    for _ in range(MAX_CLIPPINGS):
        within = sizes[sizes <= cfg.clip * scale]
        before, scale = scale, max(float(np.sqrt(np.mean(within**2))), floor)
        if scale >= (1 - 1e-3) * before:
            break
    return scale, outer


def _weights(time: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the weights of three consecutive first differences in a third one, each (T - 3 lag, 1).

    The third divided difference of readings r at times t is the sum of r_i / prod(t_i - t_j), j other than i: 0 for
    every parabola. Weights of readings have the norm sqrt(20) of those for even steps, which are 1, -2, 1 here.
    """
    count = len(time) - 3 * lag
    t = np.stack([time[k * lag : k * lag + count] for k in range(4)]) / max(float(np.ptp(time)), 1e-300)
    apart = t[:, None] - t[None]
    apart[np.arange(4), np.arange(4)] = 1.0
    size = np.abs(apart).prod(axis=1)
    w = np.array([-1.0, 1.0, -1.0, 1.0])[:, None] * size.min(axis=0) / size
    w = w * np.sqrt(20 / (w**2).sum(axis=0))
    steps, even = np.stack([-w[0], w[2] + w[3], w[3]]), np.array([[1.0], [-2.0], [1.0]])
    steps = np.where(np.abs(steps - even) < EVEN, even, steps)  # without the rounding of even times
    return steps[0][:, None], steps[1][:, None], steps[2][:, None]


def _rest_std(pieces: Sequence[np.ndarray], kind: Kind, fast: float, cfg: NoiseCfg) -> tuple[float, int] | None:
    """Return the scatter about the mean of stretches of rest and its degrees of freedom, None where there is none.

    A window is at rest if it scatters, and its two halves differ, by no more than `cfg.rest_scatter` times `fast`.
    """
    square, freedom = 0.0, 0
    for piece in pieces:
        count = len(piece) // cfg.rest_length
        windows = [piece[i * cfg.rest_length : (i + 1) * cfg.rest_length] for i in range(count)]
        still = np.array([_is_still(_centred(window, kind), cfg.rest_scatter * fast) for window in windows], dtype=bool)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
        for start, end in edges.reshape(-1, 2):
            stretch = _centred(piece[start * cfg.rest_length : end * cfg.rest_length], kind)
            if end - start >= cfg.rest_windows and _is_still(stretch, cfg.rest_scatter * fast):
                square += float((stretch**2).sum())
                freedom += stretch.size - stretch.shape[1]
    return (float(np.sqrt(square / freedom)), freedom) if freedom else None


def _is_still(window: np.ndarray, limit: float) -> bool:
    """Return whether readings about their mean, shape (n, dim), scatter and drift by no more than `limit`."""
    half = len(window) // 2
    drift = np.abs(window[:half].mean(axis=0) - window[half:].mean(axis=0)).max()
    return bool(np.sqrt((window**2).mean(axis=0)).max() <= limit and drift <= limit)


def _centred(window: np.ndarray, kind: Kind) -> np.ndarray:
    """Return readings (n, dim) less their mean; of orientations rotation vectors [rad], shape (n, 3)."""
    value = rotation_vectors(np.broadcast_to(window[0], window.shape), window) if kind == "orientation" else window
    return value - value.mean(axis=0)


def _resolution(pieces: Sequence[np.ndarray]) -> float:
    """Return the step in which readings come, in their unit; 0 where they do not come in steps."""
    return max((_step(column) for column in np.concatenate(pieces).T), default=0.0)


def _step(column: np.ndarray) -> float:
    """Return the step of which readings (n,) are multiples, up to a constant and to digits that a log rounds; else 0.

    Readings of a fast motion hardly ever repeat: the step is about the smallest gap between any two. Where they do not
    repeat, and one differs from the next by the same as that from the one after, the motion is uniform and has no step.
    """
    levels = np.unique(column)
    gaps = np.diff(levels)
    gaps = gaps[gaps > SAME_LEVEL * np.ptp(column)]
    repeated = len(levels) < len(column) / 2
    if not len(gaps) or not (repeated or len(gaps) >= MIN_GAPS):
        return 0.0
    found = max(_refined_step(levels, float(step)) for step in (np.percentile(gaps, 10), gaps.min()))
    uniform = np.mean(np.abs(np.diff(column, 2)) < found / 2) > UNIFORM_SHARE
    return 0.0 if uniform and not repeated else found


def _refined_step(levels: np.ndarray, step: float) -> float:
    """Return the step of which sorted levels (n,) are multiples, near a first value; 0 where they are not."""
    gaps = np.diff(levels)
    for largest in STEPS_OF_GAPS:
        count = np.round(gaps / step)
        near = (count >= 1) & (count <= largest)
        if near.any():
            step = float((gaps[near] * count[near]).sum() / (count[near] ** 2).sum())
    count = np.concatenate([[0.0], np.cumsum(np.round(gaps / step))])
    if count[-1] == 0:
        return 0.0
    slope = float(np.polyfit(count, levels, 1)[0])
    rest = levels - slope * count
    return slope if np.percentile(np.abs(rest - np.median(rest)), 95) < OFF_STEP * slope else 0.0
