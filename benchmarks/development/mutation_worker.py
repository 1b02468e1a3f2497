"""Runs tests on a copy of the repository in forked processes, with one file changed or with the functions noted.

A worker imports the large packages once and forks for each run, which saves seconds a run. It reads requests, a line of
JSON each, from standard input: ``tests`` (arguments of pytest), ``timeout`` [s], ``trace``, and ``file`` with ``code``
where one is to be changed. It answers with a line of JSON: ``outcome`` ("passed", "failed" or "timed out"),
``seconds``, ``failed`` (the first test that failed) and, traced, ``tests`` and ``imported``.
"""

from __future__ import annotations

import compileall
import importlib
import importlib.util
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import CodeType
from typing import Any

import pytest

LARGE = ("numpy", "scipy.optimize", "scipy.spatial", "torch", "mujoco", "mujoco_warp", "newton", "h5py")
"""Packages that are imported before the fork."""
TOP = ("concent_warp", "kernels", "train", "render")
LINKED = ("kernels", "train", "render")
"""Folders that are linked into ``concent_warp`` of a copy, as they are installed."""


class Calls:
    """Notes which functions of the library are called."""

    def __init__(self, root: Path) -> None:
        """Begin to note; `root` is the folder of the repository."""
        self._root = str(root) + "/"
        self.found: set[str] = set()
        self._names: dict[CodeType, str | None] = {}
        if sys.version_info >= (3, 12):
            monitoring = sys.monitoring
            monitoring.use_tool_id(monitoring.COVERAGE_ID, "mutation")
            monitoring.register_callback(monitoring.COVERAGE_ID, monitoring.events.PY_START, self._on_start)
            monitoring.set_events(monitoring.COVERAGE_ID, monitoring.events.PY_START)
        else:
            threading.setprofile(self._on_profile)
            sys.setprofile(self._on_profile)

    @contextmanager
    def collected(self) -> Iterator[set[str]]:
        """Give the functions that are called within, as "file::qualified name"."""
        outer, self.found = self.found, set()
        inner = self.found
        self._restart()
        try:
            yield inner
        finally:
            self.found = outer
            outer |= inner
            self._restart()

    def _restart(self) -> None:
        """Note functions again that were noted before."""
        if sys.version_info >= (3, 12):
            sys.monitoring.restart_events()

    def _on_start(self, code: CodeType, _offset: int) -> Any:
        """Note the start of a function once."""
        self._note(code)
        return sys.monitoring.DISABLE if sys.version_info >= (3, 12) else None

    def _on_profile(self, frame: Any, event: str, _arg: Any) -> None:
        """Note a call."""
        if event == "call":
            self._note(frame.f_code)

    def _note(self, code: CodeType) -> None:
        """Note a function of the library."""
        if code not in self._names:
            self._names[code] = self._name(code)
        name = self._names[code]
        if name is not None:
            self.found.add(name)

    def _name(self, code: CodeType) -> str | None:
        """Return "file::qualified name" of a function, None for one that is not of the library."""
        path = code.co_filename
        if not path.startswith(self._root):
            return None
        parts = path.removeprefix(self._root).split("/")
        parts = parts[1:] if parts[0] == "concent_warp" and parts[1] in LINKED else parts
        return f"{'/'.join(parts)}::{code.co_qualname}" if parts[0] in TOP else None


class Recorder:
    """A plugin of pytest: how long each test takes, how it ends, and which functions it and its fixtures call."""

    def __init__(self, calls: Calls | None) -> None:
        """Record, with functions where `calls` is given."""
        self._calls = calls
        self.failed: str | None = None
        self.tests: dict[str, dict[str, Any]] = {}
        self._collected: set[str] = set()
        self._fixtures: dict[Any, tuple[float, set[str]]] = {}

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note the first failure."""
        if report.failed and self.failed is None:
            self.failed = report.nodeid
        if report.failed or report.skipped:
            self.tests.setdefault(report.nodeid, {})["outcome"] = report.outcome

    def pytest_collectreport(self, report: Any) -> None:
        """Note a file that cannot be imported."""
        if report.failed and self.failed is None:
            self.failed = report.nodeid or "collection"

    def pytest_collection_finish(self) -> None:
        """Note what has run before the first test."""
        self._collected = set() if self._calls is None else set(self._calls.found)

    def imported(self) -> list[str]:
        """Return what every test depends on: what has run before the first one, and the modules imported later."""
        found = set() if self._calls is None else self._calls.found
        return sorted(self._collected | {name for name in found if name.endswith("::<module>")})

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Generator[None, Any, None]:
        """Note what a fixture calls: all tests that use it depend on it, though only the first makes it."""
        begun = time.perf_counter()
        if self._calls is None:
            yield
            return
        with self._calls.collected() as found:
            yield
        self._fixtures[fixturedef] = (time.perf_counter() - begun, set(found))

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Generator[None, Any, None]:
        """Note what a test calls."""
        begun = time.perf_counter()
        if self._calls is None:
            yield
            return
        with self._calls.collected() as found:
            yield
        seconds, called = time.perf_counter() - begun, set(found)
        for definitions in item._fixtureinfo.name2fixturedefs.values():
            spent, within = self._fixtures.get(definitions[-1], (0.0, set()))
            called |= within
            if definitions[-1].scope != "function":
                seconds = max(seconds, spent)  # a run of this test alone makes the fixture
        entry = self.tests.setdefault(item.nodeid, {})
        entry |= {"seconds": seconds, "calls": sorted(called)}


def run(request: dict[str, Any], root: Path, answer: Path) -> None:
    """Run tests in this process and write the answer to a file."""
    calls = Calls(root) if request.get("trace") else None
    recorder = Recorder(calls)
    options = ["-q", "-m", "not slow and not gpu", "--no-header", "-p", "no:cacheprovider", "-p", "no:xdist"]
    options += ["-o", "addopts=", f"--timeout={request['each']}"]
    options += [] if request.get("trace") else ["-x"]
    code = pytest.main([*options, *request["tests"]], plugins=[recorder])
    result = {"outcome": "passed" if int(code) in (0, 5) else "failed", "failed": recorder.failed}
    if calls is not None:
        result |= {"tests": recorder.tests, "imported": recorder.imported()}
    answer.write_text(json.dumps(result))


def forked(request: dict[str, Any], root: Path, folder: Path) -> dict[str, Any]:
    """Return the answer to a request, from a process of its own."""
    answer = folder / "answer.json"
    answer.unlink(missing_ok=True)
    begun = time.monotonic()
    child = os.fork()
    if child == 0:
        os.setsid()
        log = os.open(folder / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(log, 1)
        os.dup2(log, 2)
        with suppress(BaseException):
            run(request, root, answer)
        os._exit(0)
    late = False
    while os.waitpid(child, os.WNOHANG)[0] == 0:
        if time.monotonic() - begun > request["timeout"]:
            late = True
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            break
        time.sleep(0.02)
    with suppress(ProcessLookupError):  # what the tests have left running
        os.killpg(child, signal.SIGKILL)
    seconds = time.monotonic() - begun
    if late:
        return {"outcome": "timed out", "seconds": seconds}
    if not answer.is_file():  # the process has ended by itself
        return {"outcome": "failed", "failed": "crash", "seconds": seconds}
    return json.loads(answer.read_text()) | {"seconds": seconds}


def check_origin(root: Path) -> None:
    """End with a sentence where the library would be imported from elsewhere than the copy."""
    for name in ("concent_warp", *(f"concent_warp.{folder}" for folder in LINKED)):
        spec = importlib.util.find_spec(name)
        if spec is None or not str(spec.origin).startswith(f"{root}/"):
            found = None if spec is None else spec.origin
            raise SystemExit(f"{name} is imported from {found}, not from {root}: remove import hooks that redirect it")


def main() -> None:
    """Answer requests until standard input ends; the working folder is the copy."""
    root, folder = Path.cwd(), Path(sys.argv[1])
    check_origin(root)
    for name in TOP:
        compileall.compile_dir(root / name, quiet=2)
    for name in LARGE:
        importlib.import_module(name)
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        path, before = None, ""
        if request.get("file"):
            path = root / request["file"]
            before = path.read_text()
            path.write_text(request["code"])
        try:
            reply = forked(request, root, folder)
        finally:
            if path is not None:
                path.write_text(before)
        print(json.dumps(reply), flush=True)


if __name__ == "__main__":
    main()
