"""Calibration of cameras: what a file or a log says, and images without the distortion of the lens.

``calibration.json`` beside a log has the intrinsics, and where known the pose, of each camera:

    {"cameras": {"wrist": {"width": 640, "height": 480,
                           "intrinsics": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
                           "distortion": [k1, k2, p1, p2, k3], "distortion_model": "brown_conrady",
                           "pose": [[...], [...], [...], [0, 0, 0, 1]], "body": "hand"}}}

`pose` is camera-to-world [m], or camera-to-body with `body`; camera axes are x right, y down, z forward. Distortion
is in OpenCV's order, 4, 5 or 8 numbers; it and all but the intrinsics may be left out.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.documents import is_number, read_json
from concent_warp.errors import RecordingError
from concent_warp.files import write_text

FILE = "calibration.json"
KEYS = ("intrinsics", "distortion", "distortion_model", "pose", "body", "width", "height")
PINHOLE = ("", "none", "plumb_bob", "rational_polynomial", "brown_conrady", "opencv", "radtan")
"""Distortion models whose coefficients OpenCV has in this order."""
LENGTHS = (0, 4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV knows."""


@dataclass(frozen=True)
class Calibration:
    """One camera."""

    intrinsics: np.ndarray
    """Pinhole matrix [px], shape (3, 3)."""
    distortion: np.ndarray
    """Coefficients in OpenCV's order, shape (n,); empty without distortion."""
    pose: np.ndarray | None = None
    """Camera-to-world transform, or camera-to-body with `body`, shape (4, 4), where known."""
    body: str | None = None
    """Body that carries the camera."""
    size: tuple[int, int] | None = None
    """Height and width of the images [px], where known."""
    problem: str = ""
    """Why images of the camera cannot be used; empty where they can."""

    def undistorter(self, size: tuple[int, int], *, depth: bool) -> Callable[[np.ndarray], np.ndarray]:
        """Return what takes the distortion out of images of a size: colours linear, depths from the nearest pixel.

        The result has the same pinhole matrix.
        """
        if not len(self.distortion):
            return lambda image: image
        import cv2

        height, width = size
        k = np.asarray(self.intrinsics, dtype=float)
        maps = cv2.initUndistortRectifyMap(k, self.distortion, np.eye(3), k, (width, height), cv2.CV_32FC1)
        how = cv2.INTER_NEAREST if depth else cv2.INTER_LINEAR
        return lambda image: cv2.remap(image, maps[0], maps[1], how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def read_calibration(path: Path) -> dict[str, Calibration]:
    """Return the cameras of a ``calibration.json`` by name.

    Raises:
        RecordingError: It cannot be read, or has other entries or shapes.
    """
    document = read_json(path, RecordingError)
    cameras = document.get("cameras") if isinstance(document, dict) else None
    if not isinstance(cameras, dict) or not cameras:
        raise RecordingError("not a calibration", where=path, expected='{"cameras": {"<name>": {"intrinsics": ...}}}')
    return {str(name): _camera(entry, f"{path}, camera {name!r}") for name, entry in cameras.items()}


def write_calibration(path: Path, cameras: Mapping[str, Calibration]) -> None:
    """Write a ``calibration.json`` of cameras by name, as `read_calibration` reads it, whole or not at all.

    Raises:
        OSError: The file cannot be written.
    """
    entries = {}
    for name, one in cameras.items():
        entry: dict[str, Any] = {}
        if one.size is not None:
            entry |= {"width": one.size[1], "height": one.size[0]}
        entry["intrinsics"] = np.asarray(one.intrinsics, float).tolist()
        if len(one.distortion):
            entry |= {"distortion": one.distortion.tolist(), "distortion_model": "opencv"}
        if one.pose is not None:
            entry["pose"] = np.asarray(one.pose, float).tolist()
        if one.body is not None:
            entry["body"] = one.body
        entries[name] = entry
    write_text(path, json.dumps({"cameras": entries}, indent=1) + "\n")


def distortion_of(model: str, coefficients: Any, where: object) -> np.ndarray:
    """Return coefficients of a lens in OpenCV's order, shape (n,); empty where all are 0.

    Args:
        model: Name of the distortion model, as ROS and RealSense have them.
        coefficients: Numbers.
        where: For messages.

    Raises:
        RecordingError: The model is a fisheye's or another that is not of OpenCV's pinhole camera.
    """
    given = numbers(coefficients, where, "distortion").ravel()
    if not given.any():
        return np.zeros(0)
    name = model.lower().removeprefix("distortion.")
    if name not in PINHOLE:
        fisheye = any(word in name for word in ("fish", "equi", "kannala", "omni", "ftheta"))
        raise RecordingError(
            "fisheye lenses are not supported" if fisheye else "unknown model of the lens distortion",
            where=where,
            expected=f"one of {', '.join(name for name in PINHOLE if name)}",
            found=repr(model),
            fix="undistort the images with the maker's software, and state the intrinsics of the result",
        )
    if len(given) not in LENGTHS:
        expected = "4, 5 or 8 numbers in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6"
        raise RecordingError(
            "wrong number of distortion coefficients", where=where, expected=expected, found=len(given)
        )
    return given


def numbers(value: Any, where: object, what: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Return nested lists of numbers as an array of floats.

    Raises:
        RecordingError: They are none, or of another shape than `shape`.
    """
    try:
        found = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        found = np.array(np.nan)
    if not np.isfinite(found).all() or (shape is not None and found.shape != shape):
        expected = "numbers" if shape is None else f"numbers of shape {shape}"
        raise RecordingError(f"{what} is not right", where=where, expected=expected, found=_short(value))
    return found


def square_matrix(value: Any, where: object, what: str, side: int) -> np.ndarray:
    """Return a square matrix given as rows, or as one list row by row."""
    found = numbers(value, where, what)
    if found.shape == (side * side,):
        return found.reshape(side, side)
    return numbers(value, where, what, (side, side))


def _short(value: Any) -> str:
    """Return a value in a few characters."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _camera(entry: Any, where: str) -> Calibration:
    """Return one entry of a calibration file."""
    if not isinstance(entry, Mapping):
        raise RecordingError("not a camera", where=where, expected=f"a table with {', '.join(KEYS)}")
    if unknown := sorted(set(map(str, entry)) - set(KEYS)):
        raise RecordingError("unknown entries", where=where, expected=f"some of {', '.join(KEYS)}", found=unknown)
    if "intrinsics" not in entry:
        raise RecordingError("the intrinsics are missing", where=where, expected="intrinsics, 3 rows of 3 numbers [px]")
    matrix = square_matrix(entry["intrinsics"], where, "intrinsics", 3)
    if matrix[2, 0] != 0 or matrix[2, 1] != 0:
        raise RecordingError(
            "the intrinsics are transposed", where=where, expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
            fix="write them row by row",
        )  # fmt: skip
    lens = distortion_of(str(entry.get("distortion_model", "")), entry.get("distortion", []), where)
    pose = None if entry.get("pose") is None else square_matrix(entry["pose"], where, "pose", 4)
    return Calibration(matrix, lens, pose, _body(entry, where), _size(entry, where))


def _body(entry: Mapping[str, Any], where: str) -> str | None:
    """Return the body that carries a camera."""
    body = entry.get("body")
    if body is not None and not isinstance(body, str):
        raise RecordingError("body is not a name", where=where, expected="the name of a body", found=_short(body))
    return body


def _size(entry: Mapping[str, Any], where: str) -> tuple[int, int] | None:
    """Return height and width of a camera's images [px], where stated."""
    given = entry.get("height"), entry.get("width")
    if given == (None, None):
        return None
    height, width = given
    if not (is_number(height) and is_number(width) and height >= 1 and width >= 1):
        raise RecordingError("height and width are not right", where=where, expected="two numbers [px]", found=given)
    return int(height), int(width)
