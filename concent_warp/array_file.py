"""NumPy's ``.npz`` files: written atomically, and read within bounds, for they may be damaged or hostile."""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.errors import ConcentError
from concent_warp.files import new_file
from concent_warp.limits import limits, raising

KINDS = "biufU"
"""Kinds of arrays that are read: truth values, numbers and text; no objects, which only a pickle can hold."""


def write_arrays(path: Path, arrays: Mapping[str, Any], *, compressed: bool = False) -> None:
    """Write arrays to an ``.npz`` file atomically, see `files.new_file`.

    Raises:
        ConcentError: The file cannot be written, as on a full disk; an earlier one is unchanged.
    """
    with new_file(path) as partial, partial.open("wb") as file:
        (np.savez_compressed if compressed else np.savez)(file, **arrays)


def read_arrays(
    path: Path, names: Collection[str], *, kind: str = "an .npz file", error: type[ConcentError] = ConcentError
) -> dict[str, np.ndarray]:
    """Return the arrays of some names in an ``.npz`` file.

    Args:
        path: The file.
        names: Names of the arrays, all of which it must have.
        kind: What the file is, for messages.
        error: Class of the errors.

    Raises:
        ConcentError: It is no file, damaged or too large, or an array is missing or holds neither numbers nor text.
    """
    if not path.is_file():
        raise error(f"not {kind}", where=path, found="no file" if path.exists() else "nothing of that name")
    try:
        with zipfile.ZipFile(path) as archive:
            size = 0
            for entry in archive.infolist():
                if entry.filename.removesuffix(".npy") in names:
                    size += max(entry.file_size, _declared_bytes(archive, entry))
        if size > (most := limits().document_bytes):
            raise error(
                "the file is too large",
                where=path,
                expected=f"at most {most:,} bytes once unpacked",
                found=f"{size:,}",
                fix=raising("document_bytes"),
            )
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in names}
    except ConcentError:
        raise
    except Exception as caught:  # NumPy and zipfile raise whatever their parsers do
        found = " ".join(str(caught).split())[:300] or type(caught).__name__
        raise error(f"not {kind}", where=path, found=found) from None
    for name, array in arrays.items():
        if array.dtype.kind not in KINDS:
            raise error(f"not {kind}", where=path, expected="numbers and text", found=f"{name} of {array.dtype}")
    return arrays


def _declared_bytes(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> int:
    """Return the bytes that the header of an array declares."""
    from numpy.lib import format as npy

    with archive.open(entry) as file:
        version = npy.read_magic(file)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read(file)
    count = 1
    for side in shape:
        count *= side
    return count * dtype.itemsize
