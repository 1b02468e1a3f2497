"""The page of mutation testing: shares by room, survivors, and those that were judged equivalent by hand."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from benchmarks.development.mutants import ROOMS
from benchmarks.pages import machine_line, table, write_data, write_page

NAME = "mutation"
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.toml")
"""Mutants judged equivalent by hand: ``[[mutant]]`` with file, before, after (the lines) and reason."""
Row = dict[str, Any]


def equivalent_reasons(path: Path = EQUIVALENT) -> dict[tuple[str, str, str], str]:
    """Return why mutants are equivalent, by file and the line before and after the change."""
    entries = tomllib.loads(path.read_text()).get("mutant", []) if path.is_file() else []
    return {(e["file"], e["before"], e["after"]): e["reason"] for e in entries}


def identity(row: Row) -> tuple[str, str, str]:
    """Return what names a mutant in the list of equivalent ones."""
    return row["file"], row["before"], row["after"]


def room_line(room: str, rows: Sequence[Row], equivalent: dict[tuple[str, str, str], str]) -> list[str]:
    """Return a row of the table: counts, and the share that the tests notice with Wilson's 95 % interval."""
    counts = {
        outcome: sum(row["outcome"] == outcome for row in rows) for outcome in ("killed", "survived", "timed out")
    }
    noticed = counts["killed"] + counts["timed out"]
    low, high = binomtest(noticed, len(rows)).proportion_ci(method="wilson")
    same = sum(row["outcome"] == "survived" and identity(row) in equivalent for row in rows)
    without = f"{noticed / (len(rows) - same):.1%}" if len(rows) > same else "-"
    return [
        room,
        str(len(rows)),
        *(str(counts[outcome]) for outcome in ("killed", "timed out", "survived")),
        f"{noticed / len(rows):.1%}",
        f"{low:.1%} to {high:.1%}",
        str(same),
        without,
    ]


def mutation_page(rows: Sequence[Row], args: dict[str, Any], facts: dict[str, Any]) -> str:
    """Return the page of the results."""
    equivalent = equivalent_reasons()
    rooms = {room: [row for row in rows if row["room"] == room] for room in ROOMS}
    lines = [room_line(room, of, equivalent) for room, of in rooms.items() if of]
    lines.append(room_line("all", rows, equivalent))
    head = [
        "room", "mutants", "killed", "timed out", "survived", "noticed", "95 % interval", "equivalent", "without these",
    ]  # fmt: skip
    survivors = [row for row in rows if row["outcome"] == "survived" and identity(row) not in equivalent]
    same = [row for row in rows if row["outcome"] == "survived" and identity(row) in equivalent]
    parts = [
        "# Mutation testing",
        "How many small changes of the library do the tests notice?",
        "    pip install cosmic-ray\n"
        f"    python -m benchmarks.development.mutation --sample {args['sample']} --seed {args['seed']} "
        f"--jobs {args['jobs']} --budget {args['budget']:g}",
        machine_line(facts),
        "A mutant is one small change by an operator of cosmic-ray: another arithmetic operator or comparison, a "
        "number larger or smaller by one, a condition negated, a loop without turns, a decorator removed. "
        f"{args['sample']} places a room are drawn at random with a seed, and one change at each. A mutant is noticed "
        "where a test fails or does not end. It is tried on tests that call its function, quickest first, up to "
        f"{args['budget']:g} s of them, none longer than {args['slowest']} s.",
        table(head, lines),
        "“noticed” counts killed and timed out, out of all; its interval is Wilson's. “equivalent” are survivors that "
        "change nothing that anyone can observe, judged by hand and listed below; the last column leaves them out.",
        "The aim is 85 %. Where a mutant survives here, slower tests, or tests beyond the budget, may still notice it.",
        "Left out: bodies of Warp kernels, annotations, what needs CUDA, and replacements that fail on any "
        "floating-point number (`a << b` for `a + b`). The rooms are "
        + "; ".join(f"{room}: {', '.join(f'`{p}`' for p in places)}" for room, places in ROOMS.items())
        + ".",
        "## Survivors",
        *(_listed(row) for row in sorted(survivors, key=lambda row: row["key"])),
        "## Equivalent, judged by hand",
        *(f"{_listed(row)}\n    {equivalent[identity(row)]}" for row in sorted(same, key=lambda row: row["key"])),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts).replace("\n\n- ", "\n- ") + "\n"


def _listed(row: Row) -> str:
    """Return a mutant as an item of a list."""
    change = f"`{row['before']}` -> `{row['after']}`" if row["before"] else f"{row['operator']}"
    return f"- `{row['file']}`, {row['scope'] or 'module'}: {change}"


def write_mutation_page(rows: Sequence[Row], args: dict[str, Any], facts: dict[str, Any]) -> None:
    """Write page and data."""
    kept = ("room", "file", "line", "scope", "operator", "before", "after", "outcome", "by")
    data = {"sample": args["sample"], "seed": args["seed"], "machine": facts}
    write_data(NAME, {**data, "mutants": [{name: row.get(name) for name in kept} for row in rows]})
    write_page(NAME, mutation_page(rows, args, facts))
