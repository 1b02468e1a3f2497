"""Recordings as folders of CSV files.

A folder holds ``scene.xml`` and, either in itself or in ``demo_*`` subfolders (one per demonstration):

- ``measured_<sensor>.csv``: a header row, ``time`` and one name per number of the sensor; then one row per sample.
  Names of components (``x``, ``qw``, ``pos_z``) say the order, see `csv_columns`; other names are read as they stand.
- ``action_<actuator>.csv``: the same with one value column.
- ``initial.csv``, optional: a row ``qpos,...`` and a row ``qvel,...`` with the state at time 0.
- ``noise.csv``, optional: a row ``<sensor>,<number>`` for each sensor whose noise is known, the standard deviation of
  one of its numbers; of an orientation of a component of the rotation vector [rad]. Beside ``scene.xml`` it holds for
  all demonstrations.

- ``payloads.csv``, optional: below a header ``body,mass,x,y,z``, or ``body,mass,x,y,z,ixx,iyy,izz``, a row for each
  known weight that a body carried and the scene does not have, see `Payload`.

Cells are SI numbers with a decimal point, separated by commas; an empty cell is a missing value. A ``/`` in a name is
written as ``%2F`` in the file's name. Files of other kinds are left alone.
"""

from __future__ import annotations

import csv
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.errors import RecordingError, SceneError
from concent_warp.limits import limits, raising
from concent_warp.recording.formats.csv_columns import check_command_column, column_order
from concent_warp.recording.naming import PREFIX, by_number, name_of
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.time_zero import counted_from_first_sample
from concent_warp.recording.validation.validate import validate
from concent_warp.scene.payloads import PAYLOAD_HEADER, PAYLOAD_NUMBERS, Payload
from concent_warp.scene.scene import Scene

SCENE = "scene.xml"
INITIAL = "initial.csv"
NOISE = "noise.csv"
PAYLOADS = "payloads.csv"


def read_csv(folder: Path) -> Recording:
    """Read and validate a folder of CSV files.

    Raises:
        RecordingError: Something is missing, a cell is no number, or a rule of `validate` is broken.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RecordingError("no such folder of CSV files", where=folder, fix="check the path")
    if not (folder / SCENE).is_file():
        raise RecordingError("the folder has no scene", where=folder, expected=SCENE, fix="put the MJCF into it")
    nested = sorted((f for f in folder.glob(f"{PREFIX}*") if f.is_dir()), key=lambda f: by_number(f.name))
    if nested and any(path.name != NOISE for path in folder.glob("*.csv")):
        raise RecordingError(
            "the folder has CSV files of its own beside its demonstrations",
            where=folder,
            expected=f"CSV files in {PREFIX}* folders only",
            fix="move them into the folder of their demonstration",
        )
    if len(nested) > limits().demonstrations:
        raise RecordingError(
            "too many demonstrations",
            where=folder,
            expected=limits().demonstrations,
            fix=raising("demonstrations"),
            found=len(nested),
        )
    for demonstration in nested:
        if (demonstration / SCENE).exists():
            raise RecordingError("a demonstration has a scene of its own", where=demonstration, fix=f"remove {SCENE}")
    try:
        scene = Scene.from_mjcf(folder / SCENE)
        m = scene.model
    except SceneError as error:
        raise RecordingError("the scene of the recording cannot be read", found=str(error).rstrip(".")) from None
    _check_size(folder)
    demonstrations = tuple(_read_demonstration(f, f.name, m) for f in nested) or (
        _read_demonstration(folder, f"{PREFIX}0", m),
    )
    if nested and (folder / NOISE).exists():
        demonstrations = _with_noise(demonstrations, _read_noise(folder / NOISE), folder / NOISE)
    recording = Recording(scene.xml, demonstrations, str(folder))
    recording = counted_from_first_sample(recording)
    validate(recording)
    return recording


def _check_size(folder: Path) -> None:
    """Refuse files that are too large, one by one and together, before any is read."""
    total = 0
    for path in folder.rglob("*.csv"):
        size = path.stat().st_size
        total += size
        if size > limits().file_bytes or total > limits().recording_bytes:
            raise RecordingError(
                "the CSV files are too large",
                where=path,
                expected=f"at most {limits().file_bytes} bytes a file and {limits().recording_bytes} in all",
                found=f"{size} and {total}",
                fix=raising("file_bytes"),
            )


def _read_demonstration(folder: Path, name: str, m: mujoco.MjModel) -> Demonstration:
    """Read the CSV files of one demonstration."""
    action: dict[str, Channel] = {}
    measured: dict[str, Channel] = {}
    state: dict[str, np.ndarray] = {}
    noise: dict[str, float] = {}
    payloads: tuple[Payload, ...] = ()
    paths = sorted(folder.glob("*.csv"))
    if not paths:
        raise RecordingError(
            "the folder has no CSV files", where=folder, expected="measured_<sensor>.csv or action_<actuator>.csv"
        )
    if len(paths) > limits().channels:
        raise RecordingError(
            "too many CSV files",
            where=folder,
            expected=f"at most {limits().channels}",
            fix=raising("channels"),
            found=len(paths),
        )
    for path in paths:
        kind, _, channel = path.stem.partition("_")
        if path.name == INITIAL:
            state = _read_state(path)
        elif path.name == NOISE:
            noise = _read_noise(path)
        elif path.name == PAYLOADS:
            payloads = tuple(_read_payloads(path))
        elif kind == "measured" and channel:
            header, table = _read_table(path)
            order = column_order(path, header[1:], m, name_of(channel))
            measured[name_of(channel)] = Channel(table[:, 0], table[:, 1:][:, order])
        elif kind == "action" and channel:
            header, table = _read_table(path)
            if table.shape[1] != 2:
                raise RecordingError(
                    "wrong number of columns", where=path, expected="time and one value", found=table.shape[1]
                )
            check_command_column(path, header[1:], m, name_of(channel))
            action[name_of(channel)] = Channel(table[:, 0], table[:, 1])
        else:
            raise RecordingError(
                "a CSV file has a name that says nothing",
                where=path,
                expected=f"measured_<sensor>.csv, action_<actuator>.csv, {INITIAL}, {NOISE} or {PAYLOADS}",
                fix="rename it or take it out of the folder",
            )
    found = Demonstration(name, "", None, state.get("qpos"), state.get("qvel"), action, measured, payloads=payloads)
    return _with_noise((found,), noise, folder / NOISE)[0]


def _with_noise(found: tuple[Demonstration, ...], noise: dict[str, float], path: Path) -> tuple[Demonstration, ...]:
    """Return demonstrations with the noise of some channels, as a file states it."""
    known = sorted({channel for d in found for channel in d.measured})
    if unknown := sorted(set(noise) - set(known)):
        raise RecordingError(
            "noise of a channel that was not measured", where=path, expected=f"some of {known}", found=unknown
        )
    return tuple(
        replace(d, measured={n: replace(c, noise_std=noise.get(n, c.noise_std)) for n, c in d.measured.items()})
        for d in found
    )


def _read_noise(path: Path) -> dict[str, float]:
    """Read the noise of channels: rows of a name and a number, below a header ``sensor,...`` where there is one."""
    noise: dict[str, float] = {}
    for line, cells in _read_rows(path):
        name, where = cells[0].strip(), f"{path}, line {line}"
        if not noise and name.lower() in ("sensor", "channel", "name"):
            continue
        if len(cells) != 2 or name in noise:
            raise RecordingError(
                "not a row of noise", where=where, expected="a sensor, once, and a number", found=",".join(cells)[:80]
            )
        noise[name] = _number(cells[1], path, line, name)
        if not (np.isfinite(noise[name]) and noise[name] > 0):
            raise RecordingError("noise makes no sense", where=where, expected="a number above 0", found=cells[1][:40])
    return noise


def _read_payloads(path: Path) -> Iterator[Payload]:
    """Read the weights that bodies carried: rows below a header, see the module."""
    header: tuple[str, ...] = ()
    for line, cells in _read_rows(path):
        if not header:
            header = tuple(cell.strip().lower() for cell in cells)
            if header not in (PAYLOAD_HEADER, PAYLOAD_HEADER[:5]):
                raise RecordingError(
                    "the header row is missing",
                    where=f"{path}, line {line}",
                    expected=f"{','.join(PAYLOAD_HEADER)}, with or without the last three",
                    found=repr(",".join(cells))[:80],
                )
            continue
        if len(cells) != len(header):
            where = f"{path}, line {line}"
            raise RecordingError(
                "a row has the wrong number of cells", where=where, expected=len(header), found=len(cells)
            )
        numbers = [_number(cell, path, line, column) for cell, column in zip(cells[1:], header[1:], strict=True)]
        yield Payload.of(cells[0].strip(), [*numbers, *[0.0] * (PAYLOAD_NUMBERS - len(numbers))])


def _read_table(path: Path) -> tuple[list[str], np.ndarray]:
    """Return the header of a channel's file and the numbers below it, shape (T, columns); column 0 is time [s]."""
    rows = _read_rows(path)
    header = [cell.strip().lower() for cell in next(rows, (1, []))[1]]
    if len(header) < 2 or header[0] != "time":
        raise RecordingError(
            "the header row is missing",
            where=f"{path}, line 1",
            expected="time,<name>,... separated by commas",
            found=repr(",".join(header))[:80] if header else "an empty file",
        )
    table = array("d")
    for line, cells in rows:
        if len(cells) != len(header):
            where = f"{path}, line {line}"
            raise RecordingError(
                "a row has the wrong number of cells", where=where, expected=len(header), found=len(cells)
            )
        table.extend(_number(cell, path, line, column) for column, cell in zip(header, cells, strict=True))
    if not table:
        raise RecordingError("the file has no rows below its header", where=path, expected="one row per sample")
    return header, np.array(table).reshape(-1, len(header))


def _read_state(path: Path) -> dict[str, np.ndarray]:
    """Read the state at time 0: rows that begin with ``qpos`` and ``qvel``."""
    state: dict[str, np.ndarray] = {}
    for line, cells in _read_rows(path):
        key = cells[0].strip()
        if key not in ("qpos", "qvel") or key in state:
            raise RecordingError(
                "unknown or repeated row", where=f"{path}, line {line}", expected="qpos and qvel, once", found=repr(key)
            )
        state[key] = np.array([_number(cell, path, line, key) for cell in cells[1:]])
    return state


def _read_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are not blank, each with its line number."""
    most = limits().samples
    if not path.is_file():
        raise RecordingError("not a CSV file", where=path, expected="a file", found="a folder, device or pipe")
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            for cells in reader:
                if reader.line_num > most:
                    raise RecordingError(
                        "too many rows", where=path, expected=f"at most {most}", fix=raising("samples")
                    )
                if cells:
                    yield reader.line_num, cells
    except (csv.Error, UnicodeDecodeError, OSError) as error:
        raise RecordingError("not a CSV file", where=path, expected="UTF-8 text", found=error) from None


def _number(cell: str, path: Path, line: int, column: str) -> float:
    """Return the number in a cell; NaN where it is empty."""
    cell = cell.strip()
    if not cell:
        return float("nan")
    try:
        if "_" in cell or not cell.isascii():
            raise ValueError
        return float(cell)
    except ValueError:
        raise RecordingError(
            f"a cell of column {column!r} is not a number",
            where=f"{path}, line {line}",
            expected="a number with a decimal point, or nothing where it is missing",
            found=repr(cell[:40]),
        ) from None
