"""What a map leaves without a channel, and the lines to write for it."""

from __future__ import annotations

import re
from collections.abc import Sequence

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.targets import Target

LISTED = 8
"""Most names that one sentence gives."""


def entry_of(target: Target) -> str:
    """Return the entry of the map of an actuator or sensor."""
    quoted = target.name if re.fullmatch(r"[A-Za-z0-9_-]+", target.name) else f'"{target.name}"'
    return f"[{'action' if target.command else 'measured'}.{quoted}]"


def to_write(left: Sequence[Target]) -> str:
    """Return what has no channel, and how one is written."""
    return f"without a channel: {listed([entry_of(one) for one in left])}; {_as(left)}"


def empty_map(source: str, left: Sequence[Target], unused: Sequence[str]) -> RecordingError:
    """Return that a map has no entry, with the entries and channels that it could have."""
    entries = listed([entry_of(one) for one in left]) if left else "[action.*], [measured.*], [body.*] or [image.*]"
    found = f"no entry, and in the log {listed(sorted(unused))}" if unused else None
    fix = _as(left) if left else None
    return RecordingError("the map is empty", where=source, expected=entries, found=found, fix=fix)


def listed(names: Sequence[str]) -> str:
    """Return names, the first of many."""
    return ", ".join(names[:LISTED]) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")


def _as(left: Sequence[Target]) -> str:
    """Return how an entry is written, for one number and for several."""
    numbers = [next((one for one in left if (one.size > 1) == several), None) for several in (False, True)]
    lines = [f"{entry_of(one)} and below it source = {_source(one.size)}" for one in numbers if one is not None]
    return f"for each that the log has, write {', '.join(lines)}"


def _source(size: int) -> str:
    """Return a source of a number of channels."""
    if size == 1:
        return '"CHANNEL"'
    parts = "XYZ" if size == 3 else "XYZW"[:size]
    return "[" + ", ".join(f'"CHANNEL_{part}"' for part in parts) + "]"
