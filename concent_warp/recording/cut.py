"""The beginning of a recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from concent_warp.errors import RecordingError
from concent_warp.recording.recording import Demonstration, Recording


def beginning(recording: Recording, duration: float) -> Recording:
    """Return a recording whose demonstrations end after a time [s] at the latest.

    Raises:
        RecordingError: Nothing of a demonstration was measured or commanded by then.
    """
    return replace(
        recording, demonstrations=tuple(_beginning(d, duration, recording) for d in recording.demonstrations)
    )


def _beginning(d: Demonstration, duration: float, recording: Recording) -> Demonstration:
    """Return the beginning of a demonstration; channels that begin later are left out."""
    kept: dict[str, Any] = {}
    for kind in ("action", "measured", "points", "image"):
        parts = {name: _cut(stream, duration) for name, stream in getattr(d, kind).items()}
        kept[kind] = {name: part for name, part in parts.items() if len(part.time)}
    if not (kept["measured"] or kept["points"]):
        raise RecordingError(
            f"nothing is measured in the first {duration:g} s", where=f"{recording.source}: {d.name}", fix="keep more"
        )
    return replace(d, success=d.success if d.duration <= duration else None, **kept)


def _cut(stream: Any, duration: float) -> Any:
    """Return the samples of a channel, point track or camera up to a time [s]."""
    inside = stream.time <= duration
    per_sample = ("time", "value", "visible", "covariance", "common", "rgb", "depth")
    arrays = {name: getattr(stream, name, None) for name in per_sample}
    return replace(stream, **{name: array[inside] for name, array in arrays.items() if array is not None})
