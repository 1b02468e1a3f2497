"""A picture of a calibration: frames with projected outlines and errors, and errors over radius and time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.files import new_file
from concent_warp.perception.calibration.result import Calibration, CameraCalibration, FrameError

SHOWN_FRAMES = 3
"""Frames of each camera that are shown."""
ARROW_PIXELS = 25.0
"""Length of an arrow of a median error in the picture [px]."""
FOUND, LOST, ERROR = "#35c26b", "#e0493b", "#ffb000"


def draw_calibration(calibration: Calibration, path: Path) -> None:
    """Draw a calibration as an image.

    Args:
        calibration: What was found.
        path: The image; its suffix determines the format.
    """
    import matplotlib.pyplot as plt

    cameras = list(calibration.cameras.values())
    figure = plt.figure(figsize=(12.5, 3.6 * 2 * len(cameras)), layout="constrained")
    grid = figure.add_gridspec(2 * len(cameras), SHOWN_FRAMES)
    for k, camera in enumerate(cameras):
        for column, frame in enumerate(_chosen(camera)):
            _draw_frame(figure.add_subplot(grid[2 * k, column]), calibration, camera, frame)
        _draw_radius(figure.add_subplot(grid[2 * k + 1, 0]), camera)
        _draw_time(figure.add_subplot(grid[2 * k + 1, 1:]), camera)
    with new_file(path) as partial:
        figure.savefig(partial, format=path.suffix.lstrip(".") or "png", dpi=110)
    plt.close(figure)


def _chosen(camera: CameraCalibration) -> list[FrameError]:
    """Return the frames that are shown: first, middle and worst of those that count."""
    good = sorted((f for f in camera.frames if f.weight > 0.5 and len(f.errors)), key=_size) or list(camera.frames)
    rows = np.unique([0, len(good) // 2, len(good) - 1])
    return [good[row] for row in rows]


def with_errors(camera: CameraCalibration) -> list[FrameError]:
    """Return the frames in which something agreed, so that there are errors."""
    return [f for f in camera.frames if len(f.errors)]


def _size(frame: FrameError) -> float:
    """Return the root mean square error of a frame."""
    return float(np.sqrt(np.mean(frame.errors**2))) if len(frame.errors) else 0.0


def _draw_frame(axes: Any, calibration: Calibration, camera: CameraCalibration, frame: FrameError) -> None:
    """Draw a frame with outlines and errors."""
    stream = calibration.original[frame.demonstration].image[camera.name]
    axes.imshow(stream.rgb[frame.row])
    if camera.method == "robot":
        edge = frame.outlines[0]
        axes.plot(edge[:, 0], edge[:, 1], ".", color=FOUND, markersize=2.5)
        shown = axes.scatter(*frame.pixels.T, c=1e3 * frame.errors[:, 0], s=3, cmap="coolwarm", vmin=-6, vmax=6)
        axes.figure.colorbar(shown, ax=axes, label="depth error [mm]", shrink=0.7)
        axes.set_title(f"t = {frame.time:.2f} s, {1e3 * _size(frame):.1f} mm", fontsize=9)
    else:
        for outline in frame.outlines:
            axes.plot(*np.vstack([outline, outline[:1]]).T, color=FOUND, linewidth=1.2)
        scale = ARROW_PIXELS / max(_size(frame), 1e-6)
        axes.quiver(
            *frame.pixels.T, *frame.errors.T * scale, color=ERROR, angles="xy", scale_units="xy", scale=1, width=0.004
        )
        middle, reach = frame.pixels.mean(axis=0), max(float(np.ptp(frame.pixels, axis=0).max()), 60.0)
        axes.set_xlim(max(middle[0] - reach, 0), min(middle[0] + reach, camera.size[0]))
        axes.set_ylim(min(middle[1] + reach, camera.size[1]), max(middle[1] - reach, 0))
        axes.set_title(f"t = {frame.time:.2f} s, {_size(frame):.2f} px (arrows x {scale:.0f})", fontsize=9)
    axes.set_axis_off()


def _draw_radius(axes: Any, camera: CameraCalibration) -> None:
    """Draw errors over the distance from the principal point."""
    centre, frames = camera.intrinsics[:2, 2], with_errors(camera)
    radius = [np.linalg.norm(f.pixels - centre, axis=1) for f in frames]
    if camera.method == "robot":
        values = [1e3 * f.errors[:, 0] for f in frames]
        axes.set_ylabel("depth error [mm]")
    else:
        # Along the radius, where distortion shows.
        values = [
            np.einsum("ni,ni->n", f.errors, (f.pixels - centre) / np.maximum(r, 1e-9)[:, None])
            for f, r in zip(frames, radius, strict=True)
        ]
        axes.set_ylabel("error outwards [px]")
    for frame, r, v in zip(frames, radius, values, strict=True):
        axes.plot(r, v, ".", color=FOUND if frame.weight > 0.5 else LOST, markersize=2.5, alpha=0.6)
    good = [v for f, v in zip(frames, values, strict=True) if f.weight > 0.5]
    if good:
        limit = max(4 * float(np.std(np.concatenate(good))), 1e-3)
        axes.set_ylim(-limit, limit)
    axes.axhline(0, color="grey", linewidth=0.6)
    axes.set_xlabel(f"{camera.name}: distance from the principal point [px]")


def _draw_time(axes: Any, camera: CameraCalibration) -> None:
    """Draw the error of each frame over time."""
    unit = 1e3 if camera.method == "robot" else 1.0
    frames = with_errors(camera)
    for frame in frames:
        axes.plot(frame.time, unit * _size(frame), "o", color=FOUND if frame.weight > 0.5 else LOST, markersize=4)
    axes.set_ylim(bottom=0)
    missing = len(camera.frames) - len(frames)
    left_out = f"; left out: {missing} of {len(camera.frames)} frames, in which nothing agrees" if missing else ""
    axes.set_xlabel(f"time [s], robot's clock; red: little weight{left_out}")
    axes.set_ylabel("error of a frame (rms) [mm]" if camera.method == "robot" else "error of a frame (rms) [px]")
