"""``concent calibrate``: camera poses of a recording, with intervals, from tags or from the robot in view."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro
from rich.markup import escape

from concent_warp.checks import Length, Signed
from concent_warp.cli.options import OptionalOutPath
from concent_warp.cli.terminal import progress_bar, say, say_written
from concent_warp.errors import ConcentError
from concent_warp.files import all_or_none
from concent_warp.perception.calibration.calibrate import JSON_NAME, calibrate, write_calibration
from concent_warp.perception.calibration.cfg import (
    BoardEdge,
    CalibrateCfg,
    CalibrationLimitsCfg,
    CalibrationTargetCfg,
    RobotViewCfg,
)
from concent_warp.perception.calibration.result import Calibration
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import claim_file, make_folder

PICTURES = (".png", ".pdf", ".svg", ".jpg", ".jpeg")
"""Suffixes of the pictures that --picture writes."""


@dataclass(frozen=True)
class Arguments:
    """Find the poses of a recording's cameras, on the hand or fixed in the world, with 95 % intervals, and the offset
    of their clock: from tags or a board, else from the robot itself in view of a fixed camera; and say whether
    intrinsics, depth and tag size are right.
    """

    recording: tyro.conf.Positional[Path]
    """Recording with images and joint readings."""
    out: OptionalOutPath = None
    """Calibrated recording to write; calibration.json goes beside it."""
    tag_size: Length = 0.04
    """Edge of a tag's black square [m]."""
    dictionary: str = "APRILTAG_36h11"
    """Dictionary of the tags, as cv2.aruco names it."""
    method: Literal["auto", "tags", "charuco", "grid", "robot"] = "auto"
    """Single tags at unknown places, a board, or the robot's own shape; auto takes tags where there are any, else the
    robot."""
    board: tuple[BoardEdge, BoardEdge] = (0, 0)
    """Columns and rows of a board: squares of a ChArUco board, tags of a grid."""
    spacing: float = 0.0
    """Edge of a square of a ChArUco board, or gap between the tags of a grid [m]."""
    ids: tuple[int, ...] = ()
    """Tags that are used; all by default."""
    target_body: str = "auto"
    """Body that carries the target, or world; the one whose motion fits by default."""
    cameras: tuple[str, ...] = ()
    """Cameras; all by default."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations; all by default."""
    fit_intrinsics: bool = False
    """Fit focal lengths, principal point and radial distortion as well."""
    fit_clock: bool = True
    """Fit the offset between the clocks of camera and robot."""
    start: tuple[Signed, ...] = ()
    """Rough pose of the camera for the robot's own shape: x y z [m], quaternion w x y z; that in the recording by
    default."""
    picture: Path | None = None
    """Write a picture of projected outlines and residuals to this file."""
    json: bool = False
    """Print one JSON object with all figures in SI units instead of the table."""
    overwrite: bool = False
    """Replace files that are there."""
    limits: CalibrationLimitsCfg = field(default_factory=CalibrationLimitsCfg)
    robot: RobotViewCfg = field(default_factory=RobotViewCfg)


def run(arguments: Arguments) -> Calibration:
    """Calibrate, and print or write what was asked for."""
    recording = load_recording(arguments.recording).only(arguments.demonstrations)
    if arguments.picture is not None and arguments.picture.suffix not in PICTURES:
        expected = f"one of {', '.join(PICTURES)}"
        raise ConcentError(
            "unknown kind of picture", where=arguments.picture, expected=expected, fix="change its suffix"
        )
    beside = None if arguments.out is None else arguments.out.parent / JSON_NAME
    for path in (arguments.out, beside, arguments.picture):
        if path is not None:
            claim_file(path, overwrite=arguments.overwrite)
    target = CalibrationTargetCfg(
        arguments.method, arguments.dictionary, arguments.tag_size, arguments.ids, arguments.board, arguments.spacing,
        arguments.target_body,
    )  # fmt: skip
    cfg = CalibrateCfg(
        target, arguments.cameras, arguments.fit_intrinsics, arguments.fit_clock, arguments.start, arguments.limits,
        arguments.robot,
    )  # fmt: skip
    with progress_bar("calibrate") as progress:
        found = calibrate(recording, cfg, progress=progress)
    written = []
    with all_or_none():
        if arguments.out is not None and beside is not None:
            make_folder(arguments.out.parent)
            write_calibration(found, arguments.out)
            written += [arguments.out, beside]
        if arguments.picture is not None:
            from concent_warp.perception.calibration.picture import draw_calibration

            make_folder(arguments.picture.parent)
            draw_calibration(found, arguments.picture)
            written.append(arguments.picture)
    if arguments.json:
        print(json.dumps(found.to_json(), indent=1, allow_nan=False))
        return found
    say(found.table())
    for sentence in found.sentences():
        say(escape(sentence))
    if written:
        say_written(*written)
    return found
