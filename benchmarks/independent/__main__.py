"""Diagnoses the data sets of the independent worlds and writes the page.

python -m benchmarks.independent                                  # development sets that are not done, the page
python -m benchmarks.independent --kinds null --rigs drop         # some of them
python -m benchmarks.independent --locked --out runs/locked       # the locked sets, once, at the end
python -m benchmarks.independent --recordings FOLDER              # of recordings that were made elsewhere
python -m benchmarks.independent --report                         # the page from what is done
python -m benchmarks.independent --report --earlier OTHER/results.jsonl --locked-results LOCKED/results.jsonl
python -m benchmarks.independent.visible NAME                     # by how much the hidden effect of a set shows at all

Each set is diagnosed by `--cores` processes of its own, `--jobs` sets at a time, within `--limit` seconds. Results are
kept in `--out`, one file a set and `results.jsonl` with all, so that the command may be stopped and called again.
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
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.independent.data_set import KINDS, DataSet, Kind, World
from benchmarks.independent.kept_data import is_kept
from benchmarks.independent.page import read_results, write_page_from
from benchmarks.independent.scoring import line
from benchmarks.independent.split import locked_names
from benchmarks.independent.study import CORES, SECONDS, described, path
from benchmarks.independent.worlds import all_sets
from benchmarks.pages import ROOT, machine, machine_line
from concent_warp.files import write_text

OUT = Path("runs/independent")
EXPECTED_SECONDS = {"pendulum": 60.0, "arm": 250.0, "slide": 120.0, "spin": 120.0, "push": 250.0, "drop": 90.0}
"""First guess of the time of a set by rig [s], until sets of the rig are done; of other rigs that of the push."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    kinds: tuple[Kind, ...] = KINDS
    rigs: tuple[str, ...] = ()
    """Rigs; all by default."""
    world: World | None = None
    """One of the worlds; all by default."""
    names: tuple[str, ...] = ()
    """Only data sets of these names."""
    locked: bool = False
    """Diagnose the locked sets, and no others."""
    jobs: int = max(len(os.sched_getaffinity(0)) // CORES, 1)
    """Data sets at a time."""
    cores: int = CORES
    """Processes of a diagnosis."""
    limit: float = SECONDS
    """Duration of a diagnosis from which on it counts as wrong [s]."""
    out: Path = OUT
    """Folder of the results."""
    recordings: Path | None = None
    """Folder of data sets that `benchmarks.independent.data_sets --save` wrote; what it lacks is made here."""
    report: bool = False
    """Write the page from what is done, and diagnose nothing."""
    earlier: Path | None = None
    """Results of an earlier state of the method, shown beside."""
    locked_results: Path | None = None
    """Results of the locked sets, where they lie in another folder."""
    host: str = ""
    """The machine of the results in words, where it is not this one."""


def main(args: Args) -> None:
    """Diagnose what is not done yet, and write the page where all was asked for."""
    every = all_sets()
    check(args, every)
    args.out.mkdir(parents=True, exist_ok=True)
    chosen = [c for c in every if wanted(c, args)]
    if not chosen:
        raise SystemExit(
            "independent benchmark: no data set is of all that was asked for; locked ones are diagnosed with --locked"
            " only"
        )
    if not args.report:
        run(chosen, args)
    merge(args.out, every)
    if args.report or not (args.rigs or args.names or args.world or args.locked or len(args.kinds) < len(KINDS)):
        rows = read_results(args.out / "results.jsonl")
        if args.locked_results is not None:
            rows += read_results(args.locked_results)
        earlier = [] if args.earlier is None else read_results(args.earlier)
        write_page_from(rows, earlier, every, args.host or machine_line(machine()))


def check(args: Args, every: Sequence[DataSet]) -> None:
    """End with a sentence where the command line asks for what there is not."""
    for option, asked, known in (
        ("--names", args.names, {c.name for c in every}),
        ("--rigs", args.rigs, {c.rig for c in every}),
    ):
        if unknown := sorted(set(asked) - known):
            wrong = ", ".join(unknown)
            raise SystemExit(
                f"independent benchmark: {option} has no {wrong}; python -m benchmarks.independent.data_sets --list"
                " prints all"
            )
    for option, number in (("--jobs", args.jobs), ("--cores", args.cores), ("--limit", args.limit)):
        if not 0 < number < float("inf"):
            raise SystemExit(f"independent benchmark: {option} must be a positive number; found {number:g}")
    if args.recordings is not None and not args.recordings.is_dir():
        raise SystemExit(
            f"independent benchmark: --recordings {args.recordings}: no such folder; write one by python -m"
            " benchmarks.independent.data_sets --save FOLDER"
        )
    for option, file in (("--earlier", args.earlier), ("--locked-results", args.locked_results)):
        if file is not None and not file.is_file():
            raise SystemExit(f"independent benchmark: {option} {file}: no such file; give the results.jsonl of a run")


def wanted(case: DataSet, args: Args) -> bool:
    """Return whether a data set was asked for."""
    return (
        (case.name in locked_names()) == args.locked
        and case.kind in args.kinds
        and (not args.rigs or case.rig in args.rigs)
        and args.world in (None, case.world)
        and (not args.names or case.name in args.names)
    )


def run(chosen: Sequence[DataSet], args: Args) -> None:
    """Diagnose what is not done yet."""
    pending = [c for c in chosen if not path(args.out, c.name).is_file()]
    for world, module, package in (("drake", "pydrake", "drake"), ("bullet", "pybullet", "pybullet")):
        if any(c.world == world and not is_kept(c, args.recordings) for c in pending) and find_spec(module) is None:
            raise SystemExit(
                f"independent benchmark: the world on {world.capitalize()} needs the package {package}, which is not"
                " installed; install the extra concent-warp[benchmarks], leave that world out with --world mujoco, or"
                " give --recordings made where it is"
            )
    random.Random(0).shuffle(pending)  # what is done when it is stopped is a fair part of the whole
    done: dict[str, list[float]] = {}
    commit, begun = revision(), time.monotonic()
    with ThreadPoolExecutor(max(args.jobs, 1)) as pool:
        futures = {pool.submit(in_process, case, args, commit): case for case in pending}
        left = list(pending)
        for k, future in enumerate(as_completed(futures)):
            case, (result, seconds) = futures[future], future.result()
            left.remove(case)
            done.setdefault(case.rig, []).append(seconds)
            minutes = remaining(left, done, args.jobs) / 60
            spent = (time.monotonic() - begun) / 60
            print(f"{k + 1:3d}/{len(pending)} {line(result)}  ({spent:.0f} min, {minutes:.0f} left)", flush=True)


def remaining(left: Sequence[DataSet], done: dict[str, list[float]], jobs: int) -> float:
    """Return the expected time for the sets that are left [s], from those of their rig that are done."""
    guesses = {rig: EXPECTED_SECONDS.get(rig, EXPECTED_SECONDS["push"]) for rig in {c.rig for c in left} | set(done)}
    seen = [s / guesses[rig] for rig, of in done.items() for s in of]
    factor = float(np.mean(seen)) if seen else 1.0
    each = [float(np.mean(done[c.rig])) if c.rig in done else factor * guesses[c.rig] for c in left]
    return max(sum(each) / max(jobs, 1), max(each, default=0.0))


def in_process(case: DataSet, args: Args, commit: str) -> tuple[dict[str, Any], float]:
    """Return the result of one set, diagnosed by a process of its own, and the time that all took [s]."""
    begun = time.monotonic()
    command = [sys.executable, "-m", "benchmarks.independent.study", case.name, str(args.out), "--commit", commit]
    command += ["--limit", str(args.limit), "--cores", str(args.cores)]
    command += [] if args.recordings is None else ["--recordings", str(args.recordings)]
    places = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    said = ""
    try:
        ended = subprocess.run(
            command, env=os.environ | threads | {"PYTHONPATH": places}, capture_output=True, text=True,
            timeout=2 * args.limit + 600, check=False,
        )  # fmt: skip
        said = f"ended with {ended.returncode}: {ended.stderr.strip()[-1000:]}"
    except subprocess.TimeoutExpired:
        said = "time-out"
    where = path(args.out, case.name)
    if not where.is_file():
        lost = described(case) | {"truth": [], "error": said, "seconds": time.monotonic() - begun, "commit": commit}
        write_text(where, json.dumps(lost) + "\n")
    return json.loads(where.read_text()), time.monotonic() - begun


def merge(out: Path, every: Sequence[DataSet]) -> None:
    """Write the results of all sets that are done into one file, a line each."""
    found = [path(out, c.name) for c in every]
    lines = [json.dumps(json.loads(p.read_text())) for p in found if p.is_file()]
    write_text(out / "results.jsonl", "".join(f"{one}\n" for one in lines))


def revision() -> str:
    """Return the revision of this checkout, empty where there is none."""
    command = ["git", "-C", str(ROOT), "rev-parse", "--short=12", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


if __name__ == "__main__":
    main(tyro.cli(Args))
