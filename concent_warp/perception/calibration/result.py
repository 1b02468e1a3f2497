"""What a camera calibration has found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.recording.recording import Demonstration, ImageStream, Recording

if TYPE_CHECKING:
    from rich.table import Table


CLEAR = 1.75
"""Magnitude of a check over half of its 95 % interval from which on it is clearly off [-]: several are made at once, so
that at 1 a good recording in four would have an alarm."""


@dataclass(frozen=True)
class Check:
    """A quantity that is 0 where the recording is right, with its interval."""

    name: str
    """What is checked, such as `focal length`."""
    value: float
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end."""
    unit: str
    """"%" or "px"."""
    least: float = 0.0
    """Magnitude below which the deviation does not matter."""

    @property
    def off(self) -> bool:
        """Whether the value is clearly not 0, and matters."""
        return bool(abs(self.value) > max(CLEAR * (self.high - self.low) / 2, self.least))


@dataclass(frozen=True)
class FrameError:
    """Errors of one frame, for pictures."""

    demonstration: str
    row: int
    """Row of the frame in its stream."""
    time: float
    """Time by the robot's clock [s]."""
    pixels: np.ndarray
    """Measured places in the image [px], shape (n, 2)."""
    errors: np.ndarray
    """Predicted minus measured place [px], shape (n, 2); of a robot, depth errors [m], shape (n, 1)."""
    weight: float
    """Weight of the frame in the fit [-]."""
    outlines: tuple[np.ndarray, ...] = ()
    """Projected outlines of targets [px], shape (k, 2) each."""


@dataclass(frozen=True)
class CameraCalibration:
    """Calibration of one camera; intervals are half widths at 95 %.

    Example:
        >>> import concent_warp as cw
        >>> [field for field in cw.CameraCalibration.__dataclass_fields__ if "interval" in field]
        ['position_interval', 'rotation_interval', 'clock_interval']
    """

    name: str
    method: str
    """"tags", "charuco", "grid" or "robot"."""
    pose: np.ndarray
    """Camera to world, or to `body`, shape (4, 4); axes x right, y down, z forward."""
    body: str | None
    """Body that carries the camera, None for the world."""
    recorded_pose: np.ndarray
    """The pose in the recording, shape (4, 4)."""
    position_interval: np.ndarray
    """Of the position by axis of the world or body [m], shape (3,)."""
    rotation_interval: np.ndarray
    """Of the orientation about the camera's own axes [rad], shape (3,)."""
    intrinsics: np.ndarray
    """Pinhole matrix [px], shape (3, 3)."""
    distortion: tuple[float, ...]
    """OpenCV's k1, k2, p1, p2 of the images in the recording; empty where none was fitted."""
    size: tuple[int, int]
    """Width and height of the images [px]."""
    clock_offset: float
    """Time to be added to that of a frame, so that it is that of the robot [s]."""
    clock_interval: float | None
    """Half width of its interval [s]; None where it was not fitted or cannot be."""
    residual: float
    """Root mean square error: reprojection [px], or of depth along the robot's surface [m] for method `robot`."""
    frames: tuple[FrameError, ...]
    """Frames that were used."""
    target_body: str | None = None
    """Body that carries the targets, None for the world."""
    targets: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Poses of the targets on their body, shape (4, 4) each."""
    checks: tuple[Check, ...] = ()
    """Intrinsics, depth and size of the targets."""
    remarks: tuple[str, ...] = ()

    @property
    def correction(self) -> tuple[float, float]:
        """How far the recorded pose is off: distance [m] and angle [rad]."""
        shift = float(np.linalg.norm(self.pose[:3, 3] - self.recorded_pose[:3, 3]))
        turn = Rotation.from_matrix(self.pose[:3, :3].T @ self.recorded_pose[:3, :3]).magnitude()
        return shift, float(turn)

    def to_json(self) -> dict[str, Any]:
        """Return the calibration as plain data, SI units."""
        return {
            "intrinsics": self.intrinsics.tolist(),
            "distortion": list(self.distortion),
            "width": self.size[0],
            "height": self.size[1],
            "pose": self.pose.tolist(),
            "body": self.body,
            "clock_offset": self.clock_offset,
            "intervals": {
                "position": self.position_interval.tolist(),
                "rotation": self.rotation_interval.tolist(),
                "clock_offset": self.clock_interval,
            },
            "method": self.method,
            "frames": len(self.frames),
            "residual": self.residual,
            "target_body": self.target_body,
            "targets": {name: pose.tolist() for name, pose in self.targets.items()},
            "checks": {
                c.name: {"value": c.value, "low": c.low, "high": c.high, "unit": c.unit, "off": c.off}
                for c in self.checks
            },
            "remarks": list(self.remarks),
        }


@dataclass(frozen=True)
class Calibration:
    """Calibration of the cameras of a recording.

    Example:
        >>> import concent_warp as cw
        >>> cw.Calibration(cw.load_recording(cw.example("servo")), {}).to_json()
        {'cameras': {}}
    """

    original: Recording
    """The recording that was given."""
    cameras: Mapping[str, CameraCalibration]
    """What was found, by name of the camera."""

    @property
    def recording(self) -> Recording:
        """The recording with calibrated poses, intrinsics and times of its frames.

        Frames before time 0 are left out. Where distortion was fitted, the images are undistorted.
        """
        return replace(self.original, demonstrations=tuple(map(self._calibrated, self.original.demonstrations)))

    def _calibrated(self, demonstration: Demonstration) -> Demonstration:
        """Return a demonstration with what was found."""
        image = {}
        for name, stream in demonstration.image.items():
            found = self.cameras.get(name)
            if found is not None:
                stream = _undistorted(stream, found)
                time = stream.time + found.clock_offset
                keep = time >= 0
                stream = replace(
                    stream, time=time[keep], rgb=stream.rgb[keep], depth=stream.depth[keep],
                    intrinsics=found.intrinsics, pose=found.pose, body=found.body,
                )  # fmt: skip
            image[name] = stream
        return replace(demonstration, image=image)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain data, SI units, as in `calibration.json`."""
        return {"cameras": {name: camera.to_json() for name, camera in self.cameras.items()}}

    def table(self) -> Table:
        """Return the values with their intervals as a table for the terminal."""
        from rich.table import Table

        table = Table("camera", "", "value", "95 % interval", "recorded", box=None, pad_edge=False)
        for name, c in self.cameras.items():
            where = f"on {c.body or 'the world'}"
            first = Rotation.from_matrix(c.recorded_pose[:3, :3])
            turn = (first.inv() * Rotation.from_matrix(c.pose[:3, :3])).as_rotvec()
            for i, axis in enumerate("xyz"):
                position, half = 1e3 * c.pose[i, 3], 1e3 * c.position_interval[i]
                old = f"{1e3 * c.recorded_pose[i, 3]:.1f} mm"
                table.add_row(
                    name if i == 0 else where if i == 1 else "", axis, f"{position:.2f} mm", f"± {half:.2f}", old
                )
            for i, axis in enumerate("xyz"):
                half = np.degrees(c.rotation_interval[i])
                table.add_row("", f"turn about {axis}", f"{np.degrees(turn[i]):+.3f} deg", f"± {half:.3f}", "0")
            half = "" if c.clock_interval is None else f"± {1e3 * c.clock_interval:.2f}"
            table.add_row("", "clock offset", f"{1e3 * c.clock_offset:+.2f} ms", half, "0")
            for check in c.checks:
                mark = " (off)" if check.off else ""
                bounds = f"{check.low:+.2f} to {check.high:+.2f}"
                table.add_row("", check.name, f"{check.value:+.2f} {check.unit}{mark}", bounds, "0")
        return table

    def sentences(self) -> list[str]:
        """Return what was found, and what to mind, in sentences."""
        lines = []
        for name, c in self.cameras.items():
            shift, turn = c.correction
            error = f"{1e3 * c.residual:.2f} mm of depth" if c.method == "robot" else f"{c.residual:.2f} px"
            used = sum(f.weight > 0.5 for f in c.frames)
            lines.append(
                f"{name}: recorded pose off by {1e3 * shift:.1f} mm and {np.degrees(turn):.2f} deg; "
                f"{used} of {len(c.frames)} frames agree, error {error} (rms)"
            )
            lines += [f"{name}: {remark}" for remark in c.remarks]
        return lines


def _undistorted(stream: ImageStream, camera: CameraCalibration) -> ImageStream:
    """Return a stream without the distortion that was fitted."""
    if not any(camera.distortion):
        return stream
    import cv2

    height, width = stream.rgb.shape[1:3]
    maps = cv2.initUndistortRectifyMap(
        camera.intrinsics, np.array(camera.distortion), None, camera.intrinsics, (width, height), cv2.CV_32FC1
    )
    rgb = np.stack([cv2.remap(frame, *maps, cv2.INTER_LINEAR) for frame in stream.rgb])
    depth = np.stack([cv2.remap(frame, *maps, cv2.INTER_NEAREST) for frame in stream.depth])
    return replace(stream, rgb=rgb, depth=depth)
