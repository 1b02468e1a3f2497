"""Tables of numbers, CSV: a header of names, a row a sample, one column of which is the time.

A file by itself is a log of one episode; beside images it is a part of theirs.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.recording.logs.readers.log import Episode, Signal

COMMANDS = ("action", "command", "cmd", "goal", "target", "setpoint", "desired")
"""Parts of names that say that a column, or all of a table, is commanded."""
EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Whole numbers above the first are since 1970 in units of the second [s]."""
TIME = re.compile(r"(?:time|timestamp|time_?stamp|stamp|t|clock)(?:[ _]?[\[(]?(s|sec|ms|us|ns)[\])]?)?", re.IGNORECASE)
"""Names of a column of times, with its unit."""
UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
SEPARATORS = (",", ";", "\t")


class CsvTable:
    """A table, which is one episode."""

    kind = "table (CSV)"
    numbers: Sequence[int] = (0,)

    def __init__(self, path: Path) -> None:
        """Name the file; it is read by `episode`."""
        self.source = Path(path)

    def episode(self, number: int) -> Episode:
        """See `Log.episode`."""
        return Episode(number, table_signals(self.source), {})


def table_signals(path: Path, folder: str = "") -> dict[str, Signal]:
    """Return the columns of a table but the one of times; those without any number are left out.

    Args:
        path: The file.
        folder: What goes before the names of the columns.

    Raises:
        RecordingError: It is no such table.
    """
    rows = table_rows(path)
    header = [name.strip() for name in next(rows, (0, [""]))[1]]
    clocks = [(k, hit[1]) for k, name in enumerate(header) if (hit := TIME.fullmatch(name))]
    if len(header) < 2 or not clocks:
        raise RecordingError(
            "a table has no times",
            where=f"{path}, line 1",
            expected="names in the first line, one of them time or timestamp, also with a unit as in time_ms",
            found=",".join(header)[:200],
        )
    if twice := sorted({name for name in header if header.count(name) > 1}):
        raise RecordingError("two columns of a table have the same name", where=f"{path}, line 1", found=twice)
    (clock, unit), *_ = clocks
    scale = UNITS.get((unit or "").lower())
    times: list[float] = []
    lines: list[int] = []
    texts: list[list[str]] = []
    for line, cells in rows:
        if len(cells) != len(header):
            raise RecordingError(
                "wrong number of columns", where=f"{path}, line {line}", expected=len(header), found=len(cells)
            )
        try:
            text = cells[clock].strip()
            times.append(float(text) * scale if scale else seconds(text))
        except ValueError as error:
            raise RecordingError("a time is not a number", where=f"{path}, line {line}", found=str(error)) from None
        lines.append(line)
        texts.append(cells)
    if not texts:
        raise RecordingError("a table has no rows below its header", where=path)
    found, stamps = {}, np.array(times)
    for k, name in enumerate(header):
        if k != clock and (values := _column(path, name, lines, [row[k] for row in texts])) is not None:
            command = any(word in f"{folder}{name}".lower() for word in COMMANDS)
            found[folder + name] = Signal(folder + name, stamps, values, command=command)
    return found


def _column(path: Path, name: str, lines: Sequence[int], cells: Sequence[str]) -> np.ndarray | None:
    """Return the numbers of a column, NaN where a cell is empty; None where none is a number, as in texts.

    Args:
        path: The file, for messages.
        name: Name of the column.
        lines: Line of each cell.
        cells: Its cells.

    Raises:
        RecordingError: Some cells are numbers and some are not.
    """
    values, wrong = np.full(len(cells), np.nan), -1
    for row, cell in enumerate(cells):
        text = cell.strip()
        try:
            values[row] = float(text) if text else np.nan
        except ValueError:
            wrong = row if wrong < 0 else wrong
    if wrong >= 0 and np.isfinite(values).any():
        where, found = f"{path}, line {lines[wrong]}", repr(cells[wrong][:40])
        raise RecordingError(f"a cell of column {name!r} is not a number", where=where, found=found)
    return values if wrong < 0 else None


def seconds(text: str) -> float:
    """Return a time that is written as text [s]: whole numbers since 1970 by their size."""
    value = float(text)
    if "." not in text:
        return next((value * unit for least, unit in EPOCHS if value >= least), value)
    return next((value * unit for least, unit in EPOCHS[1:] if value >= least), value)


def table_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a CSV file that are not blank, each with its line number.

    The separator is the comma, semicolon or tab that the first line has most of.
    """
    if path.stat().st_size > limits().file_bytes:
        raise RecordingError("the table is too large", where=path, fix=raising("file_bytes"))
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            file.seek(0)
            reader = csv.reader(file, delimiter=max(SEPARATORS, key=first.count))
            for cells in reader:
                if cells:
                    yield reader.line_num, cells
    except (csv.Error, UnicodeDecodeError, OSError) as error:
        raise RecordingError("not a CSV file", where=path, expected="UTF-8 text", found=error) from None
