"""MCAP files and bags of ROS 1 and 2, read with the package rosbags, which needs no installation of ROS.

A first pass takes the numbers, the stamps of the images, calibrations and fixed transforms; images are decoded from the
file when they are asked for. Times are those of the headers where there are any, else those of reception.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.recording.logs.readers.calibration import Calibration, distortion_of
from concent_warp.recording.logs.readers.log import Episode, Images, Signal, Transforms
from concent_warp.recording.logs.readers.ros_messages import (
    NUMBERS,
    decoded,
    is_depth,
    pose_numbers,
    samples,
    short_type,
    stamp_of,
)
from concent_warp.recording.logs.readers.transforms import transform

IMAGES = ("Image", "CompressedImage")
TREE = ("TFMessage",)
READ = (*NUMBERS, *IMAGES, *TREE, "CameraInfo")
"""Types of messages that are read; others are passed over."""
STATIC = "tf_static"
COMMANDS = ("command", "cmd", "goal", "target", "setpoint", "desired", "reference")
"""Words in the name of a topic of commands."""


class RosLog:
    """A bag or MCAP file, which is one episode."""

    numbers: Sequence[int] = (0,)

    def __init__(self, path: Path) -> None:
        """Check that rosbags is installed.

        Raises:
            RecordingError: It is not.
        """
        self.source = Path(path)
        self.kind = "MCAP file" if self.source.suffix == ".mcap" else "ROS bag"
        try:
            import rosbags.highlevel  # noqa: F401  # pyright: ignore[reportUnusedImport]
        except ImportError:
            fix = "pip install 'concent-warp[logs]', or pip install rosbags"
            raise RecordingError("bags and MCAP files need the package rosbags", where=self.source, fix=fix) from None

    def episode(self, number: int) -> Episode:
        """See `Log.episode`."""
        found = _Contents()
        with _opened(self.source) as reader:
            for connection, received, raw in reader.messages():
                kind = short_type(connection.msgtype)
                if kind not in READ:
                    continue
                message = _message(reader, connection, raw, self.source)
                try:
                    found.add(connection.topic, kind, message, 1e-9 * received)
                except RecordingError as error:
                    where = f"{self.source}, topic {connection.topic}"
                    raise RecordingError(str(error).rstrip("."), where=where) from None
                except (AttributeError, TypeError, ValueError) as error:
                    where, what = f"{self.source}, topic {connection.topic}", f"a message is no {kind} of ROS"
                    raise RecordingError(what, where=where, found=error) from None
        return found.episode(number, self.source)


@dataclass(frozen=True)
class _Series:
    """Samples of one number."""

    time: array[float] = field(default_factory=lambda: array("d"))
    received: array[float] = field(default_factory=lambda: array("d"))
    value: array[float] = field(default_factory=lambda: array("d"))


@dataclass(frozen=True)
class _Stream:
    """Frames of one topic of images."""

    kind: str
    size: tuple[int, int]
    depth: bool
    frame: str
    time: list[float] = field(default_factory=list)
    received: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class _Contents:
    """What the messages hold so far."""

    numbers: dict[str, dict[str, _Series]] = field(default_factory=dict)
    """Series by topic and name."""
    commands: set[str] = field(default_factory=set)
    """Topics of commands."""
    stamped: set[str] = field(default_factory=set)
    """Topics whose messages have stamps."""
    streams: dict[str, _Stream] = field(default_factory=dict)
    calibration: dict[str, Calibration] = field(default_factory=dict)
    parents: dict[str, tuple[str, np.ndarray]] = field(default_factory=dict)
    moving: set[str] = field(default_factory=set)
    unread: dict[str, str] = field(default_factory=dict)
    """Topics of images that cannot be read, with the reason."""

    def add(self, topic: str, kind: str, message: Any, received: float) -> None:
        """Take note of a message received at a time [s]."""
        if kind == "CameraInfo":
            self.calibration.setdefault(topic, _camera(topic, message))
        elif kind in IMAGES:
            self._add_image(topic, kind, message, received)
        elif kind in TREE:
            for one in message.transforms:
                self._add_transform(topic, one, received)
        else:
            stamp = stamp_of(message)
            if kind == "JointTrajectory" or any(word in topic.lower() for word in COMMANDS):
                self.commands.add(topic)
            for after, values in samples(kind, message):
                self._add_numbers(topic, values, stamp, received, after)

    def _add_numbers(
        self, topic: str, values: dict[str, float], stamp: float | None, received: float, after: float | None
    ) -> None:
        """Take note of numbers by their names, `after` [s] later than the stamp."""
        series = self.numbers.setdefault(topic, {})
        time = (received if stamp is None else stamp) + (after or 0.0)
        if stamp is not None:
            self.stamped.add(topic)
        for name, value in values.items():
            one = series.setdefault(name, _Series())
            if after is not None:  # a new trajectory replaces what is left of the one before
                while one.time and one.time[-1] >= time:
                    for column in (one.time, one.received, one.value):
                        column.pop()
            one.time.append(time)
            one.received.append(received + (after or 0.0))
            one.value.append(value)
            if len(one.time) > limits().samples:
                raise RecordingError("too many samples", expected=f"at most {limits().samples}", fix=raising("samples"))

    def _add_image(self, topic: str, kind: str, message: Any, received: float) -> None:
        """Take note of a frame."""
        if topic in self.unread:
            return
        if topic not in self.streams:
            try:
                depth, (height, width) = is_depth(kind, message), decoded(kind, message).shape[:2]
            except RecordingError as error:
                self.unread[topic] = str(error)
                return
            self.streams[topic] = _Stream(kind, (height, width), depth, str(message.header.frame_id))
        stream = self.streams[topic]
        stamp = stamp_of(message)
        stream.time.append(received if stamp is None else stamp)
        stream.received.append(received)

    def _add_transform(self, topic: str, message: Any, received: float) -> None:
        """Take note of a frame in its parent."""
        child, parent = message.child_frame_id.lstrip("/"), message.header.frame_id.lstrip("/")
        numbers = pose_numbers(message.transform)
        if topic.rstrip("/").endswith(STATIC):
            self.moving.discard(child)
        else:
            self.moving.add(child)
            self._add_numbers(f"{topic.rstrip('/')}/{child}", numbers, stamp_of(message), received, None)
        values = list(numbers.values())
        self.parents[child] = parent, transform(np.array(values[:3]), np.array(values[3:]))

    def episode(self, number: int, source: Path) -> Episode:
        """Return all of it."""
        signals = {}
        for topic, series in self.numbers.items():
            for name, one in series.items():
                time, received = np.array(one.time), np.array(one.received)
                signals[f"{topic}/{name}"] = Signal(
                    f"{topic}/{name}", time, np.array(one.value), received if topic in self.stamped else None,
                    command=topic in self.commands,
                )  # fmt: skip
        images = {
            topic: Images(
                topic, np.array(s.time), s.size, s.depth, _Decoder(source, topic, s.kind), "",
                np.array(s.received), s.frame.lstrip("/"),
            )
            for topic, s in self.streams.items()
        }  # fmt: skip
        tree = Transforms(dict(self.parents), frozenset(self.moving))
        return Episode(number, signals, images, calibration=self.calibration, transforms=tree, unread=self.unread)


@dataclass(frozen=True)
class _Decoder:
    """Reads frames of one topic."""

    source: Path
    topic: str
    kind: str

    def __call__(self, rows: np.ndarray) -> Iterator[np.ndarray]:
        """Yield frames by their rows."""
        wanted = iter(rows)
        row = next(wanted, None)
        with _opened(self.source) as reader:
            connections = [one for one in reader.connections if one.topic == self.topic]
            for k, (connection, _, raw) in enumerate(reader.messages(connections=connections)):
                while row is not None and row == k:
                    try:
                        yield decoded(self.kind, _message(reader, connection, raw, self.source))
                    except RecordingError as error:
                        where = f"{self.source}, topic {self.topic}, frame {k}"
                        raise RecordingError(str(error).rstrip("."), where=where) from None
                    row = next(wanted, None)
                if row is None:
                    return


def _camera(topic: str, message: Any) -> Calibration:
    """Return the calibration in a CameraInfo; a topic of rectified images has no distortion left."""
    k, d, p = (
        np.asarray(getattr(message, name, getattr(message, name.upper(), ())), dtype=float) for name in ("k", "d", "p")
    )
    size = int(message.height), int(message.width)
    if "rect" in topic.lower() and p.size == 12 and p[0] > 0:
        return Calibration(p.reshape(3, 4)[:, :3], np.zeros(0), size=size)
    if not k.any():
        return Calibration(np.zeros((3, 3)), np.zeros(0), size=size)
    try:
        return Calibration(k.reshape(3, 3), distortion_of(message.distortion_model, d, topic), size=size)
    except RecordingError as error:  # of no concern where the map does not name this camera
        return Calibration(k.reshape(3, 3), np.zeros(0), size=size, problem=str(error))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield the open reader of a bag.

    Raises:
        RecordingError: It is damaged, or of a kind that is not read.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    except Exception as error:  # rosbags' readers raise whatever their parsers do
        raise _unreadable(path, error) from None
    try:
        yield reader
    except RecordingError:
        raise
    except Exception as error:
        raise _unreadable(path, error) from None
    finally:
        reader.close()


def _unreadable(path: Path, error: Exception) -> RecordingError:
    """Return the error that a bag cannot be read."""
    found = " ".join(str(error).split())[:200] or type(error).__name__
    fix = "if it was cut off, mend it with `mcap recover`, `ros2 bag reindex` or `rosbag reindex`"
    return RecordingError("the log cannot be read as a bag or MCAP file of ROS", where=path, found=found, fix=fix)


def _message(reader: Any, connection: Any, raw: bytes, path: Path) -> Any:
    """Return a message."""
    try:
        return reader.deserialize(raw, connection.msgtype)
    except Exception as error:  # as of `_opened`
        where = f"{path}, topic {connection.topic}"
        raise RecordingError(
            "a message cannot be decoded",
            where=where,
            found=f"{connection.msgtype}: {' '.join(str(error).split())[:150]}",
        ) from None
