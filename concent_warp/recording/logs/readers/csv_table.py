"""Tables of numbers, CSV: a header of names, a row a sample; which columns are the time is said in `table_times`.

A file by itself is a log of one episode; so is a folder of files that have no column in common, as one of the joints
and one of motion capture, and beside images a file is a part of their episode.
"""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.recording.logs.readers.log import Episode, Signal
from concent_warp.recording.logs.readers.table_times import Stamps

COMMAND = re.compile(
    r"(?i:command|cmd|goal|target|setpoint|desired)|(?<![A-Za-z])(?i:action)|(?<=[a-z])Action"  # no reaction
)
"""Parts of names that say that a column, or all of a table, is commanded."""
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
SEPARATORS = (",", ";", "\t")
TABLES = (".csv", ".tsv")


class CsvTable:
    """A table, which is one episode."""

    kind = "table (CSV)"
    numbers: Sequence[int] = (0,)

    def __init__(self, path: Path) -> None:
        """Name the file, or the folder of files; they are read by `episode`."""
        self.source = Path(path)

    def episode(self, number: int) -> Episode:
        """See `Log.episode`."""
        signals: dict[str, Signal] = {}
        for path in tables_in(self.source):
            signals |= table_signals(path, f"{path.stem}/")
        return Episode(number, signals or table_signals(self.source), {})


def tables_in(folder: Path) -> list[Path]:
    """Return the tables of a folder, in the order of their names; none of a file."""
    if not folder.is_dir():
        return []
    return sorted(one for one in folder.iterdir() if one.suffix.lower() in TABLES and one.is_file())


def is_one_episode(folder: Path, parts: Collection[str] = ()) -> bool:
    """Return whether the tables of a folder are parts of one episode: two or more without a common column of numbers.

    The tables of several episodes have the same columns. So have those of several bodies: `parts` tells them.

    Args:
        folder: The folder.
        parts: Names that parts of an episode have, such as those of bodies; tables that all have such names are one.
    """
    seen: set[str] = set()
    tables = tables_in(folder)
    if len(tables) > 1 and all(path.stem in parts for path in tables):
        return True
    for path in tables:
        try:
            header = [name.strip() for name in next(table_rows(path), (0, [""]))[1]]
            stamps = Stamps.of(header, str(path))
        except RecordingError:
            return False
        names = {name for k, name in enumerate(header) if k not in (stamps.column, stamps.rest)}
        if not names or names & seen:
            return False
        seen |= names
    return len(tables) > 1


def table_signals(path: Path, folder: str = "") -> dict[str, Signal]:
    """Return the columns of a table but the one of times; those of texts are left out.

    Args:
        path: The file.
        folder: What goes before the names of the columns.

    Raises:
        RecordingError: It is no such table.
    """
    rows = table_rows(path)
    header = [name.strip() for name in next(rows, (0, [""]))[1]]
    stamps = Stamps.of(header, f"{path}, line 1")
    if twice := sorted({name for name in header if header.count(name) > 1}):
        raise RecordingError("two columns of a table have the same name", where=f"{path}, line 1", found=twice)
    columns, lines = [_Column(name) for name in header], array("q")
    for line, cells in rows:
        where = f"{path}, line {line}"
        if len(cells) != len(header):
            raise RecordingError("wrong number of columns", where=where, expected=len(header), found=len(cells))
        try:
            stamps.append(cells)
        except ValueError as error:
            raise _not_a_number("a time", where, str(error)) from None
        lines.append(line)
        for column, cell in zip(columns, cells, strict=True):
            column.append(line, cell.strip())
    if not len(stamps):
        raise RecordingError("a table has no rows below its header", where=path)
    found, (times, used), numbers = {}, stamps.times(), np.array(lines)
    for k, column in enumerate(columns):
        if k not in used and (values := column.numbers(path)) is not None:
            name = folder + column.name
            command = COMMAND.search(name) is not None
            found[name] = Signal(
                name, times, values, command=command, sparse=True, frames=stamps.frames, lines=numbers, file=str(path)
            )
    return found


class _Column:
    """The cells of a column so far."""

    def __init__(self, name: str) -> None:
        """Begin without any cell."""
        self.name = name
        self._values = array("d")
        self._text: tuple[int, str] | None = None

    def append(self, line: int, text: str) -> None:
        """Add the cell of a line."""
        try:
            self._values.append(float(text) if text else math.nan)
        except ValueError:
            self._values.append(math.nan)
            self._text = self._text or (line, text)

    def numbers(self, path: Path) -> np.ndarray | None:
        """Return the numbers, NaN where a cell is empty, shape (T,); None for a column of texts.

        Args:
            path: The file, for messages.

        Raises:
            RecordingError: Some cells are numbers and some are not, or all have a decimal comma.
        """
        values = np.array(self._values)
        if self._text is None:
            return values
        line, text = self._text
        if np.isfinite(values).any() or DECIMAL_COMMA.fullmatch(text):
            raise _not_a_number(f"a cell of column {self.name!r}", f"{path}, line {line}", text)
        return None


def _not_a_number(what: str, where: str, text: str) -> RecordingError:
    """Return the refusal of a cell."""
    fix = "write decimals with a point" if DECIMAL_COMMA.fullmatch(text) else None
    return RecordingError(f"{what} is not a number", where=where, found=repr(text[:40]), fix=fix)


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
