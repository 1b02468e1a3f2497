"""Frames of videos by PyAV, and the depths that LeRobot stores in them.

Depths are codes of 12 bits: with shift s, smallest depth a and largest b, all in metres, code q of Q = 4095 stands for
exp(log(a + s) + q / Q (log(b + s) - log(a + s))) - s, or for a + q / Q (b - a) where the codes are linear. The formula
is that of lerobot 0.6, ``lerobot/datasets/depth_utils.py`` (after BEHAVIOR-1K). The first and the last code also stand
for all that is nearer or farther and for missing depths, so that neither counts as a measurement.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.documents import is_number
from concent_warp.errors import RecordingError

CODES = 4095
"""Largest code of a depth."""


@dataclass(frozen=True)
class DepthCodes:
    """Depths of a feature of a LeRobot data set."""

    smallest: float = 0.01
    """Depth of code 0 [m]."""
    largest: float = 10.0
    """Depth of code 4095 [m]."""
    shift: float = 3.5
    """What is added before the logarithm [m]."""
    logarithmic: bool = True

    @staticmethod
    def of(info: Mapping[str, Any], where: object) -> DepthCodes:
        """Return the codes that the description of a feature states.

        Raises:
            RecordingError: They make no sense.
        """
        default = DepthCodes()
        stated = {
            name: info.get(f"video.{name}", value)
            for name, value in (
                ("depth_min", default.smallest),
                ("depth_max", default.largest),
                ("shift", default.shift),
                ("use_log", default.logarithmic),
            )
        }
        a, b, s = (stated[name] for name in ("depth_min", "depth_max", "shift"))
        if not (is_number(a) and is_number(b) and is_number(s) and 0 <= a < b and a + s > 0):
            raise RecordingError("the codes of the depths make no sense", where=where, found=stated)
        return DepthCodes(float(a), float(b), float(s), bool(stated["use_log"]))

    def codes(self, metres: np.ndarray) -> np.ndarray:
        """Return the nearest codes of depths [m] of any shape, uint16; 0, missing, for those out of range."""
        kept = np.isfinite(metres) & (metres > self.smallest) & (metres < self.largest)
        inside = np.where(kept, metres, self.smallest).astype(float)
        if self.logarithmic:
            low, high = math.log(self.smallest + self.shift), math.log(self.largest + self.shift)
            share = (np.log(inside + self.shift) - low) / (high - low)
        else:
            share = (inside - self.smallest) / (self.largest - self.smallest)
        return np.where(kept, np.clip(np.rint(CODES * share), 1, CODES - 1), 0).astype(np.uint16)

    def metres(self, codes: np.ndarray) -> np.ndarray:
        """Return depths [m] float32 of codes of any shape; 0 for the first and the last code."""
        every = np.arange(CODES + 1) / CODES
        if self.logarithmic:
            low, high = math.log(self.smallest + self.shift), math.log(self.largest + self.shift)
            table = np.exp(low + every * (high - low)) - self.shift
        else:
            table = self.smallest + every * (self.largest - self.smallest)
        table[[0, CODES]] = 0
        return table.astype(np.float32)[np.minimum(codes, CODES)]


def read_frames(path: Path, times: np.ndarray, *, rate: float, depth: DepthCodes | None) -> Iterator[np.ndarray]:
    """Yield the frames of a video that are shown at some times.

    Args:
        path: The video.
        times: Times in the video [s], ascending, shape (n,).
        rate: Frames a second.
        depth: Codes of the depths, for a video of depths.

    Yields:
        Colours, shape (H, W, 3) uint8, or depths [m], shape (H, W) float32.

    Raises:
        RecordingError: The video cannot be decoded or has no frame there.
    """
    import av
    from av.error import FFmpegError

    wanted = iter(times)
    at = next(wanted, None)
    if at is None:
        return
    if not path.is_file():
        raise RecordingError("a video of the data set is missing", where=path, fix="copy or download it too")
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            assert stream.time_base is not None
            container.seek(max(0, int((at - 1 / rate) / stream.time_base)), stream=stream, backward=True)
            for frame in container.decode(stream):
                shown = math.inf if frame.time is None else frame.time
                while at is not None and abs(shown - at) < 0.5 / rate:
                    yield _gray(frame, path, depth) if depth else frame.to_ndarray(format="rgb24")
                    at = next(wanted, None)
                if at is None:
                    return
                if shown > at:
                    break
    except (FFmpegError, IndexError) as error:
        raise RecordingError("a video cannot be decoded", where=path, found=" ".join(str(error).split())) from None
    raise RecordingError(
        "a video lacks a frame", where=path, expected=f"one at {at:.3f} s", fix="check that the data set is complete"
    )


def _gray(frame: Any, path: Path, depth: DepthCodes) -> np.ndarray:
    """Return the depths of a frame [m], shape (H, W) float32."""
    name = frame.format.name
    if not any(bits in name for bits in ("12le", "16le")):
        expected = "12 bits a pixel (gray12le)"
        raise RecordingError("a video of depths has pixels of another kind", where=path, expected=expected, found=name)
    plane = frame.planes[0]
    rows = np.frombuffer(plane, np.uint16).reshape(plane.height, plane.line_size // 2)
    return depth.metres(rows[:, : plane.width])
