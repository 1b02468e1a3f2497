"""Suggested recordings: does one of them resolve the group that a diagnosis ends in?

python -m benchmarks.diagnose.suggest                      # every data set that is not done yet, then the page
python -m benchmarks.diagnose.suggest --rigs pendulum drop # some of them
python -m benchmarks.diagnose.suggest --list               # their names
python -m benchmarks.diagnose.suggest --report             # the page from what is done

Each data set (`suggest_sets`) is diagnosed. Where that ends in a group that the hidden effect is in, motions are chosen
by each method: the best of menu and search ("best"), the menu alone ("menu"), and a random trajectory ("random"), all
of the same longest duration and within the same limits. Reality performs each with the same hidden effect, and both
recordings are diagnosed together. One line of `--out`/rows.jsonl for each data set; what is done is not done again, and
the pieces of interrupted diagnoses are kept.
"""

from __future__ import annotations

import json
import os
import random
import time
import traceback
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.diagnose.suggest_report import METHODS, read_rows, write_report
from benchmarks.diagnose.suggest_sets import (
    SuggestSet,
    first_recording,
    open_group,
    outcome,
    second_recording,
    suggest_sets,
)
from benchmarks.pages import machine
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.diagnosis.suggestion.cfg import Method, SuggestCfg
from concent_warp.diagnosis.suggestion.suggest import suggest
from concent_warp.errors import ConcentError
from concent_warp.model import Model
from concent_warp.recording.merge import merged
from concent_warp.recording.recording import Recording
from concent_warp.simulate.parallel import limit_simulations

OUT = Path("runs/suggest")


@dataclass(frozen=True)
class Args:
    """Command line."""

    rigs: tuple[str, ...] = ()
    """Rigs; all by default."""
    names: tuple[str, ...] = ()
    """Only data sets of these names."""
    jobs: int = len(os.sched_getaffinity(0))
    """Data sets at a time, each in a process of one core."""
    out: Path = OUT
    """Where results and pieces lie."""
    list: bool = False
    """Print the names of the data sets."""
    report: bool = False
    """Write the page from what is done."""


def main(args: Args) -> None:
    """Study what is not done yet, and write the page where all was asked for."""
    chosen = [s for s in suggest_sets() if _wanted(s, args)]
    if args.list:
        print("\n".join(s.name for s in chosen))
        return
    args.out.mkdir(parents=True, exist_ok=True)
    rows = args.out / "rows.jsonl"
    if not args.report:
        done = {row["name"] for row in read_rows(rows) if "error" not in row}
        pending = [s for s in chosen if s.name not in done]
        random.Random(0).shuffle(pending)  # so that what is done when it is stopped is a fair part of the whole
        begun = time.monotonic()
        with ProcessPoolExecutor(max(args.jobs, 1)) as pool:
            futures = [pool.submit(study, s, args.out) for s in pending]
            for k, future in enumerate(as_completed(futures)):
                row = future.result()
                with rows.open("a", encoding="utf-8") as file:
                    # The newline comes first too: the last line may have been cut off.
                    file.write("\n" + json.dumps(row) + "\n")
                left = (time.monotonic() - begun) * (len(pending) - k - 1) / (k + 1)
                print(f"{k + 1:3d}/{len(pending)}  {_line(row)}  ({left / 60:.0f} min left)", flush=True)
    if args.report or not (args.rigs or args.names):
        write_report(read_rows(rows), len(suggest_sets()))


def _wanted(one: SuggestSet, args: Args) -> bool:
    """Return whether a data set was asked for."""
    return (not args.rigs or one.base.rig in args.rigs) and (not args.names or one.name in args.names)


def study(one: SuggestSet, out: Path, methods: Sequence[Method] = METHODS) -> dict[str, Any]:
    """Return the row of one data set."""
    row: dict[str, Any] = {
        "name": one.name,
        "rig": one.base.rig,
        "truth": sorted(one.base.magnitudes),
        "seed": one.base.seed,
        "machine": machine(),
    }
    begun = time.perf_counter()
    try:
        with limit_simulations(1):
            row |= _studied(one, out / "pieces" / one.name, methods)
    except ConcentError as error:
        row["error"] = str(error)
    except Exception:
        row["error"] = traceback.format_exc()
    row["seconds"] = time.perf_counter() - begun
    return row


def _studied(one: SuggestSet, folder: Path, methods: Sequence[Method]) -> dict[str, Any]:
    """Return the first diagnosis of a data set and, where it ends in a group, what each method came to."""
    recording, scene = first_recording(one)
    model = Model(scene)
    first, seconds = _diagnosed(model, recording, one.base.seed, folder)
    found: dict[str, Any] = {"first": _told(first, seconds), "group": None, "methods": {}}
    asked = open_group(first.groups, list(one.base.magnitudes)) if first.verdict == "group" else None
    if asked is None:
        return found
    found["group"], found["true"] = asked
    for method in methods:
        begun = time.perf_counter()
        try:
            cfg = SuggestCfg(method=method, seed=one.base.seed)
            suggestion = suggest(model, recording, cfg, diagnosis=first, state=folder / method)
            result: dict[str, Any] = {**suggestion.to_json(), "seconds": time.perf_counter() - begun, "outcome": "none"}
            if suggestion.recording is not None:
                both = merged([recording, second_recording(one, suggestion.recording)])
                second, seconds = _diagnosed(model, both, one.base.seed, folder)
                result["second"] = _told(second, seconds)
                result["outcome"] = outcome(second.groups, *asked)
        except Exception as error:
            result = {"outcome": "error", "error": f"{type(error).__name__}: {error}"}
        found["methods"][method] = result
    return found


def _diagnosed(model: Model, recording: Recording, seed: int, folder: Path) -> tuple[Diagnosis, float]:
    """Return a diagnosis and the time that it took [s]."""
    begun = time.perf_counter()
    cfg = DiagnoseCfg(jobs=1, seed=seed, explain=False)
    return diagnose(model, recording, cfg, out=folder), time.perf_counter() - begun


def _told(found: Diagnosis, seconds: float) -> dict[str, Any]:
    """Return what counts of a diagnosis."""
    return {
        "verdict": found.verdict,
        "groups": [list(group) for group in found.groups],
        "ratio": [float(r) for r in found.ratio],
        "seconds": seconds,
    }


def _line(row: dict[str, Any]) -> str:
    """Return a row in one line."""
    if "error" in row:
        return f"{row['name']:52s} ERROR {row['error'].strip().splitlines()[-1][:80]}"
    groups = " then ".join("|".join(group) for group in row["first"]["groups"]) or "-"
    text = f"{row['name']:52s} {row['first']['verdict']:13s} {groups}"
    said = [f"{method} {found['outcome']}" for method, found in row["methods"].items()]
    return f"{text}  {', '.join(said)}  {row['seconds']:.0f} s"


if __name__ == "__main__":
    main(tyro.cli(Args))
