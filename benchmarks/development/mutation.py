"""How many small changes of the library the tests notice, by room: mutation testing on a random sample.

    python -m benchmarks.development.mutation --sample 80 --seed 0 --jobs 16 --out runs/mutation   # and the page
    python -m benchmarks.development.mutation --rooms fit --files concent_warp/fit/geometry --sample 10 --no-page

It needs `cosmic-ray`, whose operators make the mutants (`mutants.py` says which). First each test file is run once with
the functions noted that each test calls. Then each mutant is tried, in a copy of the repository, on tests that call its
function, quickest first within those of its room, up to `--budget` seconds: so a survivor may still be noticed by a
slower test, and the shares are lower bounds. What is done is kept in `--out`; the same command goes on with it.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import tyro

from benchmarks.development.mutants import ROOMS, TESTS, Mutant, changed_lines, drawn, mutated
from benchmarks.development.mutation_page import write_mutation_page
from benchmarks.development.mutation_worker import LINKED
from benchmarks.pages import ROOT, machine

COPIED = ("concent_warp", "kernels", "train", "render", "tests", "benchmarks", "examples", "docs", "pyproject.toml")
"""What of the repository a copy has."""
ALWAYS = ("tests/test_settings.py",)
"""Tests of what modules and classes declare."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    sample: int = 80
    """Mutants a room."""
    seed: int = 0
    """Seed of the sample."""
    jobs: int = 1
    """Processes at a time, each with a copy of the repository."""
    rooms: tuple[str, ...] = tuple(ROOMS)
    """Rooms."""
    files: tuple[str, ...] = ()
    """Only mutants of files whose path begins so."""
    tests: tuple[str, ...] = ()
    """Test files and folders instead of those of all rooms."""
    budget: float = 20.0
    """Time of the tests that a mutant is tried on, unchanged [s]; the quickest one and `ALWAYS` are run in any case."""
    slowest: int = 60
    """Tests that take longer than this are left out [s]."""
    seconds: float | None = None
    """Time after which no mutant is begun [s]."""
    out: Path = field(default_factory=lambda: Path("runs/mutation"))
    """Folder of results and copies."""
    page: bool = True
    """Write the page from the results."""


class Worker:
    """A process that runs tests on a copy of the repository, see `mutation_worker`."""

    def __init__(self, folder: Path) -> None:
        """Copy the repository and start the process."""
        copy = folder / "tree"
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir(parents=True)
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(source, copy / name)
        for name in LINKED:
            (copy / "concent_warp" / name).symlink_to((copy / name).resolve())
        paths = [str(copy.resolve()), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "PYTHONDONTWRITEBYTECODE": "1",
            "OMP_NUM_THREADS": "1",
            "CUDA_VISIBLE_DEVICES": "",
        }
        command = [sys.executable, "-m", "benchmarks.development.mutation_worker", str(folder.resolve())]
        self._process = subprocess.Popen(
            command, cwd=copy.resolve(), env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._reply()

    def ask(self, **request: Any) -> dict[str, Any]:
        """Return the answer to a request."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._reply()

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _reply(self) -> dict[str, Any]:
        """Return the next line."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("a worker has ended; its message is above")
        return json.loads(line)


def shared_out(workers: Sequence[Worker], tasks: Sequence[Callable[[Worker], None]], until: float | None) -> None:
    """Do tasks on all workers at a time, in order; none is begun after the time `until`."""
    waiting: queue.SimpleQueue[Callable[[Worker], None]] = queue.SimpleQueue()
    for task in tasks:
        waiting.put(task)
    failures: list[BaseException] = []

    def work(worker: Worker) -> None:
        while not failures and (until is None or time.monotonic() < until):
            try:
                task = waiting.get_nowait()
            except queue.Empty:
                return
            try:
                task(worker)
            except BaseException as error:
                failures.append(error)

    threads = [threading.Thread(target=work, args=(worker,)) for worker in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]


class Shown:
    """Prints each result with the time that is left."""

    def __init__(self, count: int, what: str) -> None:
        """Begin to count."""
        self._count, self._what, self._done, self._begun = count, what, 0, time.monotonic()
        self._lock = threading.Lock()

    def __call__(self, text: str) -> None:
        """Print one result."""
        with self._lock:
            self._done += 1
            left = (time.monotonic() - self._begun) / self._done * (self._count - self._done)
            print(f"{self._what} {self._done}/{self._count}, {left:.0f} s left: {text}", flush=True)


def test_files(places: Sequence[str]) -> list[str]:
    """Return the test files of these files and folders, largest first, which mostly take longest."""
    found = []
    for place in places:
        path = ROOT / place
        found += sorted(path.rglob("test_*.py")) if path.is_dir() else [path] if path.is_file() else []
    names = dict.fromkeys(str(p.relative_to(ROOT)) for p in found)
    return sorted(names, key=lambda name: -(ROOT / name).stat().st_size)


def traced(workers: Sequence[Worker], files: Sequence[str], args: Args) -> dict[str, dict[str, Any]]:
    """Return what each test file calls: ``tests`` by name with seconds and calls, and ``imported``."""
    folder = args.out / "traces"
    folder.mkdir(parents=True, exist_ok=True)

    def path(name: str) -> Path:
        return folder / (name.replace("/", "-") + ".json")

    missing = [name for name in files if not path(name).is_file()]
    show = Shown(len(missing), "trace")

    def task(name: str) -> Callable[[Worker], None]:
        def trace(worker: Worker) -> None:
            reply = worker.ask(tests=[name], timeout=600, each=args.slowest, trace=True)
            path(name).write_text(json.dumps(reply))
            show(f"{name} {reply['outcome']} {reply.get('failed') or ''} {reply['seconds']:.0f} s")

        return trace

    shared_out(workers, [task(name) for name in missing], None)
    return {name: json.loads(path(name).read_text()) for name in files}


@dataclass(frozen=True)
class Selection:
    """Which tests call which functions."""

    tests: dict[str, tuple[float, frozenset[str]]]
    """Seconds and functions called of each test that passes unchanged."""

    @staticmethod
    def of(traces: dict[str, dict[str, Any]]) -> Selection:
        """Return what traces say; tests that fail or are skipped unchanged are left out."""
        found = {}
        for trace in traces.values():
            imported = trace.get("imported", [])
            for name, entry in trace.get("tests", {}).items():
                if "outcome" not in entry and "seconds" in entry:
                    found[name] = (entry["seconds"], frozenset([*entry["calls"], *imported]))
        return Selection(found)

    def chosen(self, mutant: Mutant, budget: float) -> tuple[list[str], float]:
        """Return tests to try a mutant on, in order, and their time [s]."""
        function = f"{mutant.file}::{mutant.scope or '<module>'}"
        own = TESTS[mutant.room]

        def order(name: str) -> tuple[bool, bool, float]:
            seconds, calls = self.tests[name]
            inside = any(call.startswith(mutant.file + "::") and "<module>" not in call for call in calls)
            return not name.startswith(ALWAYS), not (inside and name.startswith(own)), seconds

        able = sorted((name for name, (_, calls) in self.tests.items() if function in calls), key=order)
        tests, counted, total = [], 0.0, 0.0
        for name in able:
            seconds, always = self.tests[name][0], name.startswith(ALWAYS)
            if tests and counted + seconds > budget and not always:
                continue
            tests.append(name)
            total += seconds
            counted += 0.0 if always else seconds
        return tests, total


def tried(worker: Worker, mutant: Mutant, selection: Selection, args: Args) -> dict[str, Any]:
    """Return what became of a mutant."""
    code = (ROOT / mutant.file).read_text()
    other = mutated(code, mutant)
    before, after = changed_lines(code, other)
    row: dict[str, Any] = {**asdict(mutant), "key": mutant.key, "before": before, "after": after}
    tests, seconds = selection.chosen(mutant, args.budget)
    row |= {"tests": len(tests)}
    if not tests:
        return {**row, "outcome": "survived", "seconds": 0.0}
    reply = worker.ask(file=mutant.file, code=other, tests=tests, timeout=60 + 8 * seconds, each=int(60 + 8 * seconds))
    outcome = {"passed": "survived", "failed": "killed"}.get(reply["outcome"], reply["outcome"])
    return {**row, "outcome": outcome, "by": reply.get("failed"), "seconds": reply["seconds"]}


def main(args: Args) -> None:
    """Try what is not tried, and write the page."""
    begun = time.monotonic()
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / "results.jsonl"
    by_room = [drawn(ROOT, room, args.sample, args.seed) for room in args.rooms]
    # In turn, so that what is done when it is stopped is a fair part of each.
    sample = [m for turn in zip_longest(*by_room) for m in turn if m is not None]
    sample = [m for m in sample if not args.files or m.file.startswith(args.files)]
    done = {row["key"] for row in map(json.loads, kept.read_text().splitlines())} if kept.is_file() else set()
    missing = [m for m in sample if m.key not in done]
    if missing:
        workers: list[Worker] = []
        starts = [threading.Thread(target=lambda k=k: workers.append(Worker(args.out / f"job{k}")))
                  for k in range(args.jobs)]  # fmt: skip
        for start in starts:
            start.start()
        for start in starts:
            start.join()
        print(f"{len(workers)} workers after {time.monotonic() - begun:.0f} s", flush=True)
        every = [place for room in ROOMS for place in TESTS[room]]
        files = test_files([*(args.tests or every), *ALWAYS])
        selection = Selection.of(traced(workers, files, args))
        print(f"{len(selection.tests)} tests traced after {time.monotonic() - begun:.0f} s", flush=True)
        show, lock = Shown(len(missing), "mutant"), threading.Lock()

        def task(mutant: Mutant) -> Callable[[Worker], None]:
            def work(worker: Worker) -> None:
                row = tried(worker, mutant, selection, args)
                with lock, kept.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                show(f"{row['outcome']} {mutant.key} ({row['seconds']:.0f} s)")

            return work

        shared_out(workers, [task(m) for m in missing], None if args.seconds is None else begun + args.seconds)
        for worker in workers:
            worker.close()
    keys = {m.key for m in sample}
    rows = [row for row in map(json.loads, kept.read_text().splitlines()) if row["key"] in keys]
    print(f"{len(rows)} of {len(sample)} mutants tried after {time.monotonic() - begun:.0f} s", flush=True)
    if args.page:
        write_mutation_page(rows, asdict(args), machine())


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
