"""Settings of the page of a tracked video and of its live view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from concent_warp.checks import Bounds, Count, Duration


@dataclass(frozen=True)
class TrackReportCfg:
    """Settings of the page of a tracked video.

    Example:
        >>> import concent_warp as cw
        >>> cw.TrackReportCfg(max_frames=60).max_frames
        60
    """

    max_frames: Count = 120
    """Most frames of each camera and demonstration that are shown, evenly spaced; plots show all [-]."""
    max_image_bytes: Annotated[int, Bounds(10_000, 1_000_000_000)] = 8_000_000
    """Size of all images of the page as they are embedded [bytes]; of each camera fewer frames, at least one, are shown
    where it would be more."""
    image_width: Annotated[int, Bounds(16, 16_383)] = 640
    """Largest width of the images [px]; larger ones are reduced."""
    image_quality: Annotated[int, Bounds(1, 100)] = 70
    """Quality of the images' WebP compression, 1 to 100 [-]."""
    max_demonstrations: Count = 6
    """Most demonstrations that are shown, those that were lost longest first [-]; the table has all."""


@dataclass(frozen=True)
class LiveTrackCfg:
    """Settings of the live view of tracking.

    Example:
        >>> import concent_warp as cw
        >>> cw.LiveTrackCfg(port=8090).port
        8090
    """

    port: Annotated[int, Bounds(0, 65535)] = 8080
    """Port of the page; if it is in use, the next free one."""
    host: str = "127.0.0.1"
    """Address of the server; 0.0.0.0 lets anyone in the network open the page."""
    period: Duration = 0.2
    """Least time between pictures [s]: each takes some milliseconds from the tracking."""
