"""Times of the rows of a table: which columns they are in, and in which unit.

One column, `time`, `timestamp`, `t` and alike, also with a unit (`time_ms`, `Time (Seconds)`) or signs before it
(`%time`, `__time`); it may have a second of what is left of whole seconds (`time_sec` and `time_nsec`). Else columns
whose names end so (`header.stamp`, or `header.stamp.secs` and `.nsecs`), else numbers of frames.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from concent_warp.errors import RecordingError

EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Whole numbers above the first are since 1970 in units of the second [s]."""
UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millisec", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "usecs", "microsec", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds"), 1e-9),
}
"""Units of times [s] by the words that name them."""
_NAME = r"(?:time|timestamp|time_?stamp|stamp|t|clock)"
_UNIT = rf"(?:[ _.]?[\[(]?({'|'.join(UNITS)})[\])]?)?"
TIME = re.compile(rf"[^a-z0-9]*{_NAME}{_UNIT}", re.IGNORECASE)
"""Names of a column of times, with its unit."""
ENDS_IN_TIME = re.compile(rf"(?:.*[^a-z])(?:time|timestamp|time_?stamp|stamp){_UNIT}", re.IGNORECASE)
"""Names that end in one of these, behind a prefix such as a topic."""
FRAME = re.compile(r"[^a-z0-9]*frame[ _.]?(?:id|index|idx|no|nr|num|number|count)?[^a-z0-9]*", re.IGNORECASE)
"""Names of a column of numbers of frames, which count where there are no times."""
PART = re.compile(rf"(|.*[^a-z]|.*time|.*stamp)({'|'.join(UNITS)})", re.IGNORECASE)
"""A name that ends in a unit as a word of its own: no `status`."""


@dataclass(frozen=True)
class Stamps:
    """Times of the rows so far."""

    column: int
    """Of the times, or of their whole seconds."""
    unit: str
    """Which its name states, empty for none."""
    rest: int | None = None
    """Column of what is left of the seconds, where there is one."""
    rest_unit: str = ""
    frames: bool = False
    """Whether they are numbers of frames, of which the map states the rate."""
    _time: array[float] = field(default_factory=lambda: array("d"))
    _rest: array[float] = field(default_factory=lambda: array("d"))

    @staticmethod
    def of(header: Sequence[str], where: str) -> Stamps:
        """Return the times of a table by the names of its columns.

        Args:
            header: The names.
            where: Their place, for messages.

        Raises:
            RecordingError: No column is of times, or several may be.
        """
        parts = _parts(header)
        fractions = [one.rest for one in parts.values()]
        named = [(k, hit[1] or "") for k, name in enumerate(header) if (hit := TIME.fullmatch(name))]
        named = [one for one in named if one[0] not in fractions]
        if not named and not parts:
            named = [(k, hit[1] or "") for k, name in enumerate(header) if (hit := ENDS_IN_TIME.fullmatch(name))]
            if len(named) > 1:
                fix = "rename the one that is meant to time"
                listed = [header[k] for k, _ in named[:12]]
                raise RecordingError("several columns of a table may be the time", where=where, found=listed, fix=fix)
            frames = [k for k, name in enumerate(header) if FRAME.fullmatch(name)]
            if not named and len(frames) == 1 and len(header) > 1:
                return Stamps(frames[0], "", frames=True)
        if len(header) < 2 or not (named or parts):
            raise RecordingError(
                "a table has no times", where=where, found=",".join(header)[:200],
                expected="names in the first line, one of them time or timestamp, also with a unit as in time_ms, two "
                "as time_sec and time_nsec, or frame for numbers of frames",
            )  # fmt: skip
        # A duration in two columns, such as time_from_start, may stand before the time.
        first = named[0][0] if named else min(parts)
        return parts[first] if first in parts else Stamps(*named[0])

    def append(self, cells: Sequence[str]) -> None:
        """Add the time of a row.

        Raises:
            ValueError: A cell, which is the message, is no time.
        """
        text = cells[self.column].strip()
        try:
            unit = UNITS.get(self.unit.lower(), 1.0)
            self._time.append(seconds(text) if unit == 1 else float(text) * unit)  # ts may be in any unit
            if self.rest is not None:
                text = cells[self.rest].strip()
                self._rest.append(float(text) * UNITS[self.rest_unit.lower()])
        except ValueError:
            raise ValueError(text) from None

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._time)

    def times(self) -> tuple[np.ndarray, tuple[int, ...]]:
        """Return the times [s], shape (T,), and the columns that they are from.

        Two columns are added where the first has whole seconds and the second less than one; else one has all of the
        time, the second beside whole seconds.
        """
        time, rest = np.array(self._time), np.array(self._rest)
        if self.rest is None or (time % 1).any():
            return time, (self.column,)
        if ((rest >= 0) & (rest < 1)).all():
            return time + rest, (self.column, self.rest)
        return rest, (self.rest,)


def seconds(text: str) -> float:
    """Return a time that is written as text [s]: a date and time, or a number, whole ones since 1970 by their size.

    Raises:
        ValueError: It is neither.
    """
    try:
        value = float(text)
    except ValueError:
        when = datetime.fromisoformat(text)
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    if "." not in text:
        return next((value * unit for least, unit in EPOCHS if value >= least), value)
    return next((value * unit for least, unit in EPOCHS[1:] if value >= least), value)


def _parts(header: Sequence[str]) -> dict[int, Stamps]:
    """Return times that are in two columns, whole seconds and what is left, by the column of the seconds."""
    ends = [(k, hit[1].lower(), hit[2]) for k, name in enumerate(header) if (hit := PART.fullmatch(name))]
    found: dict[int, Stamps] = {}
    for k, stem, unit in ends:
        if UNITS[unit.lower()] != 1:
            continue
        for rest, other, fraction in ends:
            if other == stem and UNITS[fraction.lower()] in (1e-6, 1e-9):
                found.setdefault(k, Stamps(k, unit, rest, fraction))
    return found
