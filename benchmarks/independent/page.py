"""The page of the benchmark on independent worlds."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.independent.data_set import ENGINES, DataSet
from benchmarks.independent.scoring import (
    FIGURES,
    LIBRARY_KINDS,
    Row,
    figure,
    named,
    score,
)
from benchmarks.pages import table, write_data, write_page

NAME = "independent"
CORE_SECONDS = 300.0
"""Processor time [s] over which diagnoses are counted: 5 minutes of one core."""
KEPT = (
    "name", "world", "kind", "rig", "size", "noise_stated", "locked", "truth", "verdict", "groups", "ratio", "error",
    "seconds", "processor_seconds", "held_out", "commit",
)  # fmt: skip


def read_results(path: Path) -> list[Row]:
    """Return the results of a file, one a line."""
    return [json.loads(one) for one in path.read_text().splitlines()]


def write_page_from(rows: Sequence[Row], earlier: Sequence[Row], every: Sequence[DataSet], host: str) -> None:
    """Write data and page of results and of those of an earlier state of the method."""
    write_data(NAME, {"host": host, "rows": [_slim(r) for r in rows], "earlier": [_slim(r) for r in earlier]})
    write_page(NAME, page(rows, earlier, every, host))


def _slim(row: Row) -> Row:
    """Return what the page shows of a result."""
    kept = {key: row[key] for key in KEPT if key in row}
    fields = ("name", "target", "accepted", "parameters")
    return kept | {"effects": [{f: e[f] for f in fields} for e in row.get("effects", ()) if e["accepted"]]}


def page(rows: Sequence[Row], earlier: Sequence[Row], every: Sequence[DataSet], host: str) -> str:
    """Return the page."""
    development, locked = ([r for r in rows if r["locked"] is wanted] for wanted in (False, True))
    before = {wanted: [r for r in earlier if r["locked"] is wanted] for wanted in (False, True)}
    revisions = ", ".join(f"`{c}`" for c in sorted({r.get("commit") or "-" for r in rows}))
    older = ", ".join(f"`{c}`" for c in sorted({r.get("commit") or "-" for r in earlier})) or "-"
    seconds = np.array([r.get("processor_seconds", r["seconds"]) for r in rows if "seconds" in r] or [0.0])
    total = sum(c.name in {r["name"] for r in rows} for c in every)
    measured = (
        f"{host} {total} of {len(every)} data sets, revision {revisions}; earlier state of the method: revision"
        f" {older}. Processor time of a diagnosis: median {np.median(seconds):.0f} s, longest {seconds.max():.0f} s;"
        f" more than {CORE_SECONDS:.0f} s in {int((seconds > CORE_SECONDS).sum())}."
    )
    bullet = any(r["world"] == "bullet" for r in rows)
    worlds = "recordings of worlds that share no formula with the library: one on MuJoCo with another step, other"
    worlds += " integrators, contacts, bristle friction and gears with rotor inertia, one on Drake"
    worlds += ", one on Bullet" if bullet else ""
    introduction = (
        f"`python -m benchmarks.independent` diagnoses {worlds}. Encoders quantise, clocks jitter, readings are lost,"
        " sensors have a latency below 0.5 ms; nominal masses, lengths and gains are wrong by up to 1 %, also where"
        " nothing is hidden; noise is stated in half of the sets. Each diagnosis has 300 s on two cores and is told"
        " that it has 285 s (`--seconds`); one that takes longer, or is unsettled then, counts as wrong."
    )
    split = (
        "A quarter of the effects x rigs, the rigs `grasp` and `insertion`, and half of the Drake data"
        f"{' and of the Bullet data' if bullet else ''} are locked by a rule on their names, fixed before any result:"
        " `benchmarks/independent/split.json`."
    )
    parts = [
        f"""# Diagnoses on independent worlds

{textwrap.fill(introduction, 120, break_on_hyphens=False)}

{textwrap.fill(split, 120, break_on_hyphens=False)}

*Exactly right*: the effects that are there and nothing else, each named alone or in a group of at most two. No effect
counts for another one. Square brackets have Wilson's 95 % intervals.

{textwrap.fill(measured, 120, break_on_hyphens=False)}
""",
        _figures(development, locked, before),
    ]
    for title, field in (
        ("rig", "rig"), ("magnitude", "size"), ("noise stated", "noise_stated"), ("kind", "kind"), ("world", "world"),
    ):  # fmt: skip
        parts.append(_by(title, field, development, locked, before))
    parts += [_by_effect(development, locked), _wrong(development, "development"), _wrong(locked, "locked")]
    return "\n".join(parts)


def _figures(development: Sequence[Row], locked: Sequence[Row], before: dict[bool, list[Row]]) -> str:
    """Return the table of the figures; without those of worlds that no result is of."""
    seen = {r["world"] for r in [*development, *locked]}
    missing = [engine for world, engine in ENGINES.items() if world not in seen]
    head = ["", "bar", "development", "earlier", "bar, locked", "locked", "earlier, locked"]
    lines = [
        [
            title,
            bar,
            figure(measure(development)),
            figure(measure(before[False])),
            bar_locked,
            figure(measure(locked)),
            figure(measure(before[True])),
        ]
        for title, bar, bar_locked, measure in FIGURES
        if not any(f", {engine}," in title for engine in missing)
    ]
    return table(head, lines)


def _by(
    title: str, field: str, development: Sequence[Row], locked: Sequence[Row], before: dict[bool, list[Row]]
) -> str:
    """Return the table of right answers by an entry of the sets."""
    values = sorted({str(r[field]) for r in [*development, *locked]})

    def right(rows: Sequence[Row], value: str) -> str:
        return figure([score(r) for r in rows if str(r[field]) == value])

    lines = [
        [value, right(development, value), right(before[False], value), right(locked, value)]
        for value in values
        if value != "None"
    ]
    head = [title, "development", "earlier", "locked"]
    return f"## By {title}\n\nRight by the measure of each kind of set.\n\n{table(head, lines)}"


def _by_effect(development: Sequence[Row], locked: Sequence[Row]) -> str:
    """Return the table of right answers by hidden effect."""
    every = [r for r in [*development, *locked] if r["kind"] in (*LIBRARY_KINDS, "outside")]
    effects = sorted({t["name"] for r in every for t in r["truth"]})
    lines = []
    for effect in effects:
        mine = [r for r in every if r["kind"] != "pair" and effect in [t["name"] for t in r["truth"]]]
        others = sorted({named(r) for r in mine if not score(r)})
        if mine:
            lines.append([f"`{effect}`", str(len(mine)), str(sum(map(score, mine))), "; ".join(others) or "-"])
    return f"## By effect\n\n{table(['hidden', 'data sets', 'right', 'named instead'], lines)}"


def _wrong(rows: Sequence[Row], title: str) -> str:
    """Return the table of the sets that are wrong."""
    lines = [
        [
            f"`{r['name']}`",
            r.get("verdict", r.get("error", "error").strip().splitlines()[-1][:60].replace("|", "/")),
            named(r),
            " -> ".join(f"{x:.2f}" for x in r.get("ratio", ())),
            f"{r['seconds']:.0f}" if "seconds" in r else "-",
        ]
        for r in sorted(rows, key=lambda r: (r["kind"], r["name"]))
        if not score(r)
    ]
    return f"## Wrong, {title}\n\n{table(['data set', 'verdict', 'named', 'residual over noise', 'seconds'], lines)}"
