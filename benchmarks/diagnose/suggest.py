"""Suggested recordings: does one of them resolve the group that a diagnosis ends in?

python -m benchmarks.diagnose.suggest                      # every data set that is not done yet, then the page
python -m benchmarks.diagnose.suggest --rigs pendulum drop # some of them
python -m benchmarks.diagnose.suggest --jobs 48 --limit 540  # many at a time, until 540 s are over; again to go on
python -m benchmarks.diagnose.suggest --list               # their names
python -m benchmarks.diagnose.suggest --report             # the page from what is done

Each data set (`suggest_sets`) is diagnosed. Where that ends in a group that the hidden effect is in, motions are chosen
by each method: the best of menu and search ("best"), the menu alone ("menu"), and a random trajectory ("random"), all
of the same longest duration and within the same limits. Reality performs each with the same hidden effect, and both
recordings are diagnosed together.

The stages of a data set (`suggest_stages`) run in processes of their own, one core each; the order is random with a
fixed seed, so that what is done when the time is up is no choice by result. Each result is kept in `--out` as soon as
it exists; the same command goes on from there, and from the pieces of what was interrupted. What was begun and has not
ended is counted as a time-out.
"""

from __future__ import annotations

import json
import os
import random
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from benchmarks.diagnose.suggest_pool import run_all
from benchmarks.diagnose.suggest_report import write_report
from benchmarks.diagnose.suggest_sets import SEEDS, SuggestSet, suggest_sets
from benchmarks.diagnose.suggest_stages import rows_of, run_task
from concent_warp.files import write_text

OUT = Path("runs/suggest")


@dataclass(frozen=True)
class Args:
    """Command line."""

    rigs: tuple[str, ...] = ()
    """Rigs; all by default."""
    names: tuple[str, ...] = ()
    """Only data sets of these names."""
    seeds: int = SEEDS
    """Seeds of each data set."""
    jobs: int = len(os.sched_getaffinity(0))
    """Stages at a time, each in a process of one core."""
    limit: float = float("inf")
    """Time after which nothing is begun, and what runs is stopped [s]."""
    out: Path = OUT
    """Where results lie, in a folder for each data set."""
    pieces: Path | None = None
    """Where pieces of what is not done lie, from which it goes on; `--out` with "_pieces" by default."""
    list: bool = False
    """Print the names of the data sets."""
    report: bool = False
    """Write the page from what is done."""


def main(args: Args) -> None:
    """Study what is not done yet, and write the page where all was asked for."""
    sets = suggest_sets()
    chosen = [s for s in sets if _wanted(s, args)]
    if args.list:
        print("\n".join(s.name for s in chosen))
        return
    args.out.mkdir(parents=True, exist_ok=True)
    whole = True
    if not args.report:
        random.Random(0).shuffle(chosen)
        chosen.sort(key=lambda s: s.repeat)  # all data sets once, then again on other seeds
        pieces = args.pieces or args.out.with_name(f"{args.out.name}_pieces")
        work = partial(run_task, pieces=pieces)
        whole = run_all(chosen, args.out, max(args.jobs, 1), args.limit, lambda text: print(text, flush=True), work)
        rows = rows_of(sets, args.out)
        write_text(args.out / "rows.jsonl", "".join(json.dumps(row) + "\n" for row in rows))
        print("\n".join(_line(row) for row in rows))
    if args.report or (whole and not (args.rigs or args.names or args.seeds < SEEDS)):
        write_report(rows_of(sets, args.out), len(sets))


def _wanted(one: SuggestSet, args: Args) -> bool:
    """Return whether a data set was asked for."""
    rigs, names = args.rigs or (one.base.rig,), args.names or (one.name,)
    return one.repeat < args.seeds and one.base.rig in rigs and one.name in names


def _line(row: Mapping[str, Any]) -> str:
    """Return a row in one line."""
    if "error" in row:
        return f"{row['name']:52s} ERROR {row['error'].strip().splitlines()[-1][:80]}"
    groups = " then ".join("|".join(group) for group in row["first"]["groups"]) or "-"
    text = f"{row['name']:52s} {row['first']['verdict']:13s} {groups}"
    said = [f"{method} {found['outcome']}" for method, found in row["methods"].items()]
    return f"{text}  {', '.join(said)}  {row['seconds']:.0f} s"


if __name__ == "__main__":
    main(tyro.cli(Args))
