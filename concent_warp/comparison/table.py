"""A comparison as a table: for the terminal and as Markdown. Lengths in mm, angles in degrees."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from concent_warp.comparison.result import Comparison, Summary
from concent_warp.comparison.units import percent_text, ratio_text, unit_text, value_text

if TYPE_CHECKING:
    from rich.table import Table


DISPENSABLE = ("samples", "p95", "max", "RMS", "noise")
"""Columns that a narrow terminal does without, the first ones first, which is said below the table."""


def mean_and_interval(summary: Summary) -> str:
    """Return a mean with its interval, such as ``1.20 [1.05, 1.38]``."""
    mean = value_text(summary.mean, summary.unit)
    if not np.isfinite(summary.low):
        return mean
    return f"{mean} [{value_text(summary.low, summary.unit)}, {value_text(summary.high, summary.unit)}]"


def _cells(comparison: Comparison, *, every_phase: bool = False) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of the table as text.

    Phases are listed separately for channels of bodies, and with `every_phase` for all.

    Per channel and phase: number of samples, mean error of each model with its 95 % interval, RMS, 95th percentile and
    largest error of the last, noise floor and the RMS error over it; with two models or more also the change
    of the mean, with its interval.
    """
    several = len(comparison.models) > 1
    header = ["channel", "phase", "unit", "samples", *(f"mean {name}" for name in comparison.models)]
    header += ["change"] if several else []
    header += ["RMS", "p95", "max", "noise", "x noise"]
    rows = []
    for channel, phase in comparison.rows():
        if phase and not every_phase and channel not in (comparison.object_channels or comparison.channels):
            continue
        summaries = [comparison.summarise(model, channel, phase) for model in comparison.models]
        last = summaries[-1]
        if not last.count:
            continue
        row = ["" if phase else channel, last.phase, unit_text(last.unit), str(last.count)]
        row += [mean_and_interval(summary) for summary in summaries]
        if several:
            row.append(_change(comparison, channel, phase))
        row += [value_text(value, last.unit) for value in (last.rms, last.p95, last.max, last.noise)]
        row.append("-" if last.ratio is None else ratio_text(last.ratio))
        rows.append(row)
    return header, rows


def _change(comparison: Comparison, channel: str, phase: tuple[str, ...]) -> str:
    """Return the change of the mean error in percent and the interval of the difference."""
    found = comparison.difference(channel, phase)
    if not np.isfinite(found.share):
        return "-"
    text = percent_text(found.share)
    if not np.isfinite(found.low):
        return text
    low, high = (value_text(end, found.unit, sign=True) for end in (found.low, found.high))
    return f"{text} [{low}, {high}]"


def rich_table(comparison: Comparison, *, every_phase: bool = False, width: int | None = None) -> Table:
    """Return the table for a terminal.

    Args:
        comparison: The comparison.
        every_phase: Whether channels that are not about bodies have a row for each phase too.
        width: Columns of the terminal; figures that do not fit are left out, the least telling first, and named below
            the table. None keeps all.
    """
    from rich.table import Table

    header, rows = _cells(comparison, every_phase=every_phase)
    left_out: list[str] = []
    if width is not None:
        header, rows, left_out = _narrowed(header, rows, width)
    caption = f"too narrow for {', '.join(left_out)}: --json has all" if left_out else None
    table = Table(header_style="bold", caption=caption, caption_justify="left")
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if name in ("channel", "phase", "unit") else "right", no_wrap=i == 0)
    for i, row in enumerate(rows):
        last = i + 1 == len(rows) or (not rows[i + 1][0].startswith(" ") and bool(rows[i + 1][0]))
        table.add_row(*row, end_section=last)
    return table


def _narrowed(header: list[str], rows: list[list[str]], width: int) -> tuple[list[str], list[list[str]], list[str]]:
    """Return a table that fits, and what was left out: some columns, then all intervals but the last model's. Then the
    phases stand below the channel.
    """
    left_out: list[str] = []

    def fits() -> bool:
        longest = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
        return sum(longest) + 3 * len(longest) + 1 <= width

    for name in DISPENSABLE:
        if not fits() and name in header:
            at = header.index(name)
            header = [*header[:at], *header[at + 1 :]]
            rows = [[*row[:at], *row[at + 1 :]] for row in rows]
            left_out.append(name)
    means = [i for i, name in enumerate(header) if name.startswith("mean ")]
    for at in (*means[:-1], *(i for i, name in enumerate(header) if name == "change")):
        if not fits():
            left_out += [f"interval of {header[at]}"] if any(" [" in row[at] for row in rows) else []
            rows = [[*row[:at], row[at].partition(" [")[0], *row[at + 1 :]] for row in rows]
    if not fits():
        header = [name.removeprefix("mean ") for name in (header[0], *header[2:])]
        rows = [[channel or f"  {phase}", *rest] for channel, phase, *rest in rows]
    return header, rows, left_out


def markdown_table(comparison: Comparison, *, every_phase: bool = False) -> str:
    """Return the table as Markdown."""
    header, rows = _cells(comparison, every_phase=every_phase)
    rule = [":---" if i < 3 else "---:" for i in range(len(header))]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows)) + "\n"
