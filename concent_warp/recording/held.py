"""Recordings of machines without drives that begin while a hand, a clamp or a magnet still holds them.

What nothing drives and what stands still does not begin to move by itself: until then it was held, which no model
knows. Such a demonstration begins with the motion; its initial state is estimated there.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from concent_warp.checks import MAX_COUNT, Bounds, Positive, PositiveDuration
from concent_warp.errors import printable
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.time_zero import earlier
from concent_warp.scene.scene import Scene


@dataclass(frozen=True)
class HeldCfg:
    """What tells being held from a slow beginning of a motion."""

    min_duration: PositiveDuration = 0.1
    """Shortest time of standing still that counts [s]: a fall from rest leaves the noise of a tracker within half."""
    min_readings: Annotated[int, Bounds(4, MAX_COUNT)] = 10
    """Fewest readings of a channel until and after the release [-]."""
    departure: Positive = 6.0
    """Distance from where it stood, over the noise, from which something moves [-]."""
    persistence: Annotated[int, Bounds(1, MAX_COUNT)] = 3
    """Readings one after the other that must be as far away [-]."""
    max_drift: Positive = 4.0
    """Largest difference of the means of the two halves of the time before, over its standard error [-]."""
    min_motion: Positive = 20.0
    """Least extent of the motion that follows, over the noise [-]."""


def from_release(recording: Recording, cfg: HeldCfg | None = None) -> Recording:
    """Return a recording whose demonstrations begin when what nothing drives is let go, with a warning that says so.

    Demonstrations that state where they start, and those with commands, images or point tracks, stay as they are.

    Args:
        recording: The recording, valid.
        cfg: Thresholds.
    """
    cfg = cfg or HeldCfg()
    released = {d.name: time for d in recording.demonstrations if (time := release_time(d, cfg)) is not None}
    if not released:
        return recording  # without compiling the scene
    m = Scene(recording.scene, recording.source).model
    if m.nu or m.nmocap:
        return recording
    named = ", ".join(f"{name} at {time:.3f} s" for name, time in released.items())
    warnings.warn(
        printable(
            f"{recording.source}: nothing drives what stands still at the beginning, so it was held; times are counted"
            f" from its release: {named}"
        ),
        stacklevel=2,
    )
    demonstrations = [_after(d, released[d.name]) if d.name in released else d for d in recording.demonstrations]
    return replace(recording, demonstrations=tuple(demonstrations))


def release_time(d: Demonstration, cfg: HeldCfg | None = None) -> float | None:
    """Return when what stood still began to move [s]; None where it moved from the beginning on, or never."""
    cfg = cfg or HeldCfg()
    if d.action or d.image or d.points or d.policy is not None or d.qpos is not None or d.qvel is not None:
        return None
    spans = [_still_until(channel, cfg) for channel in d.measured.values()]
    if not spans or any(span is None for span in spans):
        return None
    time = min(span for span in spans if span is not None)
    left = all((c.time >= time).sum() >= cfg.min_readings for c in d.measured.values())
    return time if np.isfinite(time) and left else None


def _still_until(channel: Channel, cfg: HeldCfg) -> float | None:
    """Return until when a channel stands still [s], infinity for ever; None where it moves from the beginning on."""
    value = np.asarray(channel.value, dtype=float).reshape(len(channel.time), -1)
    value = value[:, np.isfinite(value).any(axis=0)]
    known = np.isfinite(value).all(axis=1)
    time, value, few = channel.time[known], value[known], cfg.min_readings
    if len(time) < 2 * few or not value.shape[1]:
        return None
    noise = np.minimum(_noise(value), _noise(value[:few]))
    resolution = [np.diff(np.unique(one)) for one in value.T]
    step = np.array([gaps.min() if len(gaps) else 0.0 for gaps in resolution])
    noise = np.maximum(noise, step / np.sqrt(12))
    away = (np.abs(value - value[:few].mean(axis=0)) > cfg.departure * noise).any(axis=1)
    run = np.convolve(away, np.ones(cfg.persistence), mode="valid") == cfg.persistence
    if not run.any():
        return np.inf
    first = int(np.argmax(run))
    if first < few or time[first] - time[0] < cfg.min_duration:
        return None
    before, half = value[:first], first // 2
    drift = np.abs(before[:half].mean(axis=0) - before[half:].mean(axis=0))
    still = (drift <= cfg.max_drift * noise * 2 / np.sqrt(first)).all()
    moves = (np.ptp(value[first:], axis=0) > cfg.min_motion * noise).any()
    return float(time[first]) if still and moves else None


def _noise(value: np.ndarray) -> np.ndarray:
    """Return the noise of each component of values (T, n) from third differences, shape (n,)."""
    third = value[3:] - 3 * value[2:-1] + 3 * value[1:-2] - value[:-3]
    return np.median(np.abs(third), axis=0) / (0.67449 * np.sqrt(20))


def _after(d: Demonstration, start: float) -> Demonstration:
    """Return a demonstration from a time on, which is its time 0."""
    measured = {}
    for name, one in d.measured.items():
        kept = one.time >= start - 1e-9
        covariance, common = (None if part is None else part[kept] for part in (one.covariance, one.common))
        measured[name] = replace(one, time=one.time[kept], value=one.value[kept], covariance=covariance, common=common)
    return earlier(replace(d, measured=measured), start)
