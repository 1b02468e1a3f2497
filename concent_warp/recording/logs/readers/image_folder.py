"""A folder of colour and depth images with ``intrinsics.json``, as RealSense's and Orbbec's tools and Open3D write it.

    color/ (or rgb/)       PNG or JPEG
    depth/                 PNG of 16 bits [mm unless intrinsics.json has a depth_scale], as large as the colours
    intrinsics.json        fx, fy, cx or ppx, cy or ppy, width, height; or intrinsic_matrix (Open3D, column by column)
    timestamps.csv         optional: file,time; else the last number in a file's name is its time
    *.csv                  optional: header time,<name>,...; column <name> of joints.csv is joints/<name>

A time in whole numbers is taken as ns, us or ms by its size, one with a decimal point as seconds.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.documents import is_number, read_json
from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.recording.logs.readers.calibration import Calibration, distortion_of, numbers
from concent_warp.recording.logs.readers.csv_table import table_rows, table_signals
from concent_warp.recording.logs.readers.image_files import SUFFIXES, read_image
from concent_warp.recording.logs.readers.kinds import COLOUR_FOLDERS, DEPTH_FOLDERS, INTRINSICS
from concent_warp.recording.logs.readers.log import Episode, Images, Signal
from concent_warp.recording.logs.readers.table_times import seconds

CAMERA = "camera"
"""Name of the calibration, where the folder has one camera."""
STAMPS = "timestamps.csv"
NUMBER = re.compile(r"\d+(?:[.]\d+)?")
NESTED = ("color", "colour", "rgb", "rgb_intrinsic", "color_intrinsics", "intrinsics", "camera")
"""Entries of ``intrinsics.json`` that may hold those of the colour camera, to which depths are registered."""


class ImageFolder:
    """A folder of images, which is one episode."""

    kind = "folder of images"
    numbers: Sequence[int] = (0,)

    def __init__(self, folder: Path) -> None:
        """Name the folder; everything is read by `episode`."""
        self.source = Path(folder)

    def episode(self, number: int) -> Episode:
        """See `Log.episode`."""
        stamps = _stamps(self.source / STAMPS)
        document, path = self._document()
        calibration = {} if document is None else {CAMERA: _calibration(document, path)}
        scale = None if document is None else _depth_scale(document, path)
        images: dict[str, Images] = {}
        for names, depth in ((COLOUR_FOLDERS, False), (DEPTH_FOLDERS, True)):
            folder = next((one for one in sorted(self.source.iterdir()) if one.name.lower() in names), None)
            if folder is not None and folder.is_dir():
                images[folder.name] = _images(folder, stamps, scale, depth=depth)
        if not images:
            raise RecordingError(
                "the folder has no images", where=self.source, expected="folders color and depth of PNG files"
            )
        signals: dict[str, Signal] = {}
        for table in sorted(self.source.glob("*.csv")):
            if table.name != STAMPS:
                signals |= table_signals(table, f"{table.stem}/")
        return Episode(number, signals, images, calibration=calibration)

    def _document(self) -> tuple[Mapping[str, Any] | None, Path]:
        """Return what the file of intrinsics holds, None without one, and its path."""
        path = next((self.source / n for n in INTRINSICS if (self.source / n).is_file()), self.source / INTRINSICS[0])
        if not path.is_file():
            return None, path
        document = read_json(path, RecordingError)
        if not isinstance(document, dict):
            raise RecordingError("not the intrinsics of a camera", where=path, expected="fx, fy, cx, cy by name")
        return document, path


def _calibration(document: Mapping[str, Any], path: Path) -> Calibration:
    """Return the calibration of the colour camera."""
    entry: Mapping[str, Any] = document
    for name in NESTED:
        if isinstance(document.get(name), dict):
            entry = {**{k: v for k, v in document.items() if not isinstance(v, dict)}, **document[name]}
            break
    matrix = _matrix(entry, path)
    model = str(entry.get("distortion_model", entry.get("model", "")))
    lens = entry.get("coeffs", entry.get("distortion_coeffs", entry.get("distortion", [])))
    if not isinstance(lens, dict) and isinstance(document.get("distortion"), dict):
        lens = document["distortion"]
    if isinstance(lens, dict):  # Orbbec names them
        order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        lens = [lens.get(name, 0) for name in (order if any(lens.get(f"k{k}") for k in (4, 5, 6)) else order[:5])]
    size = (entry.get("height"), entry.get("width"))
    known = all(is_number(one) for one in size)
    return Calibration(
        matrix, distortion_of(model, lens, path), size=(int(size[0] or 0), int(size[1] or 0)) if known else None
    )


def _matrix(entry: Mapping[str, Any], path: Path) -> np.ndarray:
    """Return the pinhole matrix [px], shape (3, 3)."""
    for name in ("intrinsic_matrix", "K", "k", "intrinsics", "camera_matrix"):
        if name in entry and not isinstance(entry[name], dict):
            given = numbers(entry[name], path, name).ravel()
            if given.shape != (9,):
                raise RecordingError(f"{name} is not right", where=path, expected="9 numbers", found=len(given))
            matrix = given.reshape(3, 3)
            return matrix.T if matrix[0, 2] == 0 and matrix[2, 0] != 0 else matrix  # Open3D: column by column
    found = []
    for names in (("fx",), ("fy",), ("cx", "ppx"), ("cy", "ppy")):
        value = next((entry[name] for name in names if name in entry), None)
        if not is_number(value):
            raise RecordingError(
                "the intrinsics lack a number", where=path, expected="fx, fy, cx (or ppx), cy (or ppy) [px]",
                found=f"no {names[0]}" if value is None else repr(value),
            )  # fmt: skip
        found.append(float(value))
    fx, fy, cx, cy = found
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _depth_scale(document: Mapping[str, Any], path: Path) -> float | None:
    """Return the metres of one unit of depth, None where nothing states it."""
    scale = document.get("depth_scale")
    if scale is None:
        return None
    if not is_number(scale) or scale <= 0:
        raise RecordingError(
            "depth_scale is not right", where=path, expected="metres a unit, or units a metre", found=repr(scale)
        )
    return float(scale) if scale < 1 else 1 / float(scale)


def _images(folder: Path, stamps: Mapping[str, float], scale: float | None, *, depth: bool) -> Images:
    """Return the images of a folder in the order of their times."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    if not paths:
        raise RecordingError("the folder has no images", where=folder, expected="PNG or JPEG files")
    if len(paths) > limits().samples:
        raise RecordingError("too many images", where=folder, expected=limits().samples, fix=raising("samples"))
    timed = sorted((_time_of(path, stamps), path) for path in paths)
    first = read_image(timed[0][1], depth=depth)
    return Images(
        folder.name,
        np.array([time for time, _ in timed]),
        (first.shape[0], first.shape[1]),
        depth,
        lambda rows: _frames([timed[int(row)][1] for row in rows], scale, depth=depth),
        "m" if scale is not None else "",
    )


def _frames(paths: Sequence[Path], scale: float | None, *, depth: bool) -> Iterator[np.ndarray]:
    """Yield images; depths in metres where their scale is known."""
    for path in paths:
        image = read_image(path, depth=depth)
        yield (image * np.float32(scale)).astype(np.float32) if depth and scale is not None else image


def _time_of(path: Path, stamps: Mapping[str, float]) -> float:
    """Return the time of an image [s]."""
    for name in (path.name, path.stem, f"{path.parent.name}/{path.name}"):
        if name in stamps:
            return stamps[name]
    if stamps:
        raise RecordingError(f"{STAMPS} has no time of an image", where=path, fix="add a row file,time")
    found = NUMBER.findall(path.stem)
    if not found:
        fix = f"write {STAMPS} with rows file,time"
        raise RecordingError("an image has no time in its name", where=path, expected="a number", fix=fix)
    return seconds(found[-1])


def _stamps(path: Path) -> dict[str, float]:
    """Return the times of images by their file names; empty without the file."""
    if not path.is_file():
        return {}
    found = {}
    for line, cells in table_rows(path):
        if len(cells) != 2:
            where = f"{path}, line {line}"
            raise RecordingError("wrong number of columns", where=where, expected="file,time", found=len(cells))
        try:
            found[cells[0].strip()] = seconds(cells[1].strip())
        except ValueError:
            if line > 1:  # the first may be a header
                where, text = f"{path}, line {line}", repr(cells[1])
                raise RecordingError("not a time", where=where, expected="a number", found=text) from None
    return found
