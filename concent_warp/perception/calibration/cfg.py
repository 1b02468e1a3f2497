"""Settings of camera calibration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from concent_warp.checks import Angle, Bounds, Count, Duration, Length, Positive, PositiveDuration, Share, Signed

BoardEdge = Annotated[int, Bounds(0, 100)]
"""Columns or rows of a board."""


@dataclass(frozen=True)
class CalibrationTargetCfg:
    """What a camera is calibrated against.

    Example:
        >>> import concent_warp as cw
        >>> board = cw.CalibrationTargetCfg("charuco", "4X4_50", tag_size=0.0225, board=(6, 4), spacing=0.03)
        >>> board.body
        'auto'
    """

    method: Literal["auto", "tags", "charuco", "grid", "robot"] = "auto"
    """Single tags at unknown places, a ChArUco or a grid board, or the robot itself; auto takes tags where any are
    found, else the robot."""
    dictionary: str = "DICT_APRILTAG_36h11"
    """Dictionary of the tags, a name in `cv2.aruco`, with or without the `DICT_`."""
    tag_size: Length = 0.04
    """Edge of a tag's black square [m]."""
    ids: tuple[int, ...] = ()
    """Numbers of the tags that are used; all that are found by default."""
    board: tuple[BoardEdge, BoardEdge] = (0, 0)
    """Columns and rows of a board: squares of a ChArUco board, tags of a grid."""
    spacing: Annotated[float, Bounds(0, 1000)] = 0.0
    """Edge of a square of a ChArUco board, or gap between the tags of a grid [m]."""
    body: str = "auto"
    """Body that carries the target, or world; auto takes the body whose motion fits."""


@dataclass(frozen=True)
class RobotViewCfg:
    """Settings of the alignment of the robot's own shape."""

    frames: Count = 16
    """Frames that are used, evenly spread over the recording."""
    pixels: Count = 10_000
    """Pixels of a grid over the image in which the robot is rendered."""
    capture_distance: Length = 0.25
    """Distance within which a measured point is paired with the robot at first [m]."""
    final_distance: Length = 0.015
    """Difference of depth up to which a pixel agrees with the robot at the end [m]."""
    moving_depth: Length = 0.03
    """How much nearer than in other frames a pixel must be to show a moving thing [m]."""
    min_agreement: Share = 0.75
    """Share of the robot's rendered pixels whose depth must agree [-]; below it nothing is returned. Cables and
    covers that the scene lacks, and things in front of the robot, cost some of it."""
    min_contrast: Positive = 12.0
    """Change of brightness across the robot's outline from which on its place is measured [1/255]."""
    coarse_rounds: Count = 25
    """Rounds of alignment to what moves."""
    fine_rounds: Count = 12
    """Rounds of alignment to depth and outline."""


@dataclass(frozen=True)
class CalibrationLimitsCfg:
    """What is searched, used and refused."""

    max_offset: PositiveDuration = 0.5
    """Largest offset between the clocks of camera and robot that is searched [s]."""
    max_gap: Duration = 0.1
    """Largest gap of an encoder's readings across which angles are interpolated [s]."""
    max_frames: Annotated[int, Bounds(3, 10_000)] = 120
    """Frames that are used at most, evenly thinned."""
    min_views: Annotated[int, Bounds(3, 10_000)] = 6
    """Fewest frames with a target."""
    min_edge: Positive = 12.0
    """Shortest edge of a tag in the image that is used [px]."""
    min_rotation: Angle = 10.0
    """Rotation about a second axis, root mean square over pairs of views, below which the motion is degenerate
    [deg]."""
    robust_width: Positive = 3.0
    """Residual of a frame over the median one beyond which its weight falls [-]."""
    size_tolerance: Share = 0.03
    """Difference of the tag size from the stated one beyond which nothing is returned [-]."""
    max_residual: Positive = 5.0
    """Root mean square reprojection error beyond which nothing is returned [px]."""


@dataclass(frozen=True)
class CalibrateCfg:
    """Settings of `calibrate`.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.CalibrateCfg(cw.CalibrationTargetCfg(tag_size=0.06), fit_intrinsics=True)
        >>> cfg.target.dictionary
        'DICT_APRILTAG_36h11'
    """

    target: CalibrationTargetCfg = field(default_factory=CalibrationTargetCfg)
    """What the camera is calibrated against."""
    cameras: tuple[str, ...] = ()
    """Cameras that are calibrated; all by default."""
    fit_intrinsics: bool = False
    """Whether focal lengths, principal point and two radial distortion coefficients are fitted as well."""
    fit_clock: bool = True
    """Whether the offset between the clocks of camera and robot is fitted."""
    start: tuple[Signed, ...] = ()
    """Start of the camera's pose for the alignment of the robot: x, y, z [m] and the quaternion w, x, y, z; the pose in
    the recording by default."""
    limits: CalibrationLimitsCfg = field(default_factory=CalibrationLimitsCfg)
    """What is searched, used and refused."""
    robot: RobotViewCfg = field(default_factory=RobotViewCfg)
    """Alignment of the robot's own shape."""
