"""Atomic writing of files: the earlier file stays whole until the new one is on the disk."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from concent_warp.errors import ConcentError


@dataclass
class _Claims:
    """Files that a command is going to write."""

    locks: dict[Path, int] = field(default_factory=dict)
    """Descriptors of the locked files that they are written to first, by their names."""
    folders: list[Path] = field(default_factory=list)
    """Folders that were made for them."""


@dataclass(frozen=True)
class _Pending:
    """A written file that has not got its name yet."""

    partial: Path
    path: Path
    lock: int

    def discard(self) -> None:
        """Remove it."""
        self.partial.unlink(missing_ok=True)
        os.close(self.lock)


_claims: ContextVar[_Claims | None] = ContextVar("files that a command is going to write", default=None)
_pending: ContextVar[dict[Path, _Pending] | None] = ContextVar("written files without a name yet", default=None)


@contextmanager
def claimed_files() -> Iterator[None]:
    """Keep the files that `claim` names for this process until the end of the context, and clean up after them."""
    claims = _Claims()
    token = _claims.set(claims)
    try:
        yield
    finally:
        _claims.reset(token)
        for partial, lock in claims.locks.items():
            with suppress(OSError):
                if os.path.samestat(os.fstat(lock), partial.stat()):
                    partial.unlink()
            os.close(lock)
        for folder in reversed(claims.folders):
            with suppress(OSError):
                folder.rmdir()


def claim(path: Path) -> None:
    """Keep a file for this process, within `claimed_files`; without effect outside of it.

    The folder is made; it is removed at the end where nothing was written to it.

    Raises:
        ConcentError: Another process writes the file, or its folder cannot be made.
    """
    claims = _claims.get()
    if claims is None:
        return
    partial = _partial(path)
    key = _key(partial)
    if key in claims.locks:
        return
    try:
        for folder in reversed((path.parent, *path.parent.parents)):
            if not folder.exists():
                folder.mkdir(exist_ok=True)
                claims.folders.append(folder)
        claims.locks[key] = _locked(partial, wait=False)
    except BlockingIOError:
        fix = "wait until it has ended, or choose another name"
        raise ConcentError("another command is writing to this place", where=path, fix=fix) from None
    except OSError as error:
        raise not_written(path, error) from None


@contextmanager
def all_or_none() -> Iterator[None]:
    """Give the files of `new_file` within the context their names at its end, or remove all if something fails."""
    if _pending.get() is not None:
        yield
        return
    pending: dict[Path, _Pending] = {}
    token = _pending.set(pending)
    try:
        yield
        while pending:
            key, file = next(iter(pending.items()))
            try:
                file.partial.replace(file.path)
            except OSError as error:
                raise not_written(file.path, error) from None
            os.close(pending.pop(key).lock)
    finally:
        _pending.reset(token)
        for file in pending.values():
            file.discard()


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
    partial, pending, key = _partial(path), _pending.get(), _key(path)
    if pending is not None and key in pending:
        pending.pop(key).discard()
    try:
        lock = _own_lock(partial)
    except OSError as error:
        raise not_written(path, error) from None
    try:
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
            if pending is not None:
                pending[key] = _Pending(partial, path, os.dup(lock))
            else:
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


def _partial(path: Path) -> Path:
    """Return the name of a file while it is being written."""
    return path.with_name(f".{path.name}.partial")


def _key(path: Path) -> Path:
    """Return one name for all spellings of the path of a file."""
    return path.parent.resolve() / path.name


def _own_lock(partial: Path) -> int:
    """Return the descriptor of an empty file, locked for this process, which may have claimed it before."""
    claims = _claims.get()
    claimed = None if claims is None else claims.locks.get(_key(partial))
    if claimed is not None:
        with suppress(OSError):
            if os.path.samestat(os.fstat(claimed), partial.stat()):
                os.ftruncate(claimed, 0)
                return os.dup(claimed)
    return _locked(partial)


def _locked(path: Path, *, wait: bool = True) -> int:
    """Return the descriptor of an empty file at `path`, locked for this process until it is closed.

    Raises:
        BlockingIOError: Another process has locked it, and it is not to be waited for.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            raise
        except OSError:  # some network disks have no locks
            pass
        try:
            if os.path.samestat(os.fstat(lock), os.stat(path)):  # another process may have moved it meanwhile
                os.ftruncate(lock, 0)
                return lock
        except FileNotFoundError:
            pass
        os.close(lock)


class NotWrittenError(ConcentError):
    """A file that the system refuses to write, as on a full disk."""


def not_written(path: Path, error: OSError) -> NotWrittenError:
    """Return the error that says why a file could not be written."""
    fix = "make room on the disk, or choose another place"
    return NotWrittenError("the file cannot be written", where=path, found=error.strerror or error, fix=fix)


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


class DiskFile(io.RawIOBase):
    """A new file whose writes never fail; `check` says afterwards whether one did.

    For libraries that end the process, or crash, where a write fails while they close a file: HDF5 and FFmpeg.
    """

    def __init__(self, path: Path) -> None:
        """Create the file, or empty it.

        Raises:
            OSError: It cannot be created.
        """
        self.path = path
        self.error: OSError | None = None
        self._raw = io.FileIO(path, "w+")

    def check(self) -> None:
        """Raise what went wrong with a write so far.

        Raises:
            OSError: A write failed, with the name of the file.
        """
        if self.error is not None:
            raise OSError(self.error.errno, self.error.strerror, str(self.path))

    def write(self, data: Any) -> int:
        """Write bytes at the position; nothing once a write has failed."""
        size = memoryview(data).nbytes
        if self.error is None:
            try:
                left = memoryview(data).cast("B")
                while left:
                    left = left[self._raw.write(left) or 0 :]
                return size
            except OSError as error:
                self.error = error
        return size

    def readinto(self, buffer: Any) -> int:
        """Read bytes at the position; zeros where nothing was written."""
        view = memoryview(buffer).cast("B")
        found = self._raw.readinto(view) or 0
        view[found:] = bytes(len(view) - found)
        return len(view)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Set the position."""
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        """Return the position."""
        return self._raw.tell()

    def truncate(self, size: int | None = None) -> int:
        """Set the length."""
        if self.error is None:
            try:
                return self._raw.truncate(size)
            except OSError as error:
                self.error = error
        return 0 if size is None else size

    def flush(self) -> None:
        """Do nothing: nothing is buffered."""

    def readable(self) -> bool:
        """Return True."""
        return True

    def writable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._raw.close()
        super().close()
