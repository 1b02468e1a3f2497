"""Time of a diagnosis, all candidates and the calibration included, and how it grows.

    python -m benchmarks.diagnose.speed                    # every case that there is, then the page
    python -m benchmarks.diagnose.speed --parts scenes     # some of them; the page keeps the other figures
    python -m benchmarks.diagnose.speed --table            # the page again, from the figures

Each diagnosis runs in this process and in `--jobs` of its workers, with the default settings, on recordings of
Reality that hide one effect. Figures of several machines stand side by side, under `--host`.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from typing import Any, Literal

import tyro

from benchmarks.diagnose.hidden_effects_data import cases, make
from benchmarks.pages import machine, machine_line, read_data, table, write_data, write_page
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Recording

NAME = "diagnose_speed"
Part = Literal["scenes", "candidates", "length"]
SCENES = {
    "pendulum-joint_friction-middle-0": 60,
    "push-mass-middle-2": 60,
    "drop-air_drag-middle-0": 60,
    "arm-joint_friction-middle-2": 480,
    "insertion-joint_friction-middle-2": 480,
}
"""Data sets and their time limits on two cores [s]."""
GROWING = "pendulum-joint_friction-middle-0"
COUNTS = (2, 4, 8, 16, 0)
"""Candidates; 0 is all."""
LENGTHS = (2.5, 5.0, 10.0)
"""Lengths of a demonstration [s]."""
SHIFT = 300
"""Added to the seeds, so that the data are those of no other page."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    parts: tuple[Part, ...] = ("scenes", "candidates", "length")
    names: tuple[str, ...] = tuple(SCENES)
    """Data sets of the first part."""
    jobs: int = len(os.sched_getaffinity(0))
    """Processes."""
    host: str = "2 cores"
    """Heading of the figures."""
    remark: str = ""
    """Remark on the figures; kept until it is replaced."""
    table: bool = False
    """Write the page from the stored figures."""


def main(args: Args) -> None:
    """Measure, and write data and page."""
    if not args.table:
        for part in args.parts:
            for row in {"scenes": scenes, "candidates": by_candidates, "length": by_length}[part](args):
                keep(args.host, part, row)
    if args.remark:
        data = read_data(NAME)
        data[args.host]["remark"] = args.remark
        write_data(NAME, data)
    write_report(read_data(NAME))


def keep(host: str, part: Part, row: dict[str, Any]) -> None:
    """Put a row into the data, in place of an older one of the same key."""
    data = read_data(NAME)
    mine = data.setdefault(host, {"machine": machine()})
    mine["machine"] = machine()
    mine[part] = [old for old in mine.get(part, []) if old["key"] != row["key"]] + [row]
    write_data(NAME, data)
    print(host, part, row, flush=True)


def scenes(args: Args) -> Any:
    """Yield how long the diagnosis of each scene takes."""
    for name in args.names:
        recording, model = data_of(name)
        yield timed(name, model, recording, DiagnoseCfg(jobs=args.jobs, explain=False))


def by_candidates(args: Args) -> Any:
    """Yield how long it takes with some candidates only, the right one among them."""
    recording, model = data_of(GROWING)
    channels = {c for d in recording.demonstrations for c in d.measured}
    names = list(dict.fromkeys(e.name for e in candidates(model, channels, ())))
    names.sort(key=lambda n: n != "joint_friction")
    for count in COUNTS:
        chosen = tuple(names[:count]) if count else tuple(names)
        row = timed(GROWING, model, recording, DiagnoseCfg(jobs=args.jobs, explain=False, effects=chosen))
        yield {**row, "key": f"{len(chosen)}", "candidates": len(chosen)}


def by_length(args: Args) -> Any:
    """Yield how long it takes for the first seconds of a recording."""
    recording, model = data_of(GROWING)
    for seconds in LENGTHS:
        row = timed(GROWING, model, first(recording, seconds), DiagnoseCfg(jobs=args.jobs, explain=False))
        yield {**row, "key": f"{seconds:g}"}


def data_of(name: str) -> tuple[Recording, Model]:
    """Return a recording and the model as drawn."""
    case = next(c for c in cases() if c.name == name)
    data = make(replace(case, seed=case.seed + SHIFT))
    return data.recording, Model(data.scene)


def timed(key: str, model: Model, recording: Recording, cfg: DiagnoseCfg) -> dict[str, Any]:
    """Return how long a diagnosis takes, and its verdict."""
    begin = time.perf_counter()
    found = diagnose(model, recording, cfg)
    return {
        "key": key,
        "seconds": time.perf_counter() - begin,
        "recorded": sum(d.duration for d in recording.demonstrations),
        "jobs": cfg.jobs,
        "verdict": found.verdict,
        "accepted": [e.name for e in found.effects if e.accepted],
    }


def first(recording: Recording, seconds: float) -> Recording:
    """Return the beginning of each demonstration."""

    def cut(c: Channel) -> Channel:
        keep = c.time <= seconds
        return replace(c, time=c.time[keep], value=c.value[keep])

    def shorter(channels: Any) -> dict[str, Channel]:
        return {name: cut(c) for name, c in channels.items()}

    return replace(
        recording,
        demonstrations=tuple(
            replace(d, action=shorter(d.action), measured=shorter(d.measured)) for d in recording.demonstrations
        ),
    )


def write_report(data: dict[str, Any]) -> None:
    """Write the page."""
    lines = [
        "# Time of a diagnosis",
        "",
        "`python -m benchmarks.diagnose.speed`: wall time of `concent diagnose` with default settings on recordings of",
        "Reality that hide one effect: screening, fits, null distribution and intervals. The search for missing forces",
        "(`explain`) is left out; it takes at most as long again, and at most a minute. Other scenes scale with the",
        "number of candidates, the length of the recording and the contacts in it. Other jobs ran on some",
        "of the hosts.",
    ]
    for host, found in data.items():
        lines += ["", f"## {host}", "", machine_line(found["machine"]), ""]
        lines += [found["remark"], ""] if "remark" in found else []
        if "scenes" in found:
            rows = [
                [
                    f"`{r['key']}`",
                    f"{r['recorded']:.1f}",
                    str(r["jobs"]),
                    f"{r['seconds']:.0f}",
                    f"{r['verdict']}: {', '.join(r['accepted']) or '-'}",
                ]
                for r in found["scenes"]
            ]
            lines += [table(["data", "recorded [s]", "processes", "time [s]", "verdict"], rows)]
        for part, head in (("candidates", "candidates"), ("length", "length [s]")):
            if part in found:
                lines += [f"`{GROWING}`, by {head.split()[0]}:", ""]
                rows = [[r["key"], f"{r['seconds']:.0f}"] for r in sorted(found[part], key=lambda r: float(r["key"]))]
                lines += [table([head, "time [s]"], rows)]
    write_page(NAME, "\n".join(lines))


if __name__ == "__main__":
    main(tyro.cli(Args))
