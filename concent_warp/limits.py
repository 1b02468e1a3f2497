"""Limits of the size of input files, checked before anything is loaded; environment variables raise them."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, fields

PREFIX = "CONCENT_MAX_"
"""Begins the name of the environment variable of each limit, such as ``CONCENT_MAX_SCENE_SECONDS``."""


@dataclass(frozen=True)
class Limits:
    """Sizes above which an input is refused, each far above what recordings and scenes of robots have."""

    recording_bytes: int = 8 << 30
    """Arrays of one recording, once in memory [bytes]: an hour of a hundred channels at 1 kHz, or two minutes of
    RGB-D."""
    unpacked_bytes: int = 1 << 29
    """Arrays of one recording that may be compressed as strongly as gzip can [bytes], see `inflation`."""
    inflation: int = 30
    """Bytes in memory per byte in the file, above `unpacked_bytes`: images reach 3 to 10."""
    samples: int = 10_000_000
    """Samples of one channel: an hour at 2.7 kHz."""
    channels: int = 10_000
    """Channels of one kind in one demonstration."""
    demonstrations: int = 100_000
    """Demonstrations of one recording."""
    duration: float = 86_400.0
    """Time of the last sample of a demonstration [s]: one day."""
    steps: int = 4_000_000
    """Simulation steps that one replay may take: two hours at 500 Hz, or one hour at 1 kHz."""
    text_bytes: int = 1 << 20
    """A text attribute, such as the task [bytes]."""
    file_bytes: int = 1 << 30
    """One CSV file, one geometry, one mesh, or one ``.pt`` toss [bytes]; HDF5 files are bounded by what they declare
    instead."""
    checkpoint_bytes: int = 4 << 30
    """A checkpoint of a training, in the file and in memory [bytes]: a thousand million numbers of single precision."""
    document_bytes: int = 256 << 20
    """One TOML or JSON file [bytes]; its text takes about ten times as much once read."""
    chunk_bytes: int = 256 << 20
    """One chunk of an HDF5 dataset, uncompressed: several frames of any camera [bytes]."""
    scene_bytes: int = 256 << 20
    """MJCF text, with its meshes written as numbers [bytes]."""
    scene_depth: int = 490
    """Elements within one another in an MJCF, includes counted in; MuJoCo itself reads 500 in one file."""
    scene_copies: int = 100_000
    """Bodies that the <replicate>, <composite> and <flexcomp> elements of a scene may ask for."""
    scene_cells: int = 1 << 26
    """Pixels of a texture, or cells of a height field: 8192 x 8192."""
    scene_count: int = 1_000_000
    """Any other size that a scene asks for: user data, key frames, contacts, numbers of a sensor, iterations of a
    solver."""
    scene_arena_bytes: int = 2 << 30
    """Memory of a simulation that a scene asks for in <size memory> [bytes]."""
    scene_seconds: float = 6.0
    """Time that MuJoCo may take to compile a large or unusual scene [s]."""
    scene_memory_bytes: int = 3 << 29
    """Memory that MuJoCo may take to compile a large or unusual scene [bytes]."""


def limits() -> Limits:
    """Return the limits, with those that environment variables set.

    A variable that is not a number above 0 is ignored.
    """
    given = {}
    for field in fields(Limits):
        kind = type(field.default)
        try:
            value = float(os.environ[variable(field.name)])
        except (KeyError, ValueError):
            continue
        if math.isfinite(value) and value > 0:
            given[field.name] = kind(value)
    return Limits(**given)


def variable(name: str) -> str:
    """Return the environment variable that sets a limit."""
    return PREFIX + name.upper()


def raising(name: str) -> str:
    """Return the advice that says how to raise a limit."""
    return f"if this is meant, set {variable(name)} higher"
