"""Diagnoses of data with a hidden effect: is the right one named, how sure, and does its error fall to the noise?

python -m benchmarks.diagnose.hidden_effects  # every data set that is not done yet, then the page
python -m benchmarks.diagnose.hidden_effects --kinds null --rigs drop # some of them
python -m benchmarks.diagnose.hidden_effects --report                 # the page from what is done
python -m benchmarks.diagnose.hidden_effects --out D --shift 6000  # other seeds; then --out D --report --again

Each data set is diagnosed in a process of its own, as many at a time as `--jobs`. What is done is kept in `--out`, one
file a data set, and pieces of those under way, so that the command may be stopped and called again. The data are those
of `hidden_effects_data.py`.
"""

from __future__ import annotations

import json
import os
import random
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from benchmarks.diagnose.hidden_effects_data import DataSet, Kind, cases, make
from benchmarks.diagnose.hidden_effects_report import NAME, write_again, write_kept, write_report
from benchmarks.pages import machine, machine_line, read_data
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.errors import ConcentError
from concent_warp.files import write_text
from concent_warp.model import Model

OUT = Path("runs/hidden_effects")
SHIFT = 4000
"""Of the seeds of the page."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    kinds: tuple[Kind, ...] = ("null", "single", "outside", "pair")
    rigs: tuple[str, ...] = ()
    """Rigs; all by default."""
    effects: tuple[str, ...] = ()
    """Only data sets that hide one of these."""
    names: tuple[str, ...] = ()
    """Only data sets of these names."""
    shift: int = SHIFT
    """Added to every seed. Another than the page's makes other data of the same kind, for work on the method, which
    must not see the page's."""
    jobs: int = len(os.sched_getaffinity(0))
    """Data sets at a time."""
    each: int = 1
    """Processes of each diagnosis."""
    out: Path = OUT
    """Where the results lie."""
    report: bool = False
    """Write the page from what is done, and diagnose nothing."""
    again: bool = False
    """With --report: take what is done for a run on other seeds, which the page shows besides."""
    host: str = ""
    """Where the results come from, in words, if not from this machine."""


def main(args: Args) -> None:
    """Diagnose what is not done yet, and write the page where all was asked for."""
    args.out.mkdir(parents=True, exist_ok=True)
    chosen = [c for c in cases() if wanted(c, args)]
    if not args.report:
        pending = [replace(c, seed=c.seed + args.shift) for c in chosen if not path(args.out, c).is_file()]
        random.Random(0).shuffle(pending)  # so that what is done when it is stopped is a fair part of the whole
        begun = time.monotonic()
        with ProcessPoolExecutor(max(args.jobs, 1)) as pool:
            futures = {pool.submit(study, case, args.out, args.each): case for case in pending}
            for k, future in enumerate(as_completed(futures)):
                result = future.result()
                left = (time.monotonic() - begun) * (len(pending) - k - 1) / (k + 1)
                print(f"{k + 1:3d}/{len(pending)}  {line(result)}  ({left / 60:.0f} min left)", flush=True)
    rows = [json.loads(path(args.out, c).read_text()) for c in chosen if path(args.out, c).is_file()]
    if args.report and not rows:
        write_kept(read_data(NAME), len(cases()))
    elif args.report or not (args.rigs or args.effects or args.names or args.shift != SHIFT or len(args.kinds) < 4):
        write = write_again if args.again else write_report
        write(rows, len(cases()), args.host or machine_line(machine()))


def wanted(case: DataSet, args: Args) -> bool:
    """Return whether a data set was asked for."""
    return (
        case.kind in args.kinds
        and (not args.rigs or case.rig in args.rigs)
        and (not args.effects or bool(set(case.magnitudes) & set(args.effects)))
        and (not args.names or case.name in args.names)
    )


def path(out: Path, case: DataSet) -> Path:
    """Return where the result of a data set lies."""
    return out / f"{case.name}.json"


def study(case: DataSet, out: Path, jobs: int = 1) -> dict[str, Any]:
    """Diagnose one data set and keep the result."""
    data = make(case)
    result: dict[str, Any] = {
        "name": case.name,
        "kind": case.kind,
        "rig": case.rig,
        "size": case.size,
        "seed": case.seed,
        "demonstrations": len(data.recording.demonstrations),
        "truth": [
            {"name": t.effect, "parameters": dict(t.parameters), "target": list(t.target), "known": t.known}
            for t in data.truth
        ],
    }
    begun = time.perf_counter()
    try:
        cfg = DiagnoseCfg(jobs=jobs, seed=case.seed, explain=False)
        found = diagnose(Model(data.scene), data.recording, cfg, out=out / "pieces" / case.name)
        result |= found.to_json()
    except ConcentError as error:
        result |= {"error": str(error)}
    except Exception:
        result |= {"error": traceback.format_exc()}
    result["seconds"] = time.perf_counter() - begun
    write_text(path(out, case), json.dumps(result, indent=1))
    return result


def line(result: dict[str, Any]) -> str:
    """Return a result in one line."""
    truth = " + ".join(t["name"] for t in result["truth"]) or "nothing"
    if "error" in result:
        return f"{result['name']:48s} {truth:30s} ERROR {result['error'].strip().splitlines()[-1][:80]}"
    groups = " then ".join("|".join(group) for group in result["groups"]) or "-"
    ratio = "->".join(f"{r:.2f}" for r in result["ratio"])
    return f"{result['name']:48s} {result['verdict']:13s} {groups}  ratio {ratio}  {result['seconds']:.0f} s"


if __name__ == "__main__":
    main(tyro.cli(Args))
