"""Files are written whole or not at all."""

import multiprocessing
import os
import resource
import signal
from pathlib import Path

import pytest

from concent_warp.errors import ConcentError
from concent_warp.files import new_file, write_bytes, write_text


def with_small_files(limit: int, path: Path, results) -> None:
    """Write more than `limit` bytes where the system refuses larger files, as a full disk does."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        write_bytes(path, b"x" * (limit + 1))
        results.put("written")
    except ConcentError as error:
        results.put(str(error))


def test_refused_file_leaves_the_earlier_one_and_nothing_else(tmp_path):
    path = tmp_path / "model.toml"
    write_text(path, "earlier")
    context = multiprocessing.get_context("spawn")
    results = context.SimpleQueue()
    process = context.Process(target=with_small_files, args=(1000, path, results))
    process.start()
    process.join(60)
    assert results.get() == (
        f"{path}: the file cannot be written; found File too large; make room on the disk, or choose another place."
    )
    assert [file.name for file in tmp_path.iterdir()] == ["model.toml"]
    assert path.read_text() == "earlier"


def write_half(path: Path) -> None:
    with new_file(path) as partial:
        partial.write_text("half")
        (path.parent / "nowhere").read_text()


def test_failed_writing_leaves_nothing_and_its_error_passes(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        write_half(tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_what_an_ended_process_left_is_replaced(tmp_path):
    (tmp_path / ".a.partial").write_text("a long half of an earlier file")
    write_text(tmp_path / "a", "whole")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a", "whole")]


def write_often(path: Path, letter: str) -> None:
    for _ in range(200):
        write_bytes(path, letter.encode() * 100_000)


def test_two_processes_that_write_one_file_take_turns(tmp_path):
    path = tmp_path / "a"
    processes = [multiprocessing.get_context("spawn").Process(target=write_often, args=(path, s)) for s in "ab"]
    for process in processes:
        process.start()
    seen = set()
    while any(process.is_alive() for process in processes):
        if path.exists():
            seen.add(path.read_bytes())
    assert [process.exitcode for process in processes] == [0, 0]
    assert seen <= {b"a" * 100_000, b"b" * 100_000}
    assert [file.name for file in tmp_path.iterdir()] == ["a"]


def test_devices_and_folders_are_not_replaced(tmp_path):
    for path in (Path(os.devnull), tmp_path):
        with pytest.raises(ConcentError, match="not a file"):
            write_text(path, "text")
