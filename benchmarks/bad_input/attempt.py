"""Runs cases, each in a process that is forked from one that has imported everything, and judges what happens."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import signal
import stat
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from benchmarks.bad_input.case import Case
from benchmarks.bad_input.sound_inputs import write_all

DEADLINE = 30.0
"""Time after which a command is killed [s]."""
MAX_SECONDS = 10.0
"""Time that a refusal may take [s]."""
MAX_BYTES = 2 << 30
"""Memory that a refusal may take, libraries included [bytes]."""
ENDED = "ended"
"""File with the time at which a command ended, which the process that waits may notice later."""
MOST_HASHED = 1 << 26
"""Size up to which files are hashed to see whether they change [bytes]."""
SENTENCE = re.compile(r"concent\b[^\n]*[.?]")
"""What a refusal looks like."""


@dataclass(frozen=True)
class Outcome:
    """Result of one case."""

    case: Case
    code: int
    """Exit status of the command; negative for the number of the signal that ended it."""
    message: str
    """What was printed on stderr, without lines that only say that the command is loading and without warnings."""
    changed: list[str]
    """Files that are new, gone or changed."""
    seconds: float
    """Wall-clock time [s]."""
    memory: int
    """Largest resident memory, libraries included [bytes]."""

    @property
    def faults(self) -> list[str]:
        """What is wrong with the way the input was treated."""
        found = []
        if "Traceback" in self.message:
            found.append("a traceback")
        if "no check foresaw" in self.message:
            found.append("an unforeseen error")
        if self.code < 0:
            found.append(f"signal {-self.code}")
        if self.case.accepted:
            return [*found, *(["refused"] if self.code > 0 else [])]
        if self.code == 0:
            found.append("exit status 0")
        if not SENTENCE.fullmatch(self.message):
            found.append("not one sentence")
        if self.changed:
            found.append(f"files changed: {', '.join(self.changed[:5])}")
        if self.seconds > MAX_SECONDS:
            found.append(f"{self.seconds:.0f} s")
        if self.memory > MAX_BYTES:
            found.append(f"{self.memory / 2**30:.1f} GiB")
        return found


@dataclass
class _Process:
    """A command that runs."""

    case: Case
    root: Path
    before: dict[str, str]
    start: float = field(default_factory=time.monotonic)


def outcomes(cases: Iterable[Case], jobs: int = 2) -> Iterator[Outcome]:
    """Yield the outcome of each case, as they come.

    Args:
        cases: The cases.
        jobs: Commands that run at a time.
    """
    _import_commands()
    with tempfile.TemporaryDirectory() as name:
        sound = Path(name) / "sound"
        sound.mkdir()
        write_all(sound)
        running: dict[int, _Process] = {}
        for number, case in enumerate(cases):
            while len(running) >= jobs:
                yield from _finished(running)
            root = Path(name) / str(number)
            _prepare(case, sound, root)
            process = _Process(case, root, contents(root))
            running[_start(case, root)] = process
        while running:
            yield from _finished(running)


def _import_commands() -> None:
    """Import what the commands import, so that forked processes need not."""
    from concent_warp.cli.entry import COMMANDS

    for command in COMMANDS:
        import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")
    for name in ("torch", "warp", "mujoco_warp", "rich.table", "trimesh", "concent_warp.train.policy.load"):
        import_module(name)


def _prepare(case: Case, sound: Path, root: Path) -> None:
    """Make the folder of a case: its inputs, and a folder for temporary files."""
    inputs = root / "inputs"
    (root / "temporary").mkdir(parents=True)
    inputs.mkdir()
    for path in sound.iterdir():
        if path.is_dir() and (path.name != "policy" or case.policy):
            shutil.copytree(path, inputs / path.name)
        elif path.is_file():
            shutil.copy(path, inputs)
    case.build(inputs)


def _start(case: Case, root: Path) -> int:
    """Start the command of a case and return its process."""
    sys.stdout.flush()
    sys.stderr.flush()
    process = os.fork()
    if process == 0:
        _run(case, root)
    return process


def _run(case: Case, root: Path) -> NoReturn:
    """Run the command in this process, which ends with it."""
    code: Any = 70
    try:
        os.setsid()
        os.chdir(root / "inputs")
        tempfile.tempdir = os.environ["TMPDIR"] = str(root / "temporary")
        _redirect(case, root)
        from concent_warp.cli import main

        code = main(case.line.split())
        sys.stdout.flush()
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
    finally:
        (root / ENDED).write_text(repr(time.monotonic()))
        os._exit(code if isinstance(code, int) else 1)


def _redirect(case: Case, root: Path) -> None:
    """Let standard streams go to files, or where the case wants it."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    os.dup2(os.open(root / "stderr", flags), 2)
    os.dup2(os.open("/dev/null", os.O_RDONLY), 0)
    os.dup2(os.open("/dev/full" if case.stdout == "full" else root / "stdout", flags), 1)
    encoding = "ascii" if case.stdout == "ascii" else "utf-8"
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", encoding=encoding, closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
    if case.stdout == "closed":
        os.close(1)
        sys.stdout = None  # as Python itself does where the stream is closed


def _finished(running: dict[int, _Process]) -> Iterator[Outcome]:
    """Yield the outcomes of processes that have ended; those past their deadline are killed first."""
    for number, process in list(running.items()):
        if time.monotonic() - process.start > DEADLINE:
            os.killpg(number, signal.SIGKILL)
        found, status, usage = os.wait4(number, os.WNOHANG)
        if found:
            del running[number]
            yield _judged(process, os.waitstatus_to_exitcode(status), usage.ru_maxrss * 1024)
            shutil.rmtree(process.root, onerror=_make_writable)
    time.sleep(0.005)


def _make_writable(remove: Any, path: str, _: object) -> None:
    """Remove what a folder without permission to write holds."""
    os.chmod(Path(path).parent, 0o700)
    remove(path)


def _judged(process: _Process, code: int, memory: int) -> Outcome:
    """Return the outcome of a process that has ended."""
    root = process.root
    ended = float((root / ENDED).read_text()) if (root / ENDED).exists() else time.monotonic()
    seconds = ended - process.start
    text = (root / "stderr").read_text(errors="backslashreplace") if (root / "stderr").exists() else ""
    for name in ("stderr", "stdout", ENDED):
        (root / name).unlink(missing_ok=True)
    after = contents(root)
    changed = sorted(name for name in process.before.keys() | after if process.before.get(name) != after.get(name))
    lines = [line for line in text.splitlines() if not line.endswith(": loading ...") and ": warning: " not in line]
    message = "\n".join(lines).replace(f"{root / 'inputs'}{os.sep}", "").replace(str(root), "")
    message = message.replace(f"{Path(__file__).parents[2]}{os.sep}", "")  # files that come with the package
    return Outcome(process.case, code, message.strip(), changed, seconds, memory)


def contents(folder: Path) -> dict[str, str]:
    """Return all paths below a folder with what they are and, for files, a hash of their content."""
    found = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        kind = stat.filemode(mode)
        if stat.S_ISREG(mode) and path.stat().st_size <= MOST_HASHED:
            kind += hashlib.sha256(path.read_bytes()).hexdigest()
        found[str(path.relative_to(folder))] = kind
    return found
