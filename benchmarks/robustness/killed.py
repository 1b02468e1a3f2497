"""Runs that are killed at random moments and resumed: none is lost, no file is broken, and the result is the same.

    python -m benchmarks.robustness.killed            # about half an hour
    python -m benchmarks.robustness.killed --table    # the page from the stored results

Each command runs once without interruption. Then it is started 20 times and killed with SIGKILL, with all processes
that it has started, at a random moment of its duration; every file under its final name is read; and it is continued
with --resume (diagnose: the same command again) and compared with the first run.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.measurements import Measurements
from benchmarks.pages import ROOT, machine
from benchmarks.robustness.commands import FIT, RENDER, SERVO, TRAIN, TRAIN_FLOW, Writing, launch, prepare, run
from benchmarks.robustness.contents import VARYING, files, unfinished, unreadable
from benchmarks.robustness.page import store
from concent_warp.fit.geometry.checkpoint import Checkpoint

TRIES = 5
"""Most starts of a trial: a run that has ended before its moment is started again, to be killed earlier."""
TORCHRUN = ("-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone")


@dataclass(frozen=True)
class Killable:
    """A command that can be resumed."""

    writing: Writing
    before: tuple[str, ...] = ()
    """What starts the package in place of Python alone."""
    resume: tuple[str, ...] = ("--resume",)
    """What continues it."""
    inputs: tuple[str, ...] = ()
    """Names of the inputs that it wants."""

    def start(self, inputs: Path, folder: Path) -> Any:
        """Start it in a folder."""
        return launch(self.writing.words(inputs, folder / "out"), folder, "last", before=self.before)

    def finish(self, inputs: Path, folder: Path, *, resumed: bool) -> Any:
        """Run it to its end."""
        words = self.writing.words(inputs, folder / "out", *(self.resume if resumed else ()))
        return run(words, folder, before=self.before)


DIAGNOSE = f"diagnose {SERVO} --effects joint_friction joint_damping backlash --jobs 2 --json --out {{out}}"
KILLABLE = {
    "fit": Killable(Writing("fit", FIT), inputs=("demo.h5",)),
    "train": Killable(Writing("train", f"{TRAIN} --iterations 40 --out {{out}}/run")),
    "train, 2 processes": Killable(Writing("train", f"{TRAIN} --iterations 40 --out {{out}}/run"), before=TORCHRUN),
    "render": Killable(Writing("render", f"{RENDER} --episodes 8")),
    "train-flow": Killable(Writing("train-flow", f"{TRAIN_FLOW} --steps 200"), inputs=("dataset",)),
    "diagnose": Killable(Writing("diagnose", DIAGNOSE), resume=()),
}


@dataclass(frozen=True)
class Args:
    """Command line."""

    trials: int = 20
    """Kills of each command."""
    seed: int = 0
    """Seed of the moments."""
    rows: Path = ROOT / "runs" / "robustness" / "killed.jsonl"
    """File of the measurements, from which an interrupted run goes on."""
    inputs: Path = ROOT / "runs" / "robustness" / "inputs"
    """Folder of the commands' inputs, kept for the next run; to be deleted where formats of files have changed."""
    only: tuple[str, ...] = ()
    """Commands; all by default."""
    table: bool = False
    """Write the page from the stored results, without runs."""


def descendants(pid: int) -> list[int]:
    """Return a process and all that it has started, by what /proc tells of parents."""
    children: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            parent = int(path.read_text().rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(int(path.parent.name))
    found = [pid]
    for one in found:
        found += children.get(one, [])
    return found


def kill(pid: int) -> None:
    """Kill a process and all that it has started; each is stopped first, so that none reacts to the end of another."""
    for sign in (signal.SIGSTOP, signal.SIGKILL):
        for one in descendants(pid):
            with suppress(ProcessLookupError):
                os.kill(one, sign)


def killed_at(killable: Killable, inputs: Path, folder: Path, moment: float) -> float | None:
    """Start a command and kill it at a moment [s]; return when that was, None if it had ended before."""
    begun = time.monotonic()
    process = killable.start(inputs, folder)
    while process.poll() is None:
        spent = time.monotonic() - begun
        if spent >= moment:
            kill(process.pid)
            process.wait()
            return spent
        time.sleep(min(0.02, moment - spent))
    return None


def trial(
    killable: Killable, inputs: Path, reference: Path, moments: Iterator[float], seconds: float
) -> dict[str, Any]:
    """Return how a run came out that was killed once and resumed."""
    with tempfile.TemporaryDirectory() as name:
        folder, after = Path(name), None
        for _ in range(TRIES):
            shutil.rmtree(folder / "out", ignore_errors=True)
            (folder / "out").mkdir()
            after = killed_at(killable, inputs, folder, next(moments))
            if after is not None:
                break
        if after is None:
            return {"error": "the run ended before it could be killed"}
        left = files(folder / "out")
        corrupt = unreadable(folder / "out")
        done = killable.finish(inputs, folder, resumed=True)
        return {
            "after": round(after, 2),
            "share": round(after / seconds, 3),
            "files": len(left),
            "unfinished": len(unfinished(folder / "out")),
            "corrupt": corrupt + (unreadable(folder / "out") if done.code == 0 else []),
            "resumed": done.code == 0,
            "said": [] if done.code == 0 else done.said,
            "left": unfinished(folder / "out") if done.code == 0 else [],
            "differs": differences(folder, reference) if done.code == 0 else [],
        }


def differences(folder: Path, reference: Path) -> list[str]:
    """Return what differs between the results of two runs, times and paths aside."""
    found, expected = (
        {n: c for n, c in files(one / "out").items() if "tfevents" not in n} for one in (folder, reference)
    )
    names = [f"only in one: {name}" for name in sorted(set(found) ^ set(expected))]
    for name in sorted(set(found) & set(expected)):
        same = COMPARED.get(Path(name).name, _same_bytes)
        if not (Path(name).name in VARYING or same(folder / "out" / name, reference / "out" / name)):
            names.append(name)
    texts = [(one / "last.out").read_text() for one in (folder, reference)]
    if texts[0].startswith("{") and texts[0] != texts[1]:
        names.append("standard output")
    return names


def _same_bytes(a: Path, b: Path) -> bool:
    """Return whether two files are the same."""
    return a.read_bytes() == b.read_bytes()


def _same_fit(a: Path, b: Path) -> bool:
    """Return whether two checkpoints of fits have the same content, times aside."""
    one, other = (_without_times(vars(Checkpoint.load(path))) for path in (a, b))
    return _same(one, other)


def _without_times(value: Any) -> Any:
    """Return nested containers without what is named as a time."""
    if isinstance(value, dict):
        return {key: _without_times(part) for key, part in value.items() if key not in TIMES}
    return [_without_times(part) for part in value] if isinstance(value, list) else value


def _same_checkpoint(a: Path, b: Path) -> bool:
    """Return whether two checkpoints of trainings have the same content, the seconds aside."""
    import torch

    one, other = (torch.load(path, map_location="cpu", weights_only=True) for path in (a, b))
    return _same(_without_times(one), _without_times(other))


def _same(a: Any, b: Any) -> bool:
    """Return whether two values of nested containers are equal to the bit."""
    import torch

    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


def _same_curve(a: Path, b: Path) -> bool:
    """Return whether two curves have the same metrics, times aside."""
    one, other = ([_without_times(json.loads(line)) for line in path.read_text().splitlines()] for path in (a, b))
    return one == other


TIMES = ("seconds", "collecting", "updating", "steps_per_second")
COMPARED: dict[str, Callable[[Path, Path], bool]] = {
    "checkpoint.npz": _same_fit, "checkpoint.pt": _same_checkpoint, "curve.jsonl": _same_curve,
}  # fmt: skip
"""Comparisons of files that hold times, by their names."""


def moments_of(seed: int, command: str, k: int, seconds: float) -> Iterator[float]:
    """Yield moments at which to kill a trial [s]: uniform over the duration, then earlier each time."""
    rng = np.random.default_rng([seed, sum(command.encode()), k])
    while True:
        moment = rng.uniform(0, seconds)
        yield moment
        seconds = moment


def measure(command: str, args: Args, rows: Measurements) -> None:
    """Measure the trials of a command that are missing."""
    killable = KILLABLE[command]
    keys = [f"{command} {k}" for k in range(args.trials)]
    if all(key in rows.rows and "error" not in rows.rows[key] for key in keys):
        return
    prepare(args.inputs, killable.inputs)
    with tempfile.TemporaryDirectory() as name:
        reference = Path(name)
        (reference / "out").mkdir()
        done = killable.finish(args.inputs, reference, resumed=False)
        if done.code:
            raise SystemExit(f"{command}: status {done.code}: {done.said}")
        rows.add(f"{command} whole", {"seconds": round(done.seconds, 1)})
        for k, key in enumerate(keys):
            if rows.wanted(key):
                moments = moments_of(args.seed, command, k, done.seconds)
                rows.add(key, trial(killable, args.inputs, reference, moments, done.seconds))


def main(args: Args) -> None:
    """Measure what is missing, and write data and page."""
    if args.table:
        store("killed", None)
        return
    rows = Measurements(args.rows)
    commands = [command for command in KILLABLE if not args.only or command in args.only]
    for command in commands:
        measure(command, args, rows)
    if not args.only:
        trials = {c: [rows.rows[f"{c} {k}"] for k in range(args.trials)] for c in KILLABLE}
        seconds = {c: rows.rows[f"{c} whole"]["seconds"] for c in KILLABLE}
        store("killed", {"machine": machine(), "seconds": seconds, "trials": trials})


if __name__ == "__main__":
    main(tyro.cli(Args))
