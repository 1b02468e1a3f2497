"""A log before it is mapped to a scene: channels with the names, units and clocks of the one who wrote it."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from concent_warp.recording.logs.readers.calibration import Calibration

Frames = Callable[[np.ndarray], Iterator[np.ndarray]]
"""Decodes frames by their rows, ascending, shape (n,) int."""


@dataclass(frozen=True)
class Signal:
    """One number of a log over time."""

    name: str
    """Feature or topic and what lies in it, such as ``/joint_states/position/elbow``."""
    time: np.ndarray
    """Stamps of the samples, shape (T,), in seconds where the log says its unit."""
    value: np.ndarray
    """Values in the log's unit, shape (T,) float; NaN where missing."""
    received: np.ndarray | None = None
    """Times at which the logger received the samples [s], shape (T,), where these differ from the stamps."""
    command: bool = False
    """Whether the log says that this is a command."""
    sparse: bool = False
    """Whether its samples are among those of other channels, as in a table with a row for each of either: samples
    without a value are then none."""
    frames: bool = False
    """Whether the stamps are numbers of frames."""
    lines: np.ndarray | None = None
    """Lines of the samples in their file, shape (T,) int, where it is a text."""
    file: str = ""
    """That file, for messages."""

    def place(self, row: int) -> str:
        """Return where a sample is, for messages: file and line, else the channel and its sample, counted from 0."""
        if self.lines is None:
            return f"{self.name}, sample {row}"
        return f"{self.file}, line {self.lines[row]}"

    def only(self, kept: np.ndarray) -> Signal:
        """Return the signal with some of its samples, a mask of shape (T,)."""
        lines = None if self.lines is None else self.lines[kept]
        received = None if self.received is None else self.received[kept]
        return replace(self, time=self.time[kept], value=self.value[kept], received=received, lines=lines)


@dataclass(frozen=True)
class Images:
    """Frames of one colour or depth stream, decoded when they are asked for."""

    name: str
    """Feature, topic or folder."""
    time: np.ndarray
    """Stamps of the frames, shape (T,), in seconds where the log says its unit."""
    size: tuple[int, int]
    """Height and width [px]."""
    depth: bool
    """Whether the frames are depths, shape (H, W), else colours, shape (H, W, 3) uint8."""
    frames: Frames
    unit: str = ""
    """Unit of the depths where the log states it, else that of their type: whole numbers are mm, others m."""
    received: np.ndarray | None = None
    """Times at which the logger received the frames [s], shape (T,), where these differ from the stamps."""
    frame: str = ""
    """Name of the camera's frame in the log's tree of transforms."""

    def place(self, row: int) -> str:
        """Return where a frame is, for messages."""
        return f"{self.name}, frame {row}"


@dataclass(frozen=True)
class Transforms:
    """Tree of coordinate frames that do not move."""

    parents: Mapping[str, tuple[str, np.ndarray]] = field(default_factory=dict)
    """Parent, and frame-to-parent transform (4, 4), by frame."""
    moving: frozenset[str] = frozenset()
    """Frames that move in their parents."""


@dataclass(frozen=True)
class Episode:
    """One episode of a log."""

    number: int
    signals: Mapping[str, Signal]
    images: Mapping[str, Images]
    task: str = ""
    success: bool | None = None
    calibration: Mapping[str, Calibration] = field(default_factory=dict)
    """What the log says of its cameras, by the name of an image stream or its camera."""
    transforms: Transforms = field(default_factory=Transforms)
    unread: Mapping[str, str] = field(default_factory=dict)
    """Streams of images that cannot be read, with the reason."""

    def find(self, source: str) -> list[Signal]:
        """Return the signal of a name, else all that lie under it (``/pose/position``), else those of a pattern."""
        if source in self.signals:
            return [self.signals[source]]
        under = [signal for name, signal in self.signals.items() if name.startswith(f"{source.rstrip('/')}/")]
        if under or not any(character in source for character in "*?["):
            return under
        return [signal for name, signal in self.signals.items() if fnmatch.fnmatchcase(name, source)]


class Log(Protocol):
    """A log with one or more episodes."""

    @property
    def kind(self) -> str:
        """What it is, in words."""
        ...

    @property
    def source(self) -> Path:
        """File or folder."""
        ...

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of its episodes."""
        ...

    def episode(self, number: int) -> Episode:
        """Read an episode; its images are decoded later.

        Raises:
            RecordingError: What is there cannot be read.
        """
        ...
