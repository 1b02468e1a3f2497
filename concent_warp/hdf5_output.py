"""HDF5 files that survive a full disk.

The HDF5 library ends the process where a write fails while a file is being closed. So it writes to an object that never
fails: that keeps the first error of the disk, lets what follows go nowhere, and says the error once the file is closed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from concent_warp.errors import ConcentError
from concent_warp.files import DiskFile, new_file


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
