"""What turns a video into poses of bodies: the protocol, and the two trackers of this package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from concent_warp.perception.backends.protocols import Masker, PointTracker
from concent_warp.perception.tracking.body_tracker import BodyTracker
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.checkpoint import TrackCheckpoint
from concent_warp.perception.tracking.demonstration_tracker import track_bodies
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import Symmetry
from concent_warp.perception.tracking.masks import body_masks, camera_frames
from concent_warp.perception.tracking.moment import TrackedMoment
from concent_warp.perception.tracking.points.point_body_tracker import PointBodyTracker
from concent_warp.perception.tracking.prompts import Prompt
from concent_warp.perception.tracking.result import BodyTrack
from concent_warp.perception.tracking.video import Video
from concent_warp.scene.scene import Scene


@dataclass(frozen=True)
class TrackingInput:
    """The video of one demonstration and what is known of it.

    Example:
        >>> import concent_warp as cw
        >>> cw.TrackingInput.__name__
        'TrackingInput'
    """

    scene: Scene
    """The scene."""
    video: Video
    """Frames of all cameras, and the robot's configuration at their times."""
    shapes: list[TrackedShape]
    """Shapes of the bodies to track."""
    first: Mapping[str, np.ndarray]
    """First poses, shape (4, 4), by body; others are to be found."""
    name: str
    """Name of the demonstration."""
    where: str
    """File and demonstration, for messages."""
    watch: Callable[[TrackedMoment], None] | None = None
    """Called after each moment, with its frames and what was found in them."""
    prompts: Mapping[str, Prompt] = field(default_factory=dict)
    """Where a user says that bodies without first pose are, by body."""
    checkpoint: TrackCheckpoint | None = None
    """State that the tracking continues from and is written to now and then; a tracker may ignore it."""


@runtime_checkable
class PoseTracker(Protocol):
    """Tracks bodies in the video of one demonstration.

    Example:
        >>> import concent_warp as cw
        >>> isinstance(cw.ModelToFrameTracker(), cw.PoseTracker)
        True
    """

    def track(self, given: TrackingInput, progress: Callable[[float], None] | None = None) -> list[BodyTrack]:
        """Return the track of each body, in the order of the shapes; NaN where it is lost.

        Args:
            given: The video and what is known of it.
            progress: Called with the share done, 0..1.

        Raises:
            RecordingError: A first pose does not agree with the video.
        """
        ...


class ModelToFrameTracker:
    """Compares each frame's depth, edges and texture with the shape: the default.

    Args:
        cfg: Settings.
        masker: Makes masks of the bodies; pixels outside them are left out. None for no masks.

    Example:
        >>> import concent_warp as cw
        >>> cw.ModelToFrameTracker(masker=cw.DepthMasker()).cfg.align.iterations
        4
    """

    def __init__(self, cfg: TrackCfg | None = None, *, masker: Masker | None = None) -> None:
        """Take settings."""
        self.cfg, self.masker = cfg or TrackCfg(), masker

    def track(self, given: TrackingInput, progress: Callable[[float], None] | None = None) -> list[BodyTrack]:
        """See `PoseTracker.track`."""
        masks = None
        if self.masker is not None:
            masks = body_masks(self.masker, given.scene, given.video, given.shapes, given.first, self.cfg)
        return track_bodies(
            given.scene, given.video, given.shapes, given.first, self.cfg, given.name, given.where, progress,
            given.watch, masks=masks, prompts=given.prompts, checkpoint=given.checkpoint,
        )  # fmt: skip


class PointPoseTracker:
    """Registers points that are tracked in the images: masks, depth and point tracks become poses.

    Keyframes are put on the shape by the model-to-frame tracker, which also finds first poses.

    Args:
        points: Follows points through images.
        cfg: Settings.
        masker: Makes masks of the bodies; points outside them are left out. None for no masks.

    Example:
        >>> import concent_warp as cw
        >>> tracker = cw.PointPoseTracker(cw.FlowTracker())
        >>> tracker.cfg.registration.min_points
        8
    """

    def __init__(self, points: PointTracker, cfg: TrackCfg | None = None, *, masker: Masker | None = None) -> None:
        """Take what follows points, and settings."""
        self.points, self.cfg, self.masker = points, cfg or TrackCfg(), masker

    def track(self, given: TrackingInput, progress: Callable[[float], None] | None = None) -> list[BodyTrack]:
        """See `PoseTracker.track`."""
        masks = None
        if self.masker is not None:
            masks = body_masks(self.masker, given.scene, given.video, given.shapes, given.first, self.cfg)
        streams = camera_frames(given.scene, given.video, given.shapes)

        def make(shape: TrackedShape, symmetry: Symmetry, cfg: TrackCfg) -> BodyTracker:
            return PointBodyTracker(shape, symmetry, cfg, given.video, streams, self.points)

        return track_bodies(
            given.scene, given.video, given.shapes, given.first, self.cfg, given.name, given.where, progress,
            given.watch, make=make, masks=masks, prompts=given.prompts, checkpoint=given.checkpoint,
        )  # fmt: skip
