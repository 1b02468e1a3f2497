"""Tracking of one body by points: keyframes on its surface, and rigid registration between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.perception.backends.protocols import CameraFrames, PointTracker
from concent_warp.perception.tracking.alignment.align import Fit, agreement, refine
from concent_warp.perception.tracking.alignment.rows import Normal
from concent_warp.perception.tracking.alignment.texture import Keyframe
from concent_warp.perception.tracking.body_tracker import BodyTracker
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.geometry.pose import rotation_angle
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import Symmetry
from concent_warp.perception.tracking.geometry.view import View
from concent_warp.perception.tracking.points.point_keyframe import PointKeyframe, point_keyframe
from concent_warp.perception.tracking.points.registration import point_rows, registered
from concent_warp.perception.tracking.video import Video


class PointBodyTracker(BodyTracker):
    """State of the tracking of one body by points.

    The first pose, keyframes and searches are the model-to-frame tracker's, so that errors do not add up from keyframe
    to keyframe; poses in between are those of the points, wherever depth agrees with them.
    """

    def __init__(
        self,
        shape: TrackedShape,
        symmetry: Symmetry,
        cfg: TrackCfg,
        video: Video,
        streams: Sequence[CameraFrames],
        points: PointTracker,
    ) -> None:
        """Create a tracker of a body that is not found yet.

        Args:
            shape: The body.
            symmetry: Its symmetries.
            cfg: Settings.
            video: Moments and frames.
            streams: Frames of each camera of the video.
            points: Follows points through them.
        """
        super().__init__(shape, symmetry, cfg)
        self.video, self.streams, self.points = video, streams, points
        self.keyframes: list[PointKeyframe] = []
        """Keyframes of points; those of texture are in `textures`."""
        self.rng = np.random.default_rng(cfg.seed)
        """Source of samples."""
        self.tried = -np.inf
        """Time of the last attempt at a keyframe of points [s]."""
        self.by_points = 0
        """Moments whose pose is that of the points."""

    def followed(self, renderer: RayRenderer, time: float, views: Sequence[View]) -> Fit | None:
        """Return the fit of the points, else that near the predicted pose; None where nothing agrees."""
        # Gaps are filled backward, where points are not followed.
        ahead = len(self.fits) < len(self.video.time)
        fit = self.by_registration(renderer, views) if ahead else None
        if fit is not None:
            return self.settled(renderer, views, fit)
        return super().followed(renderer, time, views) if self.cfg.registration.fallback else None

    def recovered(
        self, renderer: RayRenderer, time: float, views: Sequence[View], rng: np.random.Generator
    ) -> Fit | None:
        """Return the fit of points that are seen again, else that of a search."""
        fit = self.by_registration(renderer, views)
        return super().recovered(renderer, time, views, rng) if fit is None else self.settled(renderer, views, fit)

    def by_registration(self, renderer: RayRenderer, views: Sequence[View]) -> Fit | None:
        """Return the fit of the points of the newest keyframe if the frames agree with it."""
        if not self.keyframes:
            return None
        keyframe, cfg = self.keyframes[-1], self.cfg
        seen = keyframe.seen(self.video.frames[len(self.fits)], views)
        found = registered(views, seen, cfg.registration, cfg.align, self.rng)
        if found is None:
            return None
        shaped = refine(renderer, views, self.shape, found.pose, cfg.align, iterations=1)
        if shaped is None:
            return None
        agreed = agreement(renderer, views, self.shape, found.pose, shaped.depth_std, cfg.accept)
        if not agreed.accepted(cfg.accept):
            return None
        geometry = shaped.geometry if cfg.registration.shape else Normal()
        self.by_points += 1
        return replace(shaped, geometry=geometry, texture=_numbered(keyframe, found.normals), agreement=agreed)

    def settled(self, renderer: RayRenderer, views: Sequence[View], fit: Fit) -> Fit:
        """Return a fit; where points run out, after keyframes were made of the moment."""
        moment = len(self.fits)
        if moment >= len(self.video.time):
            return super().settled(renderer, views, fit)
        if not self._is_due(moment, fit, views):
            return fit
        self.tried = float(self.video.time[moment])
        refined = self._on_shape(renderer, views, fit)
        if refined is not None:
            fit = super().settled(renderer, views, refined)
        made = point_keyframe(
            len(self.keyframes), moment, self.video.frames[moment], views, self.streams, renderer, self.shape,
            fit.pose, self.points, self.cfg.registration,
        )  # fmt: skip
        if made is None:
            return fit
        self.keyframes.append(made)
        seen = made.seen(self.video.frames[moment], views)
        cfg = self.cfg
        normals = []
        for view, part in zip(views, seen, strict=True):
            count = len(part.points)
            every, no_depth = np.ones(count, dtype=bool), np.zeros(count)
            normals.append(point_rows(view, part, no_depth, fit.pose, every, cfg.registration, cfg.align))
        return replace(fit, texture=[*fit.texture, *_numbered(made, normals)])

    def _is_due(self, moment: int, fit: Fit, views: Sequence[View]) -> bool:
        """Return whether the moment should be a keyframe."""
        rested = self.video.time[moment] - self.tried >= self.cfg.search.interval
        if not self.keyframes:
            return rested
        keyframe, frames = self.keyframes[-1], self.video.frames[moment]
        if keyframe.ends(frames):
            # Its points are followed no further; attempts that failed since are not repeated at once.
            return rested or self.tried == self.video.time[keyframe.moment]
        left = sum(len(part.points) for part in keyframe.seen(frames, views))
        turned = np.degrees(rotation_angle(keyframe.pose, fit.pose)) > self.cfg.texture.max_angle
        return rested and (turned or left < self.cfg.registration.min_share * keyframe.count)

    def numbered_fits(self) -> tuple[list[Fit | None], int]:
        """See `BodyTracker.numbered_fits`; keyframes of points come after those of texture."""
        count = len(self.textures.keyframes)
        fits: list[Fit | None] = []
        for fit in self.fits:
            if fit is not None:
                fit = replace(fit, texture=[(k if k >= 0 else count - 1 - k, n) for k, n in fit.texture])
            fits.append(fit)
        return fits, count + len(self.keyframes)

    def _on_shape(self, renderer: RayRenderer, views: Sequence[View], fit: Fit) -> Fit | None:
        """Return the model-to-frame tracker's fit from a fit's pose, or None where the frames do not agree with it."""
        keyframes: list[tuple[int, Keyframe] | None] = self.chosen(views, fit.pose)
        return self.accepted(renderer, views, fit.pose, keyframes, rough=False)


def _numbered(keyframe: PointKeyframe, normals: Sequence[Normal]) -> list[tuple[int, Normal]]:
    """Return the normal equations of points with the number of their keyframe, below 0: those of texture are not."""
    return [(-1 - keyframe.number, normal) for normal in normals if normal.information.any()]
