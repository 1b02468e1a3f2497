"""The frames of one camera across the demonstrations of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.perception.calibration.joint_motion import JointMotion
from concent_warp.recording.recording import ImageStream, Recording
from concent_warp.scene.scene import Scene


@dataclass(frozen=True)
class Footage:
    """Frames of one camera, and the motion of the robot during each demonstration."""

    name: str
    where: str
    """File and camera, for messages."""
    scene: Scene
    streams: Mapping[str, ImageStream]
    """By demonstration."""
    motions: Mapping[str, JointMotion]
    """By demonstration."""

    @property
    def first(self) -> ImageStream:
        """A stream, for what is the same in all of them: intrinsics, pose, body and size."""
        return next(iter(self.streams.values()))

    @property
    def body(self) -> str:
        """Body that carries the camera, or world."""
        return self.first.body or "world"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames [px]."""
        height, width = self.first.rgb.shape[1:3]
        return int(width), int(height)

    @property
    def image_span(self) -> tuple[float, float]:
        """First and last time of a frame [s]."""
        times = [s.time for s in self.streams.values()]
        return min(float(t[0]) for t in times), max(float(t[-1]) for t in times)


def footage_of(
    recording: Recording, camera: str, scene: Scene, motions: Mapping[str, JointMotion], max_offset: float
) -> Footage:
    """Return the frames of a camera.

    Raises:
        RecordingError: The demonstrations do not agree about the camera, its intrinsics are a placeholder, or it has no
            frames while the joints have readings.
    """
    streams = {d.name: d.image[camera] for d in recording.demonstrations if camera in d.image}
    where = f"{recording.source}: camera {camera!r}"
    first = next(iter(streams.values()))
    for name, stream in streams.items():
        same = np.allclose(stream.intrinsics, first.intrinsics) and np.allclose(stream.pose, first.pose, atol=1e-9)
        if not same or stream.body != first.body or stream.rgb.shape[1:] != first.rgb.shape[1:]:
            raise RecordingError(
                "intrinsics, pose, body or image size of the camera differ between demonstrations",
                where=where,
                expected=f"those of {next(iter(streams))}",
                found=f"others in {name}",
                fix="calibrate the demonstrations one by one with --demonstrations",
            )
    matrix = np.asarray(first.intrinsics, float)
    if np.allclose(matrix, np.eye(3)) or min(matrix[0, 0], matrix[1, 1]) < 20:
        raise RecordingError(
            "the camera's intrinsics are missing",
            where=where,
            expected="focal lengths and principal point in pixels",
            found=f"{np.round(matrix, 3).tolist()}",
            fix="write those of the camera's driver or data sheet into the recording; --fit-intrinsics refines them",
        )
    for name, stream in streams.items():
        low, high = motions[name].span
        if not len(stream.time) or stream.time[-1] + max_offset < low or stream.time[0] - max_offset > high:
            found = f"{stream.time[0]:.3f} to {stream.time[-1]:.3f} s" if len(stream.time) else "no frames"
            raise RecordingError(
                f"the clocks of camera and robot do not overlap in {name}",
                where=where,
                expected=f"frames within {low:.3f} to {high:.3f} s, when the joints were read",
                found=found,
                fix="shift the camera's times, or give --limits.max-offset",
            )
    return Footage(camera, where, scene, streams, motions)
