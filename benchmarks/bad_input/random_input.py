"""Sound inputs changed at random: each is accepted or refused with one `ConcentError`."""

from __future__ import annotations

import dataclasses
import io
import json
import re
import tempfile
import warnings
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.bad_input.sound_inputs import SCENE, servo_log, sound_recording, write_recording_and_model
from concent_warp.errors import ConcentError
from concent_warp.model import Model
from concent_warp.recording.formats.bam import read_bam
from concent_warp.recording.formats.csv import read_csv
from concent_warp.recording.formats.hdf5 import read_hdf5
from concent_warp.scene.scene import Scene

NUMBERS = ("0", "-1", "1", "0.5", "1e-9", "1e9", "1e300", "-1e300", "1e400", "nan", "inf", "-inf", "-0.0", "9" * 400)
"""Numbers that are often wrong."""
WORDS = (
    *NUMBERS, "", " ", "x", "true", "[]", "{}", "''", '"', "\x00", "\x1b[31m", "\u202e", "\ud7ff", "é", "0x10", "1_0",
    "1,5", "../..", "/dev/zero", "a b c", "1 2 3", "0 0 0 0", "%s", "$(id)",
)  # fmt: skip
"""Texts in place of a value."""
LINE = re.compile(r"[^\n]+[.?]")


@dataclass
class Tried:
    """What became of the examples of one kind."""

    refused: int = 0
    accepted: int = 0
    faults: list[str] = field(default_factory=list)
    """Examples that raised something else, or whose message is not one printable line."""


def random_outcomes(examples: int) -> dict[str, Tried]:
    """Return what became of a number of random inputs of each kind."""
    with tempfile.TemporaryDirectory() as folder:
        return {name: tried(kind, examples, Path(folder)) for name, kind in KINDS.items()}


def tried(kind: Kind, examples: int, folder: Path) -> Tried:
    """Return what became of examples of one kind, the same ones each time.

    Args:
        kind: The kind.
        examples: How many to try.
        folder: Where its files are written.
    """
    found = Tried()
    folder.mkdir(exist_ok=True)

    checks = [HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]

    @settings(max_examples=examples, deadline=None, derandomize=True, database=None, suppress_health_check=checks)
    @given(kind.examples)
    def run(example: Any) -> None:
        try:
            with warnings.catch_warnings(action="ignore"):
                kind.read(example, folder)
        except ConcentError as error:
            found.refused += 1
            if not (LINE.fullmatch(str(error)) and str(error).isprintable()):
                found.faults.append(f"{example!r}: {error}")
        except Exception as error:
            found.faults.append(f"{example!r}: {type(error).__name__}: {error}")
        else:
            found.accepted += 1

    run()
    return found


@dataclass(frozen=True)
class Kind:
    """A kind of random input."""

    examples: st.SearchStrategy[Any]
    """What is tried."""
    read: Callable[[Any, Path], object]
    """Reads an example, with files in a folder; raises a ConcentError if it is refused."""


@cache
def sound_bytes() -> bytes:
    """Return the bytes of a sound recording."""
    with tempfile.TemporaryDirectory() as folder:
        return write_recording_and_model(Path(folder))[0].read_bytes()


def equal(a: Any, b: Any) -> bool:
    """Return whether two trees of dataclasses, containers and arrays are equal; NaN equals NaN."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(
            equal(getattr(a, one.name), getattr(b, one.name)) for one in dataclasses.fields(a) if one.name != "source"
        )
    if isinstance(a, Mapping):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(equal, a, b))
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return a == b


def read_changed(content: bytes, folder: Path) -> None:
    """Read a damaged recording; what is accepted is to be what was written."""
    path = folder / "recording.h5"
    path.write_bytes(content)
    assert equal(read_hdf5(path), sound_recording()), "a damaged recording is read as something else"


def read_flipped(flips: list[tuple[float, int]], folder: Path) -> None:
    """Read a recording with flipped bits, each at a share of its length."""
    content = bytearray(sound_bytes())
    for share, bit in flips:
        content[int(share * len(content))] ^= 1 << bit
    read_changed(bytes(content), folder)


def read_overwritten(example: tuple[float, bytes, float], folder: Path) -> None:
    """Read a recording of which a part is overwritten and the end is cut off."""
    place, new, end = example
    content = bytearray(sound_bytes())
    start = int(place * len(content))
    content[start : start + len(new)] = new
    read_changed(bytes(content[: int(end * len(content)) + 1]), folder)


def read_table(example: tuple[str, list[list[str]], str], folder: Path) -> None:
    """Read a CSV folder with one file of some cells."""
    sensor, rows, separator = example
    (folder / "csv").mkdir(exist_ok=True)
    for path in (folder / "csv").glob("*.csv"):
        path.unlink()
    (folder / "csv" / "scene.xml").write_text(SCENE)
    text = "\n".join(separator.join(row) for row in rows)
    (folder / "csv" / f"measured_{sensor}.csv").write_text(text, encoding="utf-8", errors="surrogatepass")
    read_csv(folder / "csv")


def replaced(text: str, pattern: str, share: float, new: str) -> str:
    """Return a text with another one in place of one match of a pattern."""
    matches = list(re.finditer(pattern, text))
    found = matches[int(share * len(matches))]
    return text[: found.start(1)] + new + text[found.end(1) :]


def read_model(example: tuple[float, str], folder: Path) -> None:
    """Read a model whose file has another value, or another text, in one place."""
    _, path = write_recording_and_model(folder)
    text = replaced(path.read_text(), r"([\w.\-]+|\"[^\"]*\"|\[|\]|=)", *example)
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    Model.load(path)


def compile_scene(example: tuple[float, str], _: Path) -> None:
    """Compile a scene with another value of one attribute."""
    share, value = example
    escaped = value.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    assert Scene(replaced(SCENE, r'="([^"]*)"', share, escaped)).model.nbody


def read_log(example: tuple[float, str], folder: Path) -> None:
    """Read a servo log with another value in one place."""
    path = folder / "servo.json"
    text = replaced(json.dumps(servo_log()), r"([\w.\-]+|\"[^\"]*\"|\[|\]|\{|:)", *example)
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    read_bam(path)


def parse_option(example: tuple[tuple[str, str], str], folder: Path) -> None:
    """Give a command an option with some value; the command itself is not run."""
    from unittest.mock import patch

    from concent_warp.cli import main
    from concent_warp.cli.commands import diagnose, geometry, locate

    (command, option), value = example
    module = {"diagnose": diagnose, "geometry": geometry, "locate": locate}[command]
    said = io.StringIO()
    with patch.object(module, "run"), redirect_stderr(said), redirect_stdout(io.StringIO()):
        code = main([command, str(folder / "input"), option, *value.split(" ")])
    lines = [line for line in said.getvalue().splitlines() if "loading ..." not in line]
    if code == 2:
        raise ConcentError("\n".join(lines).removesuffix("."))
    assert (code, lines) == (0, []), lines


def timed(rows: list[list[str]]) -> list[list[str]]:
    """Return rows with rising times in the first column."""
    return [[f"{k / 100}", *row[1:]] for k, row in enumerate(rows)]


SHARE = st.floats(0, 1, exclude_max=True)
WORD = st.sampled_from(WORDS) | st.floats().map(str) | st.integers().map(str) | st.text(max_size=8)
CELL = st.floats(-1, 1).map(str) | st.sampled_from(("0", "0.01", "0.02", "0.1", "")) | WORD
HEADER = st.sampled_from(("time", "x", "y", "z", "w", "qx", "angle", "elbow", "angle_deg", "time_ms", "")) | WORD
ROWS = st.integers(2, 5).flatmap(
    lambda width: st.tuples(
        st.lists(HEADER, min_size=width, max_size=width).map(lambda names: ["time", *names[1:]]),
        st.lists(st.lists(CELL, min_size=width, max_size=width), max_size=4),
        st.booleans(),
    ).map(lambda parts: [parts[0], *(timed(parts[1]) if parts[2] else parts[1])])
)
OPTIONS = (
    ("diagnose", "--window"), ("diagnose", "--additions"), ("diagnose", "--seed"), ("diagnose", "--jobs"),
    ("diagnose", "--effects"), ("diagnose", "--engine"), ("geometry", "--count"), ("geometry", "--radius"),
    ("geometry", "--counts"), ("geometry", "--friction"), ("geometry", "--scale"), ("geometry", "--overshoot"),
    ("locate", "--window"), ("locate", "--png"),
)  # fmt: skip
"""Options of commands whose parsers are fast."""
KINDS = {
    "HDF5, flipped bits": Kind(st.lists(st.tuples(SHARE, st.integers(0, 7)), min_size=1, max_size=3), read_flipped),
    "HDF5, overwritten and cut": Kind(
        st.tuples(SHARE, st.binary(min_size=1, max_size=64), st.just(0.999999) | SHARE), read_overwritten
    ),
    "CSV cells": Kind(
        st.tuples(
            st.sampled_from(("elbow_angle", "block_position", "block_orientation", "knee")),
            ROWS,
            st.sampled_from((",", ",", ",", ";", "\t")),
        ),
        read_table,
    ),
    "TOML values": Kind(st.tuples(SHARE, WORD), read_model),
    "MJCF attributes": Kind(st.tuples(SHARE, WORD), compile_scene),
    "JSON values": Kind(st.tuples(SHARE, WORD), read_log),
    "option values": Kind(st.tuples(st.sampled_from(OPTIONS), WORD), parse_option),
}
