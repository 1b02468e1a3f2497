"""HDF5 files that survive a full disk.

The HDF5 library ends the process where a write fails while a file is being closed. So it writes to an object that never
fails: that keeps the first error of the disk, lets what follows go nowhere, and says the error once the file is closed.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from concent_warp.errors import ConcentError
from concent_warp.files import new_file


class DiskFile(io.RawIOBase):
    """A new file for `h5py.File` whose writes never fail; `check` says afterwards whether one did."""

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


@contextmanager
def new_hdf5(path: Path) -> Iterator[h5py.File]:
    """Yield an HDF5 file to fill, and give it its name when it is whole on the disk, see `files.new_file`.

    Raises:
        ConcentError: The file cannot be written, as on a full disk; an earlier one is unchanged.
    """
    with new_file(path) as partial, DiskFile(partial) as disk:
        try:
            with h5py.File(disk, "w", libver=("v110", "v110")) as file:
                yield file
        except ConcentError:
            raise
        except Exception:
            disk.check()
            raise
        disk.check()
