"""Time by stage and peak memory of ``concent demo``, against their bounds.

    python -m benchmarks.fit.main_job              # as `make demo` runs it, into runs/main_job
    python -m benchmarks.fit.main_job --tests      # also the time of `make check`
    python -m benchmarks.fit.main_job --table      # the page from the stored results

The command runs in its own process on two cores. The ends of stages are the times at which their files are written.
Memory is the sum of the resident sets of the process and its children, sampled ten times a second; shared pages count
in each of them, so that it is an upper bound. A loaded or slower host takes longer.
"""

from __future__ import annotations

import json
import os
import resource
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.pages import ROOT, machine, machine_line, read_data, table, write_data, write_page

NAME = "main_job"
SECONDS, PROCESSOR_SECONDS, BYTES, TEST_SECONDS = 180, 240, 3 * 2**30, 720
"""Bounds on the time, processor time and memory of the main job, and on the time of all checks."""
PERIOD = 0.1
"""Sampling period of the memory [s]."""
STAGES = {
    "start": ("settings.toml",),
    "record": ("demo.h5",),
    "fit": ("history.json",),
    "events": ("events_*.json", "schedule_*.png"),
    "compare": ("comparison.json",),
    "report": ("report.html",),
}
"""Stages, each with the files that it ends by writing."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path = Path("runs") / NAME
    """Run folder of the main job; replaced."""
    cores: int = 2
    """Processor cores that it may use."""
    options: str = ""
    """Further options of `concent demo`, as in --options="--fit.generations 5"."""
    tests: bool = False
    """Also run `make check`."""
    table: bool = False
    """Write the page from the stored results, without runs."""


@dataclass(frozen=True)
class Run:
    """A process that came to its end."""

    code: int
    seconds: float
    processor: float
    """Processor time of the process and what it started [s]."""
    peak: int
    """Largest resident memory of the process and its descendants together [bytes]."""
    load: float
    """Mean number of other processes that wanted a core, by the load average at the end of the run."""


def tree(root: int) -> list[int]:
    """Return a process and all its descendants."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            children.setdefault(parent, []).append(int(entry.name))
    found = [root]
    for pid in found:
        found += children.get(pid, [])
    return found


def resident(pid: int) -> int:
    """Return the resident memory of a process [bytes], 0 where it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def processor_time() -> float:
    """Return the processor time of all processes that were waited for [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def watch(command: Sequence[str], cores: int) -> Run:
    """Run a command on some cores and watch its time and memory."""
    allowed = sorted(os.sched_getaffinity(0))[:cores]
    before = processor_time()
    begun = time.perf_counter()
    process = subprocess.Popen(command, cwd=ROOT, preexec_fn=lambda: os.sched_setaffinity(0, allowed))
    peak = 0
    while process.poll() is None:
        peak = max(peak, sum(map(resident, tree(process.pid))))
        time.sleep(PERIOD)
    seconds = time.perf_counter() - begun
    return Run(process.returncode, seconds, processor_time() - before, peak, os.getloadavg()[1])


def stages(folder: Path, begun: float, ended: float) -> dict[str, float]:
    """Return how long each stage took [s], by the times at which its files were last written.

    Args:
        folder: The run folder.
        begun: When the run began [s since the epoch].
        ended: When it ended.
    """
    found, last = {}, begun
    for stage, patterns in STAGES.items():
        end = max(path.stat().st_mtime for pattern in patterns for path in folder.glob(pattern))
        found[stage], last = end - last, end
    return {**found, "end": ended - last}


def measure(args: Args) -> dict[str, Any]:
    """Return the results."""
    folder = ROOT / args.out
    command = [
        sys.executable,
        "-m",
        "concent_warp",
        "demo",
        "--out",
        str(args.out),
        "--overwrite",
        *shlex.split(args.options),
    ]
    begun = time.time()
    run = watch(command, args.cores)
    ended = time.time()
    if run.code:
        raise SystemExit(f"concent demo ended with status {run.code}")
    comparison = json.loads((folder / "comparison.json").read_text())
    result = {
        "machine": {**machine(), "cores": args.cores},
        "options": args.options,
        "seconds": run.seconds,
        "processor_seconds": run.processor,
        "stages": stages(folder, begun, ended),
        "peak_bytes": run.peak,
        "load": run.load,
        "generations": len(json.loads((folder / "history.json").read_text())["generations"]),
        "contact_overlap": comparison["contact_overlap"],
        "headline": comparison["headline"],
        "report_bytes": (folder / "report.html").stat().st_size,
    }
    if args.tests:
        checks = watch(["make", "--no-print-directory", "check"], args.cores)
        result["checks"] = {"code": checks.code, "seconds": checks.seconds, "load": checks.load}
    return result


def judged(value: float, bound: float) -> str:
    """Return whether a value keeps to its bound."""
    return "kept" if value <= bound else "**not kept**"


def page(result: dict[str, Any]) -> str:
    """Return the page."""
    gib = result["peak_bytes"] / 2**30
    bounds = [
        ["time of the main job", f"{result['seconds']:.0f} s", f"{SECONDS} s", judged(result["seconds"], SECONDS)],
        [
            "processor time",
            f"{result['processor_seconds']:.0f} s",
            f"{PROCESSOR_SECONDS} s",
            judged(result["processor_seconds"], PROCESSOR_SECONDS),
        ],
        ["peak memory", f"{gib:.2f} GiB", f"{BYTES / 2**30:.0f} GiB", judged(result["peak_bytes"], BYTES)],
    ]
    if "checks" in result:
        checks = result["checks"]
        passed = judged(checks["seconds"], TEST_SECONDS) + ("" if checks["code"] == 0 else ", **checks failed**")
        bounds.append(["time of all checks", f"{checks['seconds']:.0f} s", f"{TEST_SECONDS} s", passed])
    rows = [[stage, f"{seconds:.1f}"] for stage, seconds in result["stages"].items()]
    options = f" with `{result['options']}`" if result["options"] else ""
    return f"""# Main job

{(__doc__ or "").split(chr(10) * 2, 2)[2].strip()}

`python -m benchmarks.fit.{NAME}`{options}. {machine_line(result["machine"])}
Load average at the end: {result["load"]:.1f}.

{table(["", "measured", "bound", ""], bounds)}
{result["generations"]} generations; a report of {result["report_bytes"] / 2**20:.1f} MiB.

{table(["stage", "seconds"], rows)}"""


def main(args: Args) -> None:
    """Measure and write data and page."""
    result = read_data(NAME) if args.table else measure(args)
    if not args.table:
        write_data(NAME, result)
    write_page(NAME, page(result))


if __name__ == "__main__":
    main(tyro.cli(Args))
