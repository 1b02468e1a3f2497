"""Stages of many data sets in processes of their own, until all is done or the time is up."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path

from benchmarks.diagnose.suggest_sets import SuggestSet
from benchmarks.diagnose.suggest_stages import Task, begin, begin_suggestion, next_tasks

ORDER = {"first": 0, "second": 1, "suggest": 2}
"""First diagnoses come first, so that all groups are known early; then what ends a data set that is begun."""
POLL = 0.1
"""Time between two looks at what has ended [s]."""
GRACE = 5.0
"""Time in which processes end once they are asked to [s]."""


@dataclass(frozen=True)
class _Running:
    """A stage that runs."""

    one: SuggestSet
    task: Task
    process: BaseProcess
    begun: float


def run_all(
    sets: Sequence[SuggestSet],
    out: Path,
    jobs: int,
    limit: float,
    tell: Callable[[str], None],
    work: Callable[[SuggestSet, Task, Path], None],
) -> bool:
    """Run what is left of data sets in their order, and return whether all was done.

    Args:
        sets: Data sets.
        out: Where each has its folder.
        jobs: Stages at a time.
        limit: Time after which nothing is begun and what runs is stopped [s].
        tell: Told each stage that ends.
        work: Runs a stage, given the folder of the data set.
    """
    started, running, failed = time.monotonic(), list[_Running](), set[tuple[str, Task]]()
    names = {one.name: k for k, one in enumerate(sets)}
    pending = [(one, task) for one in sets for task in next_tasks(out / one.name)]
    try:
        while (pending or running) and time.monotonic() - started < limit:
            pending.sort(key=lambda pair: (ORDER[pair[1][0]], names[pair[0].name]))
            while pending and len(running) < jobs:
                running.append(_begun(*pending.pop(0), out, work))
            time.sleep(POLL)
            for ended in [r for r in running if not r.process.is_alive()]:
                running.remove(ended)
                ended.process.join()
                busy = {(r.one.name, r.task) for r in running} | {(one.name, task) for one, task in pending}
                left = [task for task in next_tasks(out / ended.one.name) if (ended.one.name, task) not in busy]
                if ended.task in left:  # it died, as for lack of memory
                    failed.add((ended.one.name, ended.task))
                pending += [(ended.one, t) for t in left if (ended.one.name, t) not in failed]
                spent = time.monotonic() - ended.begun
                how = "" if (ended.one.name, ended.task) not in failed else f", DIED ({ended.process.exitcode})"
                told = f"{time.monotonic() - started:6.0f} s  {ended.one.name:52s} {' '.join(ended.task):14s}"
                tell(f"{told} {spent:5.0f} s{how}  ({len(pending)} wait, {len(running)} run)")
    finally:
        for one in running:
            tell(f"stopped: {one.one.name} {' '.join(one.task)} after {time.monotonic() - one.begun:.0f} s")
        _stop(running)
    return not (pending or running or failed)


def _begun(one: SuggestSet, task: Task, out: Path, work: Callable[[SuggestSet, Task, Path], None]) -> _Running:
    """Begin a stage in a process of its own."""
    folder = out / one.name
    begin(one, folder)
    if task[0] == "suggest":
        begin_suggestion(folder)
    process = multiprocessing.get_context("fork").Process(target=_alone, args=(work, one, task, folder))
    process.start()
    return _Running(one, task, process, time.monotonic())


def _alone(work: Callable[[SuggestSet, Task, Path], None], one: SuggestSet, task: Task, folder: Path) -> None:
    """Run a stage as the leader of its group of processes, with what it prints in a file."""
    os.setsid()
    with (folder / "log.txt").open("a", encoding="utf-8") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
        work(one, task, folder)


def _stop(running: Sequence[_Running]) -> None:
    """End processes and those that they started."""
    for kind, patience in ((signal.SIGTERM, GRACE), (signal.SIGKILL, GRACE)):
        for one in running:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(one.process.pid or 0, kind)
            if kind == signal.SIGKILL:
                one.process.kill()  # where it had not yet become the leader of its group
        end = time.monotonic() + patience
        for one in running:
            one.process.join(max(end - time.monotonic(), 0.0))
