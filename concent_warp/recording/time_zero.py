"""Logs whose clock runs before they begin: time 0 is set to their first sample."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from concent_warp.errors import printable
from concent_warp.recording.bounds import MAX_MAGNITUDE
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.recording.validation.cfg import ClockCheckCfg


def counted_from_first_sample(recording: Recording, cfg: ClockCheckCfg | None = None) -> Recording:
    """Return a recording whose demonstrations begin with their first sample, with a warning that names those moved.

    Of those that begin later than `ClockCheckCfg.short_gap`, such as logs with the uptime of a computer: a simulation
    would run without commands and measurements until then. Where a demonstration states its state at time 0, that is
    when it begins, and it stays. What is no time in seconds stays too: this comes before `validate`, which refuses it.

    Args:
        recording: The recording, which need not be valid.
        cfg: Thresholds.
    """
    cfg = cfg or ClockCheckCfg()
    demonstrations, moved = [], {}
    for d in recording.demonstrations:
        first = _first(d)
        if first > cfg.short_gap and d.qpos is None and d.qvel is None:
            moved[d.name] = first
            d = earlier(d, first)
        demonstrations.append(d)
    if not moved:
        return recording
    named = ", ".join(f"{name} from {first:.6g} s" for name, first in moved.items())
    warnings.warn(printable(f"{recording.source}: times are counted from the first sample: {named} on"), stacklevel=2)
    return replace(recording, demonstrations=tuple(demonstrations))


def _first(d: Demonstration) -> float:
    """Return the time of the first sample of all [s]; 0 where there is none, or what is no time in seconds."""
    times = [np.asarray(stream.time) for stream in _streams(d)]
    usable = all(t.ndim == 1 and len(t) and t.dtype.kind in "fiu" and 0 <= t[0] <= MAX_MAGNITUDE for t in times)
    return min(float(t[0]) for t in times) if times and usable else 0.0


def _streams(d: Demonstration) -> list[Any]:
    """Return all that has times."""
    policy = [] if d.policy is None else [d.policy]
    return [*d.action.values(), *d.measured.values(), *d.points.values(), *d.image.values(), *policy]


def earlier(d: Demonstration, by: float) -> Demonstration:
    """Return a demonstration with all times earlier by some seconds."""
    kinds = {
        kind: {name: replace(stream, time=stream.time - by) for name, stream in getattr(d, kind).items()}
        for kind in ("action", "measured", "points", "image")
    }
    policy = None if d.policy is None else replace(d.policy, time=d.policy.time - by)
    return replace(d, policy=policy, **kinds)
