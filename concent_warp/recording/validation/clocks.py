"""Checks that the clocks of a demonstration are in seconds and have a common start.

What is judged is chosen so that sound recordings pass: a channel says something about its clock only from
`JUDGED_SAMPLES` samples on, slow commands are fine (a command is held), and a slow sensor among fast ones is fine.
"""

from __future__ import annotations

import numpy as np

from concent_warp.recording.recording import Demonstration
from concent_warp.recording.validation.location import ErrorLocation

JUDGED_SAMPLES = 10
"""Channels with fewer samples are not judged: a state before and after is a sound recording."""
SLOW_PERIOD = 0.95
"""Sampling period [s] that no measurement of a contact has, but that one in milliseconds has at up to 1 kHz."""
FAST_PERIOD = 1e-6
"""Sampling period [s] below which a clock cannot be in seconds."""
SPAN_RATIO = 10.0
"""How much longer than the fast channels a slow one must last to be taken for another unit."""
LATE_START = 60.0
"""First sample [s] of a demonstration from which on its clock may be one that was not set to 0."""
SHORT_SILENCE = 1.0
"""Time without any sample [s] that is never refused."""


def check_clocks(demonstration: Demonstration, place: ErrorLocation) -> None:
    """Check the clocks of all channels of a demonstration, each of them already increasing.

    Refused are:

    - no channel at all;
    - a median period below `FAST_PERIOD`;
    - a measured channel with a median period from `SLOW_PERIOD` on, or a commanded one beside faster channels, that
      lasts `SPAN_RATIO` times as long as every faster channel;
    - a first sample of all that comes after `LATE_START` and after `SPAN_RATIO` times the demonstration's length;
    - a silence between channels that is longer than `SHORT_SILENCE` and than all the time in which some channel ran.

    Raises:
        RecordingError: With the channel whose clock is off.
    """
    measured: dict[str, np.ndarray] = {}
    for kind in ("measured", "points", "image"):
        measured |= {f"{kind}/{name}": np.asarray(s.time, float) for name, s in getattr(demonstration, kind).items()}
    commanded = {f"action/{name}": np.asarray(c.time, float) for name, c in demonstration.action.items()}
    times = measured | commanded
    if not times:
        raise place.error("the demonstration is empty", expected="at least one channel with samples")
    _check_periods(measured, commanded, place)
    _check_start(times, place)
    _check_silence(times, place)


def _check_periods(measured: dict[str, np.ndarray], commanded: dict[str, np.ndarray], place: ErrorLocation) -> None:
    """Refuse sampling periods that only another unit of time explains."""
    judged = {name: time for name, time in (measured | commanded).items() if len(time) >= JUDGED_SAMPLES}
    period = {name: float(np.median(np.diff(time))) for name, time in judged.items()}
    span = {name: float(time[-1] - time[0]) for name, time in judged.items()}
    fast_span = max((span[name] for name in judged if period[name] < SLOW_PERIOD), default=0.0)
    for name in judged:
        if period[name] < FAST_PERIOD:
            raise place.at(name).error(
                "its time does not look like seconds",
                expected=f"samples at least {FAST_PERIOD:g} s apart",
                found=f"{period[name]:.3g} s in the median",
                fix="write times in seconds",
            )
        slow = period[name] >= SLOW_PERIOD and span[name] > SPAN_RATIO * fast_span
        if slow and (name in measured or fast_span > 0):
            raise place.at(name).error(
                "its time looks like milliseconds",
                expected=f"samples less than {SLOW_PERIOD:g} s apart",
                found=f"{period[name]:.4g} s in the median",
                fix="write times in seconds",
            )


def _check_start(times: dict[str, np.ndarray], place: ErrorLocation) -> None:
    """Refuse a clock that was not set to 0 where the demonstration begins, such as seconds since 1970."""
    name = min(times, key=lambda n: times[n][0])
    start, end = times[name][0], max(time[-1] for time in times.values())
    if start > max(LATE_START, SPAN_RATIO * (end - start)):
        raise place.at(name).error(
            "its clock does not begin with the demonstration",
            row=0,
            expected=f"time 0 at the start, the first sample within {LATE_START:g} s",
            found=f"{start:.9g} s",
            fix="subtract the time at which the demonstration begins",
        )


def _check_silence(times: dict[str, np.ndarray], place: ErrorLocation) -> None:
    """Refuse channels whose clocks lie apart."""
    judged = sorted((time[0], time[-1], name) for name, time in times.items() if len(time) >= JUDGED_SAMPLES)
    covered, gaps, end = 0.0, [], None
    for start, stop, name in judged:
        if end is not None and start > end:
            gaps.append((start - end, start, name, end))
        covered += max(0.0, stop - max(start, start if end is None else end))
        end = stop if end is None else max(end, stop)
    for gap, start, name, before in gaps:
        if gap > max(SHORT_SILENCE, covered):
            raise place.at(name).error(
                "its clock does not overlap with those of the other channels",
                row=0,
                expected=f"a start near the {before:.6g} s at which they end, or earlier",
                found=f"{start:.9g} s",
                fix="give all channels of a demonstration the same time 0",
            )
