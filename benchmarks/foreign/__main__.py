"""Diagnoses logs of machines whose equations of motion are written here, and writes the page.

python -m benchmarks.foreign                              # development logs that are not done, the page
python -m benchmarks.foreign --machines crane hoist       # some of them
python -m benchmarks.foreign --locked --out runs/locked   # the locked machines, once, at the end
python -m benchmarks.foreign --list                       # what there is
python -m benchmarks.foreign --save FOLDER                # the logs as folders, and no diagnosis
python -m benchmarks.foreign --report --results A B       # the page from the results in some folders

Each log is diagnosed by `--cores` processes of its own, `--jobs` logs at a time, within `--limit` seconds. Results are
kept in `--out`, one file a log, so that the command may be stopped and called again.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.foreign.cases import all_cases, is_locked
from benchmarks.foreign.log import Case
from benchmarks.foreign.scoring import line, write
from benchmarks.foreign.study import CORES, SECONDS, described
from benchmarks.independent.__main__ import revision
from benchmarks.independent.study import path
from benchmarks.pages import ROOT, machine, machine_line
from concent_warp.files import write_text

OUT = Path("runs/foreign")


@dataclass(frozen=True)
class Args:
    """Command line."""

    machines: tuple[str, ...] = ()
    """Machines; all by default."""
    names: tuple[str, ...] = ()
    """Only logs of these names."""
    locked: bool = False
    """Diagnose the logs of locked machines, and no others."""
    jobs: int = max(len(os.sched_getaffinity(0)) // CORES, 1)
    """Logs at a time."""
    cores: int = CORES
    """Processes of a diagnosis."""
    limit: float = SECONDS
    """Duration of a diagnosis from which on it counts as wrong [s]."""
    out: Path = OUT
    """Folder of the results."""
    list: bool = False
    """Print the names, and diagnose nothing."""
    save: Path | None = None
    """Write the logs to this folder, and diagnose nothing."""
    report: bool = False
    """Write the page from what is done, and diagnose nothing."""
    results: tuple[Path, ...] = ()
    """Folders of results for the page; that of `out` by default."""
    host: str = ""
    """The machine of the results in words, where it is not this one."""


def main(args: Args) -> None:
    """Diagnose what is not done yet, and write the page where all was asked for."""
    check(args)
    chosen = [case for case in all_cases() if wanted(case, args)]
    if args.list:
        for case in chosen:
            print(f"{case.name:42s} {case.kind}")
        return
    if args.save is not None:
        for case in chosen:
            if not (args.save / case.name).exists():
                case.make().write(args.save / case.name)
        return
    if not args.report:
        args.out.mkdir(parents=True, exist_ok=True)
        run(chosen, args)
    if args.report or not (args.machines or args.names or args.locked):
        folders = args.results or (args.out,)
        places = [path(folder, case.name) for case in all_cases() for folder in folders]
        rows = [json.loads(place.read_text()) for place in places if place.is_file()]
        if not rows:
            raise SystemExit(f"foreign logs: no results in {', '.join(map(str, folders))}; run without --report first")
        write(rows, args.host or machine_line(machine()), len(all_cases()))


def check(args: Args) -> None:
    """End with a sentence where the command line asks for what there is not."""
    for option, asked, known in (
        ("--names", args.names, {case.name for case in all_cases()}),
        ("--machines", args.machines, {case.machine for case in all_cases()}),
    ):
        if unknown := sorted(set(asked) - known):
            raise SystemExit(
                f"foreign logs: {option} has no {', '.join(unknown)}; --list prints all, with --locked those"
            )
    for option, number in (("--jobs", args.jobs), ("--cores", args.cores), ("--limit", args.limit)):
        if not 0 < number < float("inf"):
            raise SystemExit(f"foreign logs: {option} must be a positive number; found {number:g}")


def wanted(case: Case, args: Args) -> bool:
    """Return whether a log was asked for."""
    asked = (not args.machines or case.machine in args.machines) and (not args.names or case.name in args.names)
    return asked and is_locked(case.machine) == args.locked


def run(chosen: Sequence[Case], args: Args) -> None:
    """Diagnose what is not done yet."""
    pending = [case for case in chosen if not path(args.out, case.name).is_file()]
    random.Random(0).shuffle(pending)  # what is done when it is stopped is a fair part of the whole
    commit, begun = revision(), time.monotonic()
    with ThreadPoolExecutor(args.jobs) as pool:
        futures = [pool.submit(in_process, case, args, commit) for case in pending]
        for k, future in enumerate(as_completed(futures), start=1):
            spent = (time.monotonic() - begun) / 60
            left = spent / k * (len(pending) - k)
            print(f"{k:3d}/{len(pending)} {line(future.result())}  ({spent:.0f} min, {left:.0f} left)", flush=True)


def in_process(case: Case, args: Args, commit: str) -> dict[str, Any]:
    """Return the result of one log, diagnosed by a process of its own."""
    begun, where = time.monotonic(), path(args.out, case.name)
    command = [sys.executable, "-m", "benchmarks.foreign.study", case.name, str(args.out), "--commit", commit]
    command += ["--limit", str(args.limit), "--cores", str(args.cores)]
    places = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    try:
        ended = subprocess.run(
            command, env=os.environ | threads | {"PYTHONPATH": places}, capture_output=True, text=True,
            timeout=2 * args.limit + 600, check=False,
        )  # fmt: skip
        error = f"ended with {ended.returncode}: {ended.stderr.strip()[-1000:]}"
    except subprocess.TimeoutExpired:
        error = "time-out"
    if not where.is_file():
        lost = described(case) | {"error": error, "noise_stated": False, "processor_seconds": 0.0, "commit": commit}
        write_text(where, json.dumps(lost | {"seconds": time.monotonic() - begun}) + "\n")
    return json.loads(where.read_text())


if __name__ == "__main__":
    main(tyro.cli(Args))
