"""Commands that find the disk full: one sentence, and the earlier files whole.

    python -m benchmarks.robustness.disk_full            # about 15 minutes
    python -m benchmarks.robustness.disk_full --table    # the page from the stored results

Each command writes its results to a disk in memory (tmpfs). Then the disk is made so small that only a share of what
the command needs is free, and it is started again with --overwrite. Without the right to mount, a limit on the size of
one file stands in for the disk.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.measurements import Measurements
from benchmarks.pages import ROOT, machine
from benchmarks.robustness.commands import WRITING, Ended, Writing, ended, launch, prepare, run
from benchmarks.robustness.contents import files, hashes, unfinished, unreadable
from benchmarks.robustness.page import store

SHARES = (0.0, 0.1, 0.35, 0.6, 0.9)
"""Shares of what a command needs that are free on the disk."""
PAGE = 4096
"""Unit of the size of a tmpfs [bytes]."""
ROOM = 1 << 28
"""Size of a disk that is not full [bytes]."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    rows: Path = ROOT / "runs" / "robustness" / "disk_full.jsonl"
    """File of the measurements, from which an interrupted run goes on."""
    inputs: Path = ROOT / "runs" / "robustness" / "inputs"
    """Folder of the commands' inputs, kept for the next run; to be deleted where formats of files have changed."""
    only: tuple[str, ...] = ()
    """Commands; all by default."""
    table: bool = False
    """Write the page from the stored results, without runs."""


class Disk:
    """A folder on a disk whose size can be changed."""

    def __init__(self, folder: Path) -> None:
        """Take an empty folder; mount a disk there where that is allowed."""
        self.folder, self.limit = folder, resource.RLIM_INFINITY
        command = ["mount", "-t", "tmpfs", "-o", f"size={ROOM}", "tmpfs", str(folder)]
        self.is_mounted = os.geteuid() == 0 and not subprocess.run(command, capture_output=True).returncode

    def leave(self, share: float, needed: int, largest: int) -> None:
        """Leave free a share of what is needed, or allow files of a share of the largest one [bytes]."""
        self.limit = int(share * largest)
        if self.is_mounted:
            status = os.statvfs(self.folder)
            used = (status.f_blocks - status.f_bfree) * status.f_frsize
            self._resize(max(used + int(share * needed) // PAGE * PAGE, PAGE))

    def empty(self) -> None:
        """Make room again."""
        self.limit = resource.RLIM_INFINITY
        if self.is_mounted:
            self._resize(ROOM)

    def _resize(self, size: int) -> None:
        """Set the size [bytes]."""
        subprocess.run(["mount", "-o", f"remount,size={size}", str(self.folder)], check=True)

    def run(self, words: Sequence[str], folder: Path) -> Ended:
        """Run a command that writes to the disk."""
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        begun = time.monotonic()
        if self.is_mounted or self.limit == resource.RLIM_INFINITY:
            process = launch(words, folder, "last")
        else:
            handled = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.limit, before[1]))
            try:
                process = launch(words, folder, "last")
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
                signal.signal(signal.SIGXFSZ, handled)
        return ended(process, folder, "last", begun)

    def close(self) -> None:
        """Unmount the disk."""
        if self.is_mounted:
            subprocess.run(["umount", str(self.folder)], check=True)


@contextmanager
def small_disk() -> Iterator[tuple[Path, Disk]]:
    """Yield a folder to work in, and a disk in it."""
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "disk").mkdir()
        disk = Disk(Path(name) / "disk")
        try:
            yield Path(name), disk
        finally:
            disk.close()


def measure(writing: Writing, inputs: Path, shares: Sequence[float] = SHARES) -> list[dict[str, Any]]:
    """Return how a command ends on disks with so much room, for each share of what it needs."""
    with small_disk() as (folder, disk):
        words = writing.words(inputs, disk.folder)
        first = run(words, folder)
        if first.code:
            raise SystemExit(f"concent {writing.name}: status {first.code} with room: {first.said}")
        before, sizes = hashes(disk.folder), [len(content) for content in files(disk.folder).values()]
        if unreadable(disk.folder):
            raise SystemExit(f"concent {writing.name}: unreadable with room: {unreadable(disk.folder)}")
        needed = sum(-(-size // PAGE) * PAGE for size in sizes)
        more = () if "--resume" in words else ("--overwrite",)
        found = []
        for share in shares:
            if writing.name == "diagnose":  # its finished parts would be taken from the folder
                for path in (disk.folder / "pieces").iterdir():
                    path.unlink()
                before = hashes(disk.folder)
            disk.leave(share, needed, max(sizes))
            done = disk.run([*words, *more], folder)
            disk.empty()
            row = {"share": share, **judged(done, disk.folder, before)}
            if done.code and "continue with" in row["said"]:
                done = run([*words, "--resume"], folder)
                row["resumed"] = done.code == 0 and not unfinished(disk.folder)
                row["faults"] += [] if row["resumed"] else [f"not resumed: {done.said or unfinished(disk.folder)}"]
            found.append(row)
            if done.code == 0:
                before = hashes(disk.folder)
        return found


def judged(done: Ended, folder: Path, before: dict[str, str]) -> dict[str, Any]:
    """Return what a command on a full disk has done, and what of it is wrong."""
    after = hashes(folder)
    kept = {name: after.get(name) == content for name, content in before.items()}
    faults = []
    said = done.said[-1] if done.said else ""
    if done.code == 0:
        faults += [f"unreadable: {name}" for name in unreadable(folder)]
    else:
        faults += [f"changed: {name}" for name, same in kept.items() if not same]
        kept_on_purpose = ("pieces/", *[".new/"] * ("continue with" in said))
        new = sorted(set(after) - set(before))
        faults += [f"left: {name}" for name in new if not any(part in name for part in kept_on_purpose)]
        faults += [f"status {done.code}"] * (done.code not in (1, 2))
        faults += ["no path in the sentence"] * (str(folder) not in said)
    faults += ["traceback"] * any("Traceback" in line or "Fatal" in line for line in done.said)
    errors = [line for line in done.said if ": warning: " not in line]
    faults += [f"{len(errors)} sentences"] * (done.code != 0 and len(errors) != 1)
    faults += [f"part left: {name}" for name in after if "partial" in name]
    return {"code": done.code, "said": said.replace(str(folder), "DISK"), "faults": faults}


def main(args: Args) -> None:
    """Measure what is missing, and write data and page."""
    if not args.table:
        rows = Measurements(args.rows)
        wanted = [each for each in WRITING if not args.only or each.name in args.only]
        prepare(args.inputs)
        for k, writing in enumerate(wanted):
            if rows.wanted(writing.name):
                print(f"{k + 1} of {len(wanted)}: {writing.name}", flush=True)
                rows.add(writing.name, {"trials": measure(writing, args.inputs)})
        if not args.only:
            store("disk full", {"machine": machine(), "commands": {w.name: rows.rows[w.name] for w in WRITING}})
    else:
        store("disk full", None)


if __name__ == "__main__":
    main(tyro.cli(Args))
