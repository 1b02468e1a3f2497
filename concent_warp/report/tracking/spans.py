"""Stretches of a track in which a body was lost, filled backward or bridged, and the words for them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from concent_warp.perception.tracking.result import BRIDGED, FILLED, LOST, TRACKED, BodyTrack, TrackQuality

WORDS = {TRACKED: "tracked", FILLED: "filled backward", BRIDGED: "bridged", LOST: "lost"}
"""States in words."""


@dataclass(frozen=True)
class StateSpan:
    """A stretch of moments in the same state, other than tracked."""

    state: str
    """"filled", "bridged" or "lost"."""
    first: int
    """First moment."""
    last: int
    """Last moment."""
    start: float
    """Start [s]: half way to the moment before."""
    end: float
    """End [s]: half way to the moment after."""
    reason: str
    """The most frequent reason of its moments."""

    @property
    def moments(self) -> int:
        """Number of moments."""
        return self.last - self.first + 1


def quality_of(track: BodyTrack) -> TrackQuality:
    """Return what the frames say about a track; of one that does not tell, which moments are lost."""
    if track.quality is not None:
        return track.quality
    unknown = np.full(len(track.time), np.nan)
    state = tuple(LOST if lost else TRACKED for lost in track.lost)
    reason = tuple(track.reason if lost else "" for lost in track.lost)
    return TrackQuality(state, reason, *[unknown] * 6)


def state_spans(track: BodyTrack) -> list[StateSpan]:
    """Return the stretches of a track, in order, in which the body was not simply tracked."""
    quality, time = quality_of(track), np.asarray(track.time, float)
    middle = (time[1:] + time[:-1]) / 2
    borders = np.concatenate([time[:1], middle, time[-1:]])
    found, first = [], 0
    for t in range(1, len(time) + 1):
        if t < len(time) and quality.state[t] == quality.state[first]:
            continue
        if quality.state[first] != TRACKED:
            reasons = Counter(reason for reason in quality.reason[first:t] if reason)
            reason = reasons.most_common(1)[0][0] if reasons else ""
            span = (float(borders[first]), float(borders[t]))
            found.append(StateSpan(quality.state[first], first, t - 1, *span, reason))
        first = t
    return found


def lost_spans(track: BodyTrack) -> list[StateSpan]:
    """Return the stretches of a track in which the body is lost."""
    return [span for span in state_spans(track) if span.state == LOST]
