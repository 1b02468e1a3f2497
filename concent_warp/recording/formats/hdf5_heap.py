"""Checks of global heaps, which the HDF5 library does not do before it reads strings of variable length.

They lie in global heaps, the one part of the format in which damage is not noticed in time (seen with HDF5 2.0): an
object of size 0 makes the library loop for ever, one that is too long makes it read beyond its memory, and a wrong
length of a string makes it allocate gigabytes. Layout: HDF5 file format specification, section III.E.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from concent_warp.errors import RecordingError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
HEAP = b"GCOL\x01"
"""Signature and version of a global heap collection."""
HEADER = 16
"""Bytes of the header of a collection, and of an object in it."""


def check_heaps(path: Path) -> None:
    """Check that the objects of every global heap fill it exactly.

    Raises:
        RecordingError: The file is not HDF5, has unusual field sizes, or a heap is damaged.
    """
    if path.stat().st_size < len(SIGNATURE):
        raise _not_hdf5(path)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = 0
        while data[start : start + len(SIGNATURE)] != SIGNATURE:
            start = max(512, 2 * start)
            if start >= len(data):
                raise _not_hdf5(path)
        version = data[start + 8 : start + 9]
        widths = data[start + 13 : start + 15] if version in (b"\0", b"\1") else data[start + 9 : start + 11]
        if widths != b"\x08\x08":
            raise RecordingError("the HDF5 file has addresses of an unusual size", where=path, expected="8 bytes each")
        heap = data.find(HEAP)
        while heap >= 0:
            _check_heap(data, heap, path)
            heap = data.find(HEAP, heap + 1)


def _check_heap(data: mmap.mmap, start: int, path: Path) -> None:
    """Check the collection that begins at `start`."""
    size = int.from_bytes(data[start + 8 : start + HEADER], "little")
    end, position = start + size, start + HEADER
    sound = position <= end <= len(data)
    while sound and end - position >= HEADER:
        index = int.from_bytes(data[position : position + 2], "little")
        length = int.from_bytes(data[position + 8 : position + HEADER], "little")
        position += length if index == 0 else HEADER + (length + 7) // 8 * 8
        sound = position <= end and (index > 0 or length >= HEADER)
    if not sound:
        raise RecordingError(
            "the HDF5 file is damaged",
            where=path,
            found=f"a broken heap at byte {start}",
            fix="copy or record it again",
        )


def _not_hdf5(path: Path) -> RecordingError:
    """Return the error about a file of another kind."""
    return RecordingError("not an HDF5 file", where=path, fix="check that the file was copied whole")


@contextmanager
def memory_bound(extra: int) -> Iterator[None]:
    """Let the process allocate at most `extra` bytes more; without effect where the system has no such limit."""
    usage = Path("/proc/self/statm")
    if not usage.is_file():
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    bound = int(usage.read_text().split()[0]) * resource.getpagesize() + extra
    resource.setrlimit(resource.RLIMIT_AS, (bound if soft == resource.RLIM_INFINITY else min(soft, bound), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
