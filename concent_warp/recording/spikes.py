"""Single readings of positions that are far from those beside them: a marker mistaken for another, a flipped bit.

A position does not leave its path and come back within a sample. Each reading is compared with the cubic through the
two before it and the two after it. It is a spike if it is off by many times what readings usually are, and if those
beside it lie on such cubics once it is left out: beside an impact, where the path has a corner, they do not.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Annotated

import mujoco
import numpy as np

from concent_warp.checks import MAX_COUNT, Bounds, Count, Positive, Share
from concent_warp.errors import printable
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.scene.scene import Scene

S = mujoco.mjtSensor
POSITIONS = tuple(map(int, (S.mjSENS_JOINTPOS, S.mjSENS_TENDONPOS, S.mjSENS_ACTUATORPOS, S.mjSENS_FRAMEPOS)))
BESIDE = 2
"""Readings on either side from which one is foretold."""


@dataclass(frozen=True)
class SpikeCfg:
    """What tells a spike from noise and from an impact."""

    min_ratio: Positive = 20.0
    """Least distance of a spike from what the readings beside it foretell, over the usual one [-]."""
    max_beside: Share = 0.15
    """Largest such distance of the readings beside it, once it is left out, as a share of its own [-]: 0.3 or more at
    the corner of a path, where a body rebounds or stops."""
    max_share: Share = 0.05
    """Largest share of a channel's readings that may be spikes [-]: what is more frequent is no accident."""
    max_group: Count = 2
    """Most spikes near one another [-]."""
    min_readings: Annotated[int, Bounds(8, MAX_COUNT)] = 20
    """Fewest readings of a channel that is looked at."""
    rounding: float = 1e-9
    """Distance below this share of the largest reading is rounding [-]."""


def without_spikes(recording: Recording, cfg: SpikeCfg | None = None) -> Recording:
    """Return a recording whose spikes are missing readings, with a warning that counts them.

    Args:
        recording: The recording, valid.
        cfg: Thresholds.
    """
    cfg = cfg or SpikeCfg()
    found = {
        (d.name, name): rows
        for d in recording.demonstrations
        for name, channel in d.measured.items()
        if (rows := spikes(channel.time, channel.value, cfg)).size
    }
    if not found:
        return recording  # without compiling the scene
    m = Scene(recording.scene, recording.source).model
    found = {key: rows for key, rows in found.items() if int(m.sensor_type[m.sensor(key[1]).id]) in POSITIONS}
    if not found:
        return recording
    listed = [_words(recording[name], channel, rows) for (name, channel), rows in found.items()]
    warnings.warn(
        printable(
            f"{recording.source}: readings far from those beside them are left out: {', '.join(listed[:6])}"
            + (f" and {len(listed) - 6} more channels" if len(listed) > 6 else "")
        ),
        stacklevel=2,
    )
    return replace(recording, demonstrations=tuple(_cleared(d, found) for d in recording.demonstrations))


def _words(d: Demonstration, channel: str, rows: np.ndarray) -> str:
    """Return how many spikes a channel has, and the time of the first."""
    one = d.measured[channel]
    return f"{len(rows)} of {len(one.time)} in {d.name}, measured/{channel} (the first at {one.time[rows[0]]:.3f} s)"


def _cleared(d: Demonstration, found: dict[tuple[str, str], np.ndarray]) -> Demonstration:
    """Return a demonstration without the readings of some rows of its channels."""
    measured = dict(d.measured)
    for name, channel in d.measured.items():
        if (rows := found.get((d.name, name))) is not None:
            value = np.array(channel.value, dtype=float)
            value[rows] = np.nan
            parts = (channel.covariance, channel.common)
            covariance, common = (None if part is None else np.array(part, dtype=float) for part in parts)
            for part in (covariance, common):
                if part is not None:
                    part[rows] = np.nan
            measured[name] = replace(channel, value=value, covariance=covariance, common=common)
    return replace(d, measured=measured)


def spikes(time: np.ndarray, value: np.ndarray, cfg: SpikeCfg | None = None) -> np.ndarray:
    """Return the rows of readings that are spikes, ascending, shape (n,) int.

    Args:
        time: Clock readings [s], shape (T,).
        value: Positions, shape (T, dim), NaN where missing.
        cfg: Thresholds.
    """
    cfg, value = cfg or SpikeCfg(), np.asarray(value, dtype=float).reshape(len(time), -1)
    rows = np.flatnonzero(np.isfinite(value).any(axis=1))
    value = value[:, np.isfinite(value[rows]).all(axis=0)] if len(rows) else value[:, :0]
    most, none = int(cfg.max_share * len(rows)), np.zeros(0, int)
    if len(rows) < cfg.min_readings or not value.shape[1]:
        return none
    off = _off(time[rows], value[rows])
    least = cfg.rounding * np.abs(value[rows]).max(axis=0)  # readings in steps often agree exactly
    usual = np.array([_median(one[one > floor]) for one, floor in zip(off.T, least, strict=True)]) / 0.67449
    ratio = (off / usual).max(axis=1)
    left = rows
    found: list[int] = []
    for start in np.argsort(-ratio)[: 3 * most + 3]:
        if ratio[start] <= cfg.min_ratio:
            break
        # Of neighbours, which a spike throws off too, it is the one that is left out first.
        if rows[start] in left:
            group = _group(int(rows[start]), left, time, value / usual, cfg)
            found += group
            left = left[~np.isin(left, group)]
    return np.array(sorted(found), dtype=int) if len(found) <= most else none


def _median(value: np.ndarray) -> float:
    """Return the median of values, shape (n,); infinity of none."""
    return float(np.median(value)) if len(value) else np.inf


def _group(row: int, left: np.ndarray, time: np.ndarray, value: np.ndarray, cfg: SpikeCfg) -> list[int]:
    """Return the spikes near a row, with it; none where those beside them do not lie on a smooth path without them.

    Args:
        row: The row.
        left: Rows that are no spikes so far, ascending, shape (n,).
        time: Clock readings [s], shape (T,).
        value: Positions in units of what they usually are off by, shape (T, dim).
        cfg: Thresholds.
    """
    reach = 3 * BESIDE + 2
    place = int(np.searchsorted(left, row))
    around, group = left[max(place - reach, 0) : place + reach + 1], [row]
    while len(group) <= cfg.max_group:
        others = around[~np.isin(around, group)]
        sizes = []
        for one in group:
            one_of = np.sort(np.append(others, one))
            sizes.append(float(_off(time[one_of], value[one_of])[np.searchsorted(one_of, one)].max()))
        off = _off(time[others], value[others]).max(axis=1)
        places = np.searchsorted(others, group)
        beside = np.unique([k for p in places for k in range(p - BESIDE, p + BESIDE) if 0 <= k < len(others)])
        if min(sizes) > cfg.min_ratio and off[beside].max() <= cfg.max_beside * min(sizes):
            return group
        if off[beside].max() <= cfg.min_ratio:
            break
        group.append(int(others[np.argmax(off)]))  # which may be the other spike that throws those beside off
    return []


def _off(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the distance of each reading from the cubic through two on either side, shape (T, dim); 0 at the ends.

    Args:
        time: Clock readings [s], shape (T,).
        value: Positions, shape (T, dim).
    """
    found = np.zeros(value.shape)
    count = len(time) - 2 * BESIDE
    if count < 1:
        return found
    offsets = [k for k in range(2 * BESIDE + 1) if k != BESIDE]
    t = np.stack([time[k : k + count] - time[BESIDE : BESIDE + count] for k in offsets])
    weight = np.ones(t.shape)
    for i in range(len(offsets)):
        for j in range(len(offsets)):
            if i != j:
                weight[i] *= t[j] / (t[j] - t[i])
    foretold = sum(w[:, None] * value[k : k + count] for w, k in zip(weight, offsets, strict=True))
    found[BESIDE : BESIDE + count] = np.abs(value[BESIDE : BESIDE + count] - foretold)
    return found
