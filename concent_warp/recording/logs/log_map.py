"""The map from a log to a scene, ``robot.toml``: which channel is which, in which unit and sign.

    calibration = "calibration.json"              # optional, beside this file
    [clock]
    "/camera/*" = { offset = -0.030 }             # or unit = "ms", use = "received", rate = 30
    [action.elbow]
    source = "action/elbow.pos"
    unit = "deg"
    [measured."*_position"]                       # one * in both: elbow_position is observation.state/elbow.pos
    source = "observation.state/*.pos"
    unit = "deg"
    noise_std = 0.001                             # SI
    [body.block]
    source = "/block/pose"
    [image.wrist]
    color = "observation.images.wrist"
    depth = "observation.images.wrist_depth"

A number becomes sign * scale * unit * number + offset, with the offset in SI.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.documents import is_number, read_toml
from concent_warp.errors import RecordingError
from concent_warp.recording.logs.readers.calibration import square_matrix
from concent_warp.recording.logs.units import DEPTHS, SHARES, TIMES, UNITS


@dataclass(frozen=True)
class ClockEntry:
    """Clock of the channels whose names match a pattern."""

    offset: float = 0.0
    """What is added to the times [s]."""
    unit: str = "s"
    """Unit of the stamps."""
    use: str = "stamp"
    """Which times count: those of the stamps, or those at which the logger ``received`` the samples."""
    rate: float | None = None
    """Samples a second, where the stamps are no times but numbers of frames."""


@dataclass(frozen=True)
class NumberEntry:
    """Where an actuator's commands or a sensor's measurements come from."""

    source: tuple[str, ...] = ()
    """Channels, one for each number, empty for one that was not measured, or one name under which they lie."""
    constant: float | None = None
    """Command that was the same all the time [SI], in place of a source."""
    unit: str | None = None
    """Unit of the log; SI by default."""
    sign: float = 1.0
    scale: float = 1.0
    offset: float = 0.0
    """What is added at the end [SI]."""
    noise_std: float | None = None
    """Standard deviation of the noise [SI], where known."""
    order: str = ""
    """Order of the components of a quaternion, where their names do not tell it: wxyz or xyzw."""


@dataclass(frozen=True)
class BodyEntry:
    """Where the pose of a body comes from."""

    source: str = ""
    """Name under which ``position`` and ``orientation`` lie."""
    unit: str = "m"
    """Unit of the position."""
    transform: np.ndarray = field(default_factory=lambda: np.eye(4))
    """From the frame of the log to the world of the scene, shape (4, 4)."""
    position_noise_std: float | None = None
    """Of each coordinate [m], where known."""
    orientation_noise_std: float | None = None
    """Of each component of the rotation vector [rad], where known."""


@dataclass(frozen=True)
class ImageEntry:
    """Where the frames and the calibration of a camera come from."""

    color: str = ""
    depth: str = ""
    """Depths registered to the colours; none by default."""
    depth_unit: str = ""
    """Unit of the depths; that of the log by default."""
    calibration: str = ""
    """Camera in calibration.json, or topic of its CameraInfo; found by its name by default."""
    frame: str = ""
    """Frame of the camera in the log's transforms; that of its images by default."""
    reference: str = ""
    """Frame of the world, or of the body that carries the camera, in the log's transforms."""
    body: str = ""
    """Body of the scene that carries the camera; none by default."""
    pose: np.ndarray | None = None
    """Camera-to-world or camera-to-body transform, shape (4, 4); by default from the calibration or transforms."""


@dataclass(frozen=True)
class LogMap:
    """What a map file states."""

    source: str = "<memory>"
    calibration: Path | None = None
    clock: Mapping[str, ClockEntry] = field(default_factory=dict)
    action: Mapping[str, NumberEntry] = field(default_factory=dict)
    measured: Mapping[str, NumberEntry] = field(default_factory=dict)
    body: Mapping[str, BodyEntry] = field(default_factory=dict)
    image: Mapping[str, ImageEntry] = field(default_factory=dict)

    def clock_of(self, name: str) -> ClockEntry:
        """Return the clock of a channel: that of its own name, else of the first pattern that it matches."""
        if name in self.clock:
            return self.clock[name]
        under = (e for p, e in self.clock.items() if fnmatch.fnmatchcase(name, p) or name.startswith(f"{p}/"))
        return next(under, ClockEntry())

    def where(self, kind: str, name: str) -> str:
        """Return the place of an entry, for messages."""
        return f"{self.source}, [{kind}.{name}]"


KINDS = {"clock": ClockEntry, "action": NumberEntry, "measured": NumberEntry, "body": BodyEntry, "image": ImageEntry}


def read_map(path: Path, *, empty: bool = False) -> LogMap:
    """Read a map file.

    Args:
        path: The file.
        empty: Whether it may have no entries.

    Raises:
        RecordingError: It cannot be read, or has entries that are unknown or make no sense.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError("no such map", where=path, fix="check the path, or let concent import --suggest write one")
    document = read_toml(path, RecordingError)
    known = ("calibration", *KINDS)
    if unknown := sorted(set(document) - set(known)):
        raise RecordingError("unknown entries in the map", where=path, expected=f"{', '.join(known)}", found=unknown)
    found: dict[str, Any] = {}
    for kind in KINDS:
        table = document.get(kind, {})
        if not isinstance(table, dict):
            raise RecordingError(f"[{kind}] is not a table", where=path)
        found[kind] = {name: _entry(kind, name, entry, path) for name, entry in table.items()}
    calibration = document.get("calibration")
    if calibration is not None and not isinstance(calibration, str):
        raise RecordingError("calibration is not the name of a file", where=path, found=repr(calibration))
    if not (empty or found["action"] or found["measured"] or found["body"] or found["image"]):
        raise RecordingError("the map is empty", where=path, expected="[action.*], [measured.*], [body.*] or [image.*]")
    return LogMap(str(path), None if calibration is None else path.parent / calibration, **found)


def _entry(kind: str, name: str, entry: Any, path: Path) -> Any:
    """Return one entry of the map."""
    where = f"{path}, [{kind}.{name}]"
    if isinstance(entry, str | list) and kind in ("action", "measured", "body"):
        entry = {"source": entry}
    if is_number(entry) and kind == "clock":
        entry = {"offset": entry}
    if not isinstance(entry, dict):
        raise RecordingError("not an entry of the map", where=where, expected="a table", found=repr(entry)[:60])
    names = [one.name for one in fields(KINDS[kind])]
    if unknown := sorted(set(entry) - set(names)):
        raise RecordingError("unknown settings", where=where, expected=f"some of {', '.join(names)}", found=unknown)
    return KINDS[kind](**{key: _value(key, value, where, kind) for key, value in entry.items()})


CHOICES = {
    "use": ("stamp", "received"),
    "order": ("wxyz", "xyzw"),
    "depth_unit": tuple(DEPTHS),
}
NUMBERS = ("offset", "scale", "sign", "noise_std", "position_noise_std", "orientation_noise_std", "constant", "rate")
ABOVE_ZERO = ("noise_std", "position_noise_std", "orientation_noise_std", "rate")


def _value(key: str, value: Any, where: str, kind: str) -> Any:
    """Return one checked setting of an entry."""
    if key in NUMBERS:
        wrong = not is_number(value) or (key in ABOVE_ZERO and value <= 0) or (key == "scale" and value == 0)
        if wrong or (key == "sign" and value not in (1, -1)):
            expected = "1 or -1" if key == "sign" else "a number above 0" if key in ABOVE_ZERO else "a number, not 0"
            raise RecordingError(f"{key} is not right", where=where, expected=expected, found=repr(value))
        return float(value)
    if key in ("transform", "pose"):
        return square_matrix(value, where, key, 4)
    if key == "source" and kind != "body":
        listed = [value] if isinstance(value, str) else value
        texts = isinstance(listed, list) and all(isinstance(one, str) for one in listed)
        if not texts or not any(listed) or (kind == "action" and not all(listed)):
            expected = "a name or a list of names, in it an empty one for each component that was not measured"
            raise RecordingError("source is not right", where=where, expected=expected, found=value)
        return tuple(listed)
    if not isinstance(value, str) or not value:
        raise RecordingError(f"{key} is not a text", where=where, found=repr(value))
    choices = CHOICES.get(key) or _units(key, kind)
    if choices and value not in choices:
        raise RecordingError(f"unknown {key}", where=where, expected=f"one of {', '.join(choices)}", found=repr(value))
    return value


def _units(key: str, kind: str) -> tuple[str, ...]:
    """Return the units that an entry may name."""
    if key != "unit":
        return ()
    if kind == "clock":
        return tuple(TIMES)
    if kind == "body":
        return tuple(name for name, (quantity, _) in UNITS.items() if quantity == "length")
    return (*UNITS, *SHARES)
