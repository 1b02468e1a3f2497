"""Fits that are killed and resumed: same result, no partial file.

    python -m benchmarks.fit.resume            # about 5 minutes
    python -m benchmarks.fit.resume --table    # the page from the stored results

A small ``concent fit`` runs once without interruption. In each trial it is started again, killed with SIGKILL at a
random processor time, resumed, killed again, and in the end run to completion. After each kill every file of the run
folder is read; at the end the folder is compared with that of the first run. Further trials kill it while it writes its
state, or interrupt it with SIGINT, as Ctrl-C does. Loss of power, which may lose written files, is not tested.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import tyro

from benchmarks.pages import machine, machine_line, read_data, table, write_data, write_page
from concent_warp.errors import ConcentError
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.fit.geometry.checkpoint import Checkpoint
from concent_warp.model import Model

NAME = "resume"
WRITTEN = "checkpoint.npz"
"""File during whose writing a run is killed; others are written too quickly."""
LAST = 0.75
"""Moments are sampled from this share of the time of the process; the rest is its clean-up."""
CLOCKED = {"settings.toml", "checkpoint.npz", "history.json", "report.html"}
"""Files with times or the command, which differ between runs."""


Moment = float | str
"""Processor time of a process [s], or the file that it is writing."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    trials: int = 4
    """Fits that are killed."""
    kills: int = 2
    """Kills in each of them."""
    generations: int = 6
    population: int = 6
    spheres: int = 96
    seed: int = 0
    """Seed of the moments at which runs are killed."""
    table: bool = False
    """Write the page from the stored results, without runs."""


@dataclass(frozen=True)
class Stop:
    """One run that was stopped."""

    signal: str
    after: float
    """Processor time that it had used when the signal came [s]."""
    code: int
    """Exit status as a shell tells it: 137 after SIGKILL, 130 after SIGINT."""
    generations: int
    """Generations in the checkpoint that it left."""
    files: int
    """Files that it left."""
    partial: int
    """How many of them are parts of files that were being written; they have names of their own."""
    unreadable: list[str]
    """Files under their final names that cannot be read."""
    said: str
    """Last line of standard error."""
    traceback: bool


class Bench:
    """The fit and where it runs."""

    def __init__(self, args: Args, folder: Path) -> None:
        self.args, self.folder = args, folder
        record = ["record", "--out", "demo.h5", "--seeds", "0", "--reality.expert.speed", "2"]
        subprocess.run(self.command(*record), cwd=folder, check=True, capture_output=True)

    def command(self, *words: str) -> list[str]:
        """Return a ``concent`` command."""
        return [sys.executable, "-m", "concent_warp", *words]

    def start(self, out: str) -> subprocess.Popen[bytes]:
        """Start the fit, or go on with it if the folder is there."""
        settings = {
            "--count": self.args.spheres,
            "--fit.generations": self.args.generations,
            "--fit.evolution.population": self.args.population,
            "--engine": "mujoco",
        }
        words = ["fit", "demo.h5", "--out", out, *(str(word) for pair in settings.items() for word in pair)]
        if (self.folder / out).exists():
            words.append("--resume")
        # A process started in the background may inherit that SIGINT is ignored.
        return subprocess.Popen(
            self.command(*words),
            cwd=self.folder,
            stdout=subprocess.DEVNULL,
            stderr=(self.folder / f"{out}.stderr").open("wb"),
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def finish(self, out: str) -> float:
        """Run the fit to its end and return how much processor time that took [s]."""
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        if code := self.start(out).wait():
            raise SystemExit(f"the fit failed with status {code}: {(self.folder / f'{out}.stderr').read_text()}")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    def stop(self, out: str, moment: Moment, kind: signal.Signals) -> Stop | None:
        """Run the fit and stop it by a signal; None if it came to its end before."""
        process = self.start(out)
        while process.poll() is None:
            if self.has_come(moment, process.pid, out):
                after = processor_time(process.pid)
                process.send_signal(kind)
                code = process.wait()
                return self.found(out, after, kind, code if code >= 0 else 128 - code)
        return None

    def has_come(self, moment: Moment, pid: int, out: str) -> bool:
        """Return whether a moment has come; waits a little where the moment is a matter of time."""
        if isinstance(moment, str):
            return (self.folder / out / f".{moment}.partial").exists()
        time.sleep(0.005)
        return processor_time(pid) >= moment

    def found(self, out: str, after: float, kind: signal.Signals, code: int) -> Stop:
        """Look at what a stopped run has left."""
        folder = self.folder / out
        files = sorted(path for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else []
        partial = [path for path in files if is_partial(path)]
        whole = [path for path in files if not is_partial(path)]
        checkpoint = folder / "checkpoint.npz"
        said = (self.folder / f"{out}.stderr").read_text()
        return Stop(
            signal=kind.name,
            after=round(after, 2),
            code=code,
            generations=len(Checkpoint.load(checkpoint).history) if checkpoint.is_file() else 0,
            files=len(files),
            partial=len(partial),
            unreadable=[path.name for path in whole if not readable(path)],
            said=(said.strip().splitlines() or [""])[-1],
            traceback="Traceback" in said,
        )

    def differences(self, out: str, reference: str) -> list[str]:
        """Return what differs between the results of two runs: files, bytes, geometry, losses."""
        a, b = self.folder / out, self.folder / reference
        names, expected = ({path.name for path in folder.iterdir()} for folder in (a, b))
        found = sorted(names ^ expected)
        found += [
            name for name in sorted(names & expected - CLOCKED) if (a / name).read_bytes() != (b / name).read_bytes()
        ]
        models = [Model.load(folder / "model.toml").geometry for folder in (a, b)]
        assert models[0] is not None
        assert models[1] is not None
        for field in ("position", "radius", "friction", "mass"):
            if not np.array_equal(getattr(models[0], field), getattr(models[1], field)):
                found.append(f"geometry: {field}")
        losses = [[h["loss"] for h in json.loads((f / "history.json").read_text())["generations"]] for f in (a, b)]
        return found if losses[0] == losses[1] else [*found, "losses"]


def processor_time(pid: int) -> float:
    """Return the processor time that a running process has used [s]: fields 14 and 15 of its stat, see proc(5)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def is_partial(path: Path) -> bool:
    """Return whether a file is marked as not finished."""
    return path.name.endswith(".partial")


def readable(path: Path) -> bool:
    """Return whether a file of a run folder is whole."""
    try:
        if path.name == "checkpoint.npz":
            Checkpoint.load(path)
        elif path.name in ("start.toml", "model.toml"):
            Model.load(path)
        elif path.name.startswith("events"):
            ContactEventSequence.load(path)
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".toml":
            tomllib.loads(path.read_text())
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as data:
                return all(data[name] is not None for name in data.files)
        elif path.suffix == ".png":
            return path.read_bytes().endswith(b"IEND\xaeB`\x82")
        elif path.suffix == ".html":
            return path.read_text().rstrip().endswith("</html>")
    except (ConcentError, ValueError, OSError, KeyError, BadZipFile):
        return False
    return True


def trial(bench: Bench, out: str, moments: Sequence[Moment], kind: signal.Signals) -> dict[str, Any]:
    """Stop a fit at some moments, resume it to the end, and compare it with the reference."""
    stops = [stop for moment in moments if (stop := bench.stop(out, moment, kind)) is not None]
    bench.finish(out)
    left = [path.name for path in (bench.folder / out).rglob("*") if is_partial(path)]
    result = {"stops": [asdict(stop) for stop in stops], "left": left, "differs": bench.differences(out, "reference")}
    print(json.dumps(result), flush=True)
    return result


def measure(args: Args) -> dict[str, Any]:
    """Return the results."""
    rng = np.random.default_rng(args.seed)
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(args, Path(name))
        whole = bench.finish("reference")
        again = bench.finish("again")
        result = {
            "machine": machine(),
            "seconds": [whole, again],
            "files": sum(path.is_file() for path in (bench.folder / "reference").rglob("*")),
            "repeat_differs": bench.differences("again", "reference"),
            "killed": [
                trial(bench, f"killed{k}", rng.uniform(0, LAST * again, args.kills).tolist(), signal.SIGKILL)
                for k in range(args.trials)
            ],
            "writing": [trial(bench, f"writing{k}", [WRITTEN], signal.SIGKILL) for k in range(args.trials)],
        }
        moments = [[share * again] for share in (0.05, 0.2, 0.4, LAST)]
        result["interrupted"] = [
            trial(bench, f"interrupted{k}", moment, signal.SIGINT) for k, moment in enumerate(moments)
        ]
    return result


def rows(trials: list[dict[str, Any]]) -> list[list[str]]:
    """Return the rows of the table of stops."""
    cells = []
    for k, each in enumerate(trials, 1):
        for i, stop in enumerate(each["stops"]):
            last = i == len(each["stops"]) - 1
            cells.append(
                [
                    f"{k}.{i + 1}",
                    f"{stop['after']:.1f}",
                    str(stop["code"]),
                    str(stop["generations"]),
                    f"{stop['files'] - stop['partial']} / {stop['partial']}",
                    ", ".join(stop["unreadable"]) or "none",
                    (", ".join(each["left"]) or "none") if last else "",
                    (", ".join(each["differs"]) or "identical") if last else "",
                ]
            )
    return cells


def page(result: dict[str, Any]) -> str:
    """Return the page."""
    killed, interrupted = result["killed"] + result["writing"], result["interrupted"]
    stops = [stop for each in killed for stop in each["stops"]]
    same = sum(not each["differs"] and not each["left"] for each in killed + interrupted)
    head = ["trial.run", "stopped after [s]", "exit status", "generations done", "files: whole / partial"]
    head += ["unreadable", "partial at the end", "against the reference"]
    text = f"""# Killed and resumed

{(__doc__ or "").split(chr(10) * 2, 2)[2].strip()}

`python -m benchmarks.fit.resume`. {machine_line(result["machine"])}

Times are processor times since the start of the process; the whole fit takes {result["seconds"][1]:.0f} s, report
included, and leaves {result["files"]} files. *partial* are files that were being written at the kill: they have other
names, and the resumed run replaces them. *identical*: the same files; model, geometry, contact events, schedules and
comparison byte by byte; the loss of each generation.

**{same} of {len(killed + interrupted)} fits have the identical result and no partial file**, after
{len(stops)} kills and {sum(len(each["stops"]) for each in interrupted)} interruptions.

## SIGKILL

{table(head, rows(result["killed"]))}
While writing {WRITTEN}:

{table(head, rows(result["writing"]))}
## SIGINT

{table(head, rows(interrupted))}
"""
    text += "Last message:\n\n"
    for each in interrupted:
        for stop in each["stops"]:
            remarks = ", after the last file" * (stop["files"] - stop["partial"] == result["files"])
            remarks += ", with a traceback" * stop["traceback"]
            text += f"- after {stop['after']:.1f} s{remarks}: `{stop['said']}`\n"
    return text


def main(args: Args) -> None:
    """Measure and write data and page."""
    result = read_data(NAME) if args.table else measure(args)
    if not args.table:
        write_data(NAME, result)
    write_page(NAME, page(result))


if __name__ == "__main__":
    main(tyro.cli(Args))
