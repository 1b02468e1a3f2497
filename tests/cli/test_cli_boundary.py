"""Whatever stops a command becomes one sentence and an exit code, never a traceback."""

import os
import re
import signal
import subprocess
import sys
import time
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest

from concent_warp.cli import boundary, entry, main
from concent_warp.cli.entry import COMMANDS


class OutOfMemoryError(RuntimeError):
    """An error by the name that torch uses."""


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (KeyError("x"), 1, "no check foresaw (KeyError: 'x')"),
        (RuntimeError("a\nb\x1b[31m"), 1, r"(RuntimeError: a b\x1b[31m)"),
        (AssertionError(), 1, "(AssertionError)"),
        (MemoryError(), 2, "the memory is not enough"),
        (OutOfMemoryError("CUDA"), 2, "the memory is not enough"),
        (RecursionError(), 2, "nested too deeply"),
        (OSError(28, "No space left on device"), 2, "No space left on device; check the path and the disk."),
        (UnicodeEncodeError("ascii", "é", 0, 1, "no"), 1, "UnicodeEncodeError"),
        (KeyboardInterrupt("Go on."), 130, "interrupted. Go on."),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_what_stops_a_command_is_said_in_one_sentence(command, error, code, words, monkeypatch, tmp_path, capsys):
    def stop(*_):
        raise error

    monkeypatch.setattr(boundary.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(entry, "_run", stop)
    assert main([command, "input"]) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.strip().startswith(f"concent {command}: ")
    assert words in err
    assert err.strip().count("\n") == 0
    logs = list(tmp_path.glob("concent_*.log"))
    if not isinstance(error, (OSError, KeyboardInterrupt)):
        assert [str(log) for log in logs] == re.findall(r"\S+\.log", err)
        assert "Traceback" in logs[0].read_text()
    else:
        assert logs == []


def test_without_a_place_for_the_details_the_sentence_comes_all_the_same(monkeypatch, capsys):
    def stop(*_):
        raise KeyError("x")

    def full(**_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(boundary.tempfile, "mkstemp", full)
    monkeypatch.setattr(entry, "_run", stop)
    assert main(["fit"]) == 1
    assert capsys.readouterr().err.endswith("(KeyError: 'x'); check the input.\n")


def shell(command, **environment):
    return subprocess.run(
        ["bash", "-c", command.replace("concent", f"{sys.executable} -m concent_warp")],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
        timeout=120,
    )


def without_loading(said: str) -> str:
    """Return what a command says but for the line that appears where loading takes long."""
    return "".join(line for line in said.splitlines(keepends=True) if not line.endswith(": loading ...\n"))


@pytest.mark.parametrize("command", ["concent --help", "concent --version", "concent fit --help"])
def test_a_full_disk_behind_standard_output_is_one_sentence(command):
    done = shell(f"{command} > /dev/full")
    assert done.returncode == 2
    assert "No space left on device" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_closed_standard_output_or_error_is_no_failure(bench):
    for closed in (">&-", "2>&-", ">&- 2>&-"):
        done = shell(f"concent compare {bench / 'demo.h5'} --model {bench / 'inset.toml'} {closed}")
        assert (done.returncode, without_loading(done.stderr)) == (0, ""), closed
    assert shell("concent compare nowhere.h5 2>&-").returncode == 2


def test_a_terminal_of_ascii_alone_gets_the_whole_table(bench):
    command = f"concent compare {bench / 'demo.h5'} --model {bench / 'inset.toml'} --baseline {bench / 'surface.toml'}"
    done = shell(command, PYTHONIOENCODING="ascii", PYTHONUTF8="0", LC_ALL="C")
    assert (done.returncode, without_loading(done.stderr)) == (0, "")
    assert "block" in done.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_fails_where_its_help_cannot_be_written(command, monkeypatch, capsys):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main([command, "--help"]) == 2
        monkeypatch.undo()
    assert "No space left on device" in capsys.readouterr().err
    monkeypatch.setattr(sys, "stdout", None)
    assert main([command, "--help"]) == 0
    monkeypatch.setattr(sys, "stdout", text := TextIOWrapper(BytesIO(), encoding="ascii"))
    assert main([command, "--help"]) == 0
    assert text.buffer.getvalue().startswith(b"usage: concent")  # pyright: ignore[reportAttributeAccessIssue]


PARALLEL = """
import sys, time
import numpy as np
import concent_warp.cli.entry as entry
from concent_warp.diagnosis.tasks import TaskRunner

def run(*_):
    many = np.zeros(1_000_000)  # so large that joblib shares them through a file
    for found in TaskRunner(2).results(time.sleep, [(0.0,), (0.0,)]):
        pass
    for found in TaskRunner(2).results(pause, [(many, 0.0), (many, 60.0), (many, 60.0)]):
        print("running", flush=True)

def pause(many, seconds):
    time.sleep(seconds)

entry._run = run
sys.exit(entry.main(["diagnose"]))
"""


def test_termination_leaves_no_files_of_parallel_processes(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", PARALLEL],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "running\n"

    def shared():
        return [path for folder in (Path("/dev/shm"), tmp_path) for path in folder.glob(f"*[-_]{process.pid}[-_]*")]

    assert any("joblib" in path.name for path in shared())
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 143
    # joblib's process that removes what the others leave may say what it found, where it comes before them.
    said, *found = err.split("\n/")
    assert said.removesuffix("\n") == "\nconcent diagnose: terminated."
    assert all("resource_tracker" in warning for warning in found)
    end = time.monotonic() + 20
    while shared() and time.monotonic() < end:
        time.sleep(0.1)
    assert shared() == []


SLEEPING = """
import sys, time
import concent_warp.cli.entry as entry

def run(*_):
    try:
        print("running", flush=True)
        time.sleep(60)
    finally:
        print("cleaned up", flush=True)

entry._run = run
sys.exit(entry.main(["fit"]))
"""


def test_termination_cleans_up_as_an_interruption_does():
    process = subprocess.Popen(
        [sys.executable, "-c", SLEEPING], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "running\n"
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 143
    assert out == "cleaned up\n"
    assert err == "\nconcent fit: terminated.\n"
