"""Vertices of a PLY file by property name: ASCII or binary, properties in any order, sizes checked before reading."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from concent_warp.errors import SceneError

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
"""NumPy types of PLY's scalar types."""
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_HEADER = 65_536
MOST_VERTICES = 20_000_000
"""Larger files are refused rather than fill the memory."""


@dataclass
class PlyElement:
    """One element of the header."""

    name: str
    count: int
    properties: list[tuple[str, str]]
    """Names and NumPy types."""
    has_list: bool = False
    """Whether a property is a list, so that rows differ in length."""


@dataclass(frozen=True)
class PlyHeader:
    """What a PLY file says it holds."""

    format: str
    elements: list[PlyElement]
    size: int
    """Bytes of the header."""

    def count(self, element: str) -> int:
        """Return how many of an element there are."""
        return sum(e.count for e in self.elements if e.name == element)

    def properties(self, element: str) -> set[str]:
        """Return the names of the scalar properties of an element."""
        return {name for e in self.elements if e.name == element for name, _ in e.properties}


def read_header(path: Path) -> PlyHeader:
    """Read the header of a PLY file; raises `SceneError` where it is not one."""
    if not path.is_file():
        raise SceneError("no such file", where=path, expected="a .ply file")
    with path.open("rb") as file:
        start = file.read(LONGEST_HEADER)
    end = start.find(b"end_header")
    line_end = start.find(b"\n", end)
    if not start.startswith(b"ply") or end < 0 or line_end < 0:
        raise SceneError("not a PLY file", where=path, expected="a header from 'ply' to 'end_header'")
    lines = start[:end].decode("ascii", errors="replace").splitlines()
    form, elements = "", []
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) >= 2:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit():
            elements.append(PlyElement(words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in TYPES:
            elements[-1].properties.append((words[2], TYPES[words[1]]))
        elif words[0] == "property" and elements and len(words) == 5 and words[1] == "list":
            elements[-1].has_list = True
        else:
            raise SceneError("a line of the PLY header cannot be read", where=path, found=repr(line))
    if form not in ORDERS:
        raise SceneError("unknown PLY format", where=path, expected=f"one of {sorted(ORDERS)}", found=repr(form))
    return PlyHeader(form, elements, line_end + 1)


def read_vertices(path: Path) -> dict[str, np.ndarray]:
    """Read the properties of the vertices of a PLY file.

    Returns:
        Values by property name, each of shape (n,), float64 for floating-point properties.

    Raises `SceneError` where the file is broken, holds no vertices, or far too many.
    """
    header = read_header(path)
    before = 0
    for element in header.elements:
        if element.name == "vertex":
            break
        if element.has_list and element.count:
            raise SceneError("the vertices follow lists of unknown length", where=path, expected="vertices first")
        before += element.count * (1 if header.format == "ascii" else _row_type(element, "<").itemsize)
    else:
        raise SceneError("the PLY file has no vertices", where=path, expected="'element vertex'")
    if not 0 < element.count <= MOST_VERTICES:
        raise SceneError(
            "the number of vertices cannot be worked with", where=path, expected=f"1 to {MOST_VERTICES:,}",
            found=f"{element.count:,}",
        )  # fmt: skip
    if element.has_list:
        raise SceneError("a vertex property is a list", where=path, expected="scalar properties")
    names = [name for name, _ in element.properties]
    if len(set(names)) < len(names):
        raise SceneError("a vertex property occurs twice", where=path, found=names)
    if header.format == "ascii":
        table = _read_ascii(path, header, before, element)
        return {name: table[:, k] for k, name in enumerate(names)}
    row = _row_type(element, ORDERS[header.format])
    needed, found = header.size + before + element.count * row.itemsize, path.stat().st_size
    if found < needed:
        raise SceneError("the PLY file is cut short", where=path, expected=f"at least {needed} bytes", found=found)
    rows = np.fromfile(path, dtype=row, count=element.count, offset=header.size + before)
    return {name: rows[name].astype(float) for name in names}


def _read_ascii(path: Path, header: PlyHeader, before: int, element: PlyElement) -> np.ndarray:
    """Read the vertex rows of an ASCII file, shape (count, properties)."""
    with path.open("rb") as file:
        file.seek(header.size)
        lines = [file.readline() for _ in range(before + element.count)][before:]
    try:
        table = np.loadtxt(io.BytesIO(b"".join(lines)), ndmin=2)
    except ValueError as error:
        raise SceneError("a vertex of the PLY file cannot be read", where=path, found=error) from None
    if table.shape != (element.count, len(element.properties)):
        raise SceneError(
            "the PLY file is cut short or has rows of the wrong length", where=path,
            expected=(element.count, len(element.properties)), found=table.shape,
        )  # fmt: skip
    return table


def _row_type(element: PlyElement, order: str) -> np.dtype:
    """Return the NumPy type of one row of an element without lists."""
    return np.dtype([(name, order + kind) for name, kind in element.properties])
