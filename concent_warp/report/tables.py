"""The tables of a report as HTML."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from concent_warp.comparison.result import Comparison, Summary
from concent_warp.comparison.units import percent_text, ratio_text, unit_text, value_text
from concent_warp.report.headline import headline_channel

Row = tuple[str, Sequence[str]]
"""Class of a table row and its cells as HTML."""


def table(header: Sequence[str], rows: Sequence[Row], numbers_from: int) -> str:
    """Return a table; columns from `numbers_from` on are numbers."""
    kind = [' class="number"' if i >= numbers_from else "" for i in range(len(header))]
    head = "".join(f"<th{k}>{name}</th>" for name, k in zip(header, kind, strict=True))
    body = "".join(
        f'<tr class="{style}">' + "".join(f"<td{k}>{c}</td>" for c, k in zip(row, kind, strict=True)) + "</tr>"
        for style, row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _mean_cell(summary: Summary) -> str:
    """Return a mean with its interval."""
    mean = value_text(summary.mean, summary.unit)
    if not np.isfinite(summary.low):
        return mean
    low, high = value_text(summary.low, summary.unit), value_text(summary.high, summary.unit)
    return f'{mean} <span class="interval">[{low}, {high}]</span>'


def _change_cell(
    comparison: Comparison, channel: str, phase: tuple[str, ...], demonstrations: tuple[str, ...] = ()
) -> str:
    """Return the relative change of the mean error, coloured where it is more than chance."""
    found = comparison.difference(channel, phase, demonstrations)
    if not np.isfinite(found.share):
        return "-"
    kind = {"fallen": "good", "risen": "bad"}.get(found.verdict, "")
    return f'<span class="{kind}">{percent_text(found.share)}</span>'


def error_table(comparison: Comparison, channels: Sequence[str], *, phases: bool) -> str:
    """Return the table of errors by channel, with a row for each phase if asked."""
    several = len(comparison.models) > 1
    header = ["channel", "unit", "samples", *(f"mean, {escape(name)}" for name in comparison.models)]
    header += ["change"] if several else []
    header += ["RMS", "p95", "max", "noise", "x noise"]
    rows: list[Row] = []
    for channel, phase in comparison.rows():
        if channel not in channels or (phase and not phases):
            continue
        summaries = [comparison.summarise(model, channel, phase) for model in comparison.models]
        last = summaries[-1]
        if not last.count:
            continue
        name = escape(phase[0]) if phase else f"<b>{escape(channel)}</b>"
        cells = [name, unit_text(last.unit), str(last.count), *map(_mean_cell, summaries)]
        cells += [_change_cell(comparison, channel, phase)] if several else []
        cells += [value_text(value, last.unit) for value in (last.rms, last.p95, last.max, last.noise)]
        cells.append("-" if last.ratio is None else ratio_text(last.ratio))
        rows.append(("phase-row" if phase else "", cells))
    return table(header, rows, 2)


def demonstration_table(
    comparison: Comparison, fitted: Sequence[str], overlap: Mapping[str, Mapping[str, float]]
) -> str:
    """Return the table of the headline channel's error by demonstration."""
    channel, phases = headline_channel(comparison), comparison.contact_phases()
    several = len(comparison.models) > 1
    unit = unit_text(comparison.summarise(comparison.after, channel, phases).unit)
    header = ["demonstration", "", *(f"mean, {escape(name)} [{unit}]" for name in comparison.models)]
    header += ["change"] if several else []
    header += [f"contact overlap, {escape(name)}" for name in overlap]
    rows: list[Row] = []
    for d in comparison.demonstrations:
        role = "" if not fitted else "fitted" if d in fitted else "not seen"
        cells = [escape(d), role]
        cells += [_mean_cell(comparison.summarise(model, channel, phases, (d,))) for model in comparison.models]
        cells += [_change_cell(comparison, channel, phases, (d,))] if several else []
        cells += [f"{values[d]:.2f}" if d in values else "-" for values in overlap.values()]
        rows.append(("", cells))
    return table(header, rows, 2)


def provenance(document: Mapping[str, Any]) -> str:
    """Return command, versions and settings."""
    parts = []
    if command := document.get("command"):
        parts.append(f"<h3>Command</h3><pre>{escape(str(command))}</pre>")
    if versions := document.get("versions"):
        text = "\n".join(f"{name} {number}" for name, number in versions.items())
        parts.append(f"<h3>Versions</h3><pre>{escape(text)}</pre>")
    if settings := document.get("settings"):
        text = json.dumps(settings, indent=2, default=str)
        parts.append(f"<details><summary>Settings</summary><pre>{escape(text)}</pre></details>")
    return "\n".join(parts) or "<p>No settings were given.</p>"
