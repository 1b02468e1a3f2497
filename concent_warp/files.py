"""Atomic writing of files: the earlier file stays whole until the new one is on the disk."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from concent_warp.errors import ConcentError


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield the name of a file to write in the folder of `path`, and move it to `path` when it is whole on the disk.

    Processes that write to the same path take turns. The file is removed if its writing fails. HDF5 cannot write to it,
    since it locks files itself: it can write to memory, and `write_bytes` to the disk.

    Raises:
        ConcentError: The file cannot be written, as on a full disk; an earlier one is unchanged.
    """
    if path.exists() and not path.is_file():
        raise ConcentError("not a file", where=path, expected="the name of a file to write")
    partial = path.with_name(f".{path.name}.partial")
    try:
        lock = _locked(partial)
    except OSError as error:
        raise not_written(path, error) from None
    try:
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    except OSError as error:
        if error.filename not in (None, str(partial), str(path)):
            raise
        raise not_written(path, error) from None
    finally:
        os.close(lock)


def _locked(path: Path) -> int:
    """Return the descriptor of an empty file at `path`, locked for this process until it is closed."""
    try:
        import fcntl
    except ImportError:  # Windows
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        with suppress(OSError):  # some network disks have no locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            if os.path.samestat(os.fstat(lock), os.stat(path)):  # another process may have moved it meanwhile
                os.ftruncate(lock, 0)
                return lock
        except FileNotFoundError:
            pass
        os.close(lock)


def not_written(path: Path, error: OSError) -> ConcentError:
    """Return the error that says why a file could not be written."""
    fix = "make room on the disk, or choose another place"
    return ConcentError("the file cannot be written", where=path, found=error.strerror or error, fix=fix)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically, see `new_file`."""
    with new_file(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, see `new_file`."""
    write_bytes(path, text.encode())


def write_json(path: Path, document: Any) -> None:
    """Write a JSON file atomically, see `new_file`."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")
