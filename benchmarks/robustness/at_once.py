"""Two of each writing command at once in one place: one succeeds, the other says so in one sentence.

    python -m benchmarks.robustness.at_once            # about 10 minutes
    python -m benchmarks.robustness.at_once --table    # the page from the stored results

Both are started at the same time with the same results to write: where nothing is yet, and then with --overwrite where
the results are. The second of two that do not overlap finds the results, or replaces them.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.measurements import Measurements
from benchmarks.pages import ROOT, machine
from benchmarks.robustness.commands import WRITING, Ended, Writing, ended, launch, prepare
from benchmarks.robustness.contents import files, unfinished, unreadable
from benchmarks.robustness.page import store

REFUSALS = ("another command is writing to this", "the file exists", "the folder exists", "the folder holds a run")
"""What the second command says, where both overlap and where they do not."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    rows: Path = ROOT / "runs" / "robustness" / "at_once.jsonl"
    """File of the measurements, from which an interrupted run goes on."""
    inputs: Path = ROOT / "runs" / "robustness" / "inputs"
    """Folder of the commands' inputs, kept for the next run; to be deleted where formats of files have changed."""
    only: tuple[str, ...] = ()
    """Commands; all by default."""
    table: bool = False
    """Write the page from the stored results, without runs."""


def both(words: list[str], folder: Path) -> list[Ended]:
    """Return how two commands ended that were started at the same time."""
    begun = time.monotonic()
    processes = [(launch(words, folder, name), name) for name in ("first", "second")]
    return [ended(process, folder, name, begun) for process, name in processes]


def measure(writing: Writing, inputs: Path) -> dict[str, Any]:
    """Return how two of a command came out, without results and with --overwrite."""
    with tempfile.TemporaryDirectory() as name:
        folder, out = Path(name), Path(name) / "out"
        out.mkdir()
        words = writing.words(inputs, out)
        new = judged(both(words, folder), out)
        names = set(files(out))
        again = judged(both([*words, "--overwrite"], folder), out, replacing=True)
        if again["succeeded"] and set(files(out)) != names and not any("tfevents" in name for name in names):
            again["faults"].append(f"other files: {sorted(names ^ set(files(out)))}")
        return {"new": new, "overwrite": again}


def judged(found: list[Ended], out: Path, *, replacing: bool = False) -> dict[str, Any]:
    """Return how many commands succeeded, and what is wrong with how the other ended and with what they left."""
    succeeded = sum(one.code == 0 for one in found)
    faults = [f"{succeeded} succeeded"] * (succeeded != 1 and not (replacing and succeeded == 2))
    refusals = []
    for one in found:
        errors = [line for line in one.said if ": warning: " not in line]
        if one.code:
            refusals += errors
            faults += [f"status {one.code}"] * (one.code != 2)
            faults += [f"{len(errors)} sentences"] * (len(errors) != 1)
            faults += [f"said: {line}" for line in errors if not any(words in line for words in REFUSALS)]
            faults += ["no path in the sentence"] * (not any(str(out) in line for line in errors))
    faults += [f"unreadable: {name}" for name in unreadable(out)]
    faults += [f"part left: {name}" for name in unfinished(out)]
    said = [line.replace(str(out), "OUT") for line in refusals]
    return {"succeeded": succeeded, "said": said, "faults": faults}


def main(args: Args) -> None:
    """Measure what is missing, and write data and page."""
    if args.table:
        store("at once", None)
        return
    rows = Measurements(args.rows)
    wanted = [each for each in WRITING if not args.only or each.name in args.only]
    prepare(args.inputs)
    for k, writing in enumerate(wanted):
        if rows.wanted(writing.name):
            print(f"{k + 1} of {len(wanted)}: {writing.name}", flush=True)
            rows.add(writing.name, measure(writing, args.inputs))
    if not args.only:
        store("at once", {"machine": machine(), "commands": {w.name: rows.rows[w.name] for w in WRITING}})


if __name__ == "__main__":
    main(tyro.cli(Args))
