"""Checks that the clocks of a demonstration are in seconds and start together.

Slow commands are sound, since a command stays until the next one, and so is a slow sensor among fast ones.
"""

from __future__ import annotations

import numpy as np

from concent_warp.recording.recording import Demonstration
from concent_warp.recording.validation.cfg import ClockCheckCfg
from concent_warp.recording.validation.location import ErrorLocation


def check_clocks(demonstration: Demonstration, place: ErrorLocation, cfg: ClockCheckCfg | None = None) -> None:
    """Check the clocks of all channels of a demonstration, each of them already increasing.

    Refused are:

    - no channel at all;
    - a median period below `fast_period`;
    - a measured channel with a median period from `slow_period` on, or a commanded one beside faster channels, that
      lasts `max_span_ratio` times as long as every faster channel;
    - a first sample of all that comes after `late_start` and after `max_span_ratio` times the demonstration's length;
    - a gap between channels that is longer than `short_gap` and than all the time in which some channel ran.

    Raises:
        RecordingError: With the channel whose clock is off.
    """
    cfg = cfg or ClockCheckCfg()
    measured: dict[str, np.ndarray] = {}
    for kind in ("measured", "points", "image"):
        measured |= {f"{kind}/{name}": np.asarray(s.time, float) for name, s in getattr(demonstration, kind).items()}
    commanded = {f"action/{name}": np.asarray(c.time, float) for name, c in demonstration.action.items()}
    times = measured | commanded
    if not times:
        raise place.error("the demonstration is empty", expected="at least one channel with samples")
    _check_periods(measured, commanded, place, cfg)
    _check_start(times, place, cfg)
    _check_gaps(times, place, cfg)


def _check_periods(
    measured: dict[str, np.ndarray], commanded: dict[str, np.ndarray], place: ErrorLocation, cfg: ClockCheckCfg
) -> None:
    """Refuse sampling periods that only another unit of time explains."""
    judged = {name: time for name, time in (measured | commanded).items() if len(time) >= cfg.min_samples}
    period = {name: float(np.median(np.diff(time))) for name, time in judged.items()}
    span = {name: float(time[-1] - time[0]) for name, time in judged.items()}
    fast_span = max((span[name] for name in judged if period[name] < cfg.slow_period), default=0.0)
    for name in judged:
        if period[name] < cfg.fast_period:
            raise place.at(name).error(
                "its time does not look like seconds",
                expected=f"samples at least {cfg.fast_period:g} s apart",
                found=f"{period[name]:.3g} s in the median",
                fix="write times in seconds",
            )
        slow = period[name] >= cfg.slow_period and span[name] > cfg.max_span_ratio * fast_span
        if slow and (name in measured or fast_span > 0):
            raise place.at(name).error(
                "its time looks like milliseconds",
                expected=f"samples less than {cfg.slow_period:g} s apart",
                found=f"{period[name]:.4g} s in the median",
                fix="write times in seconds",
            )


def _check_start(times: dict[str, np.ndarray], place: ErrorLocation, cfg: ClockCheckCfg) -> None:
    """Refuse a clock that was not set to 0 where the demonstration begins, such as seconds since 1970."""
    name = min(times, key=lambda n: times[n][0])
    start, end = times[name][0], max(time[-1] for time in times.values())
    if start > max(cfg.late_start, cfg.max_span_ratio * (end - start)):
        raise place.at(name).error(
            "its clock does not begin with the demonstration",
            row=0,
            expected=f"time 0 at the start, the first sample within {cfg.late_start:g} s",
            found=f"{start:.9g} s",
            fix="subtract the time at which the demonstration begins",
        )


def _check_gaps(times: dict[str, np.ndarray], place: ErrorLocation, cfg: ClockCheckCfg) -> None:
    """Refuse channels whose clocks lie apart."""
    judged = sorted((time[0], time[-1], name) for name, time in times.items() if len(time) >= cfg.min_samples)
    covered, gaps, end = 0.0, [], None
    for start, stop, name in judged:
        if end is not None and start > end:
            gaps.append((start - end, start, name, end))
        covered += max(0.0, stop - max(start, start if end is None else end))
        end = stop if end is None else max(end, stop)
    for gap, start, name, before in gaps:
        if gap > max(cfg.short_gap, covered):
            raise place.at(name).error(
                "its clock does not overlap with those of the other channels",
                row=0,
                expected=f"a start near the {before:.6g} s at which they end, or earlier",
                found=f"{start:.9g} s",
                fix="give all channels of a demonstration the same time 0",
            )
