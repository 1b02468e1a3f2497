"""Tracking of all bodies through one demonstration: forward, backward into gaps, smoothed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.perception.tracking.body_tracker import BodyTracker
from concent_warp.perception.tracking.bundle import bundled
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.checkpoint import TrackCheckpoint
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import Symmetry, symmetry_of
from concent_warp.perception.tracking.masks import BodyMasks
from concent_warp.perception.tracking.moment import BodyState, TrackedMoment
from concent_warp.perception.tracking.prompts import Prompt
from concent_warp.perception.tracking.result import BRIDGED, FILLED, LOST, TRACKED, BodyTrack, TrackQuality
from concent_warp.perception.tracking.smooth import smooth
from concent_warp.perception.tracking.video import Video
from concent_warp.scene.scene import Scene

FIX = 'check the pose and the camera, or search the object with --pose none (pose="none")'
"""What to do about a wrong first pose."""


def track_bodies(
    scene: Scene,
    video: Video,
    shapes: list[TrackedShape],
    first: Mapping[str, np.ndarray],
    cfg: TrackCfg,
    name: str,
    where: str,
    progress: Callable[[float], None] | None,
    watch: Callable[[TrackedMoment], None] | None = None,
    *,
    make: Callable[[TrackedShape, Symmetry, TrackCfg], BodyTracker] = BodyTracker,
    masks: BodyMasks | None = None,
    prompts: Mapping[str, Prompt] | None = None,
    checkpoint: TrackCheckpoint | None = None,
) -> list[BodyTrack]:
    """Return the tracks of bodies in one demonstration.

    Args:
        scene: The scene.
        video: Its frames.
        shapes: The bodies.
        first: First poses, shape (4, 4), by body; bodies without one are searched.
        cfg: Settings.
        name: The demonstration's name.
        where: File and demonstration, for messages.
        progress: Called with the share done, 0..1.
        watch: Called after each moment.
        make: Creates the tracker of a body.
        masks: Pixels of the bodies, where they are known.
        prompts: Where a user says that bodies without first pose are, by body.
        checkpoint: State that the tracking continues from, and is written to now and then.

    Raises:
        RecordingError: A given first pose does not agree with the video.
    """
    renderer = RayRenderer(scene.model)
    trackers = [make(s, symmetry_of(s, cfg.symmetry_tolerance), cfg) for s in shapes]
    masks = masks or BodyMasks()
    rng = np.random.default_rng(cfg.seed)
    count, prompts = len(video.time), prompts or {}
    done = 0 if checkpoint is None else checkpoint.begin(name, trackers, rng)
    # Bodies that a user pointed at are found first, so that they are known to the search for others like them.
    ordered = sorted(trackers, key=lambda t: t.shape.name not in prompts)
    for moment in range(done, count):
        time = video.time[moment]
        renderer.set_state(video.qpos[moment])
        for tracker in trackers:
            here = first.get(tracker.shape.name) if moment == 0 else tracker.pose if tracker.tracked else None
            renderer.place(tracker.shape.row, here)
        all_views = video.views(moment, renderer)
        for tracker in ordered:
            views = masks.on(all_views, video.frames[moment], tracker.shape.name)
            given, prompt = first.get(tracker.shape.name), prompts.get(tracker.shape.name)
            tracker.regions = () if prompt is None or tracker.pose is not None else prompt.regions(video.frames[moment])
            if moment == 0 and given is not None:
                _begin(tracker, renderer, float(time), views, given, where)
                if tracker.tracked:
                    continue
            tracker.advance(renderer, float(time), views, rng)
            if moment == 0 and given is not None and tracker.tracked:
                _check_correction(tracker, given, where)
        if watch is not None:
            states = [BodyState(t.shape, t.pose if t.tracked else None, t.reasons[moment]) for t in trackers]
            watch(TrackedMoment(name, moment, count, float(time), video.shown(moment, all_views), states, renderer))
        if checkpoint is not None:
            checkpoint.advance(name, moment + 1, trackers, rng)
        if progress is not None:
            progress(0.9 * (moment + 1) / count)
    for tracker in trackers:
        _fill_backward(tracker, trackers, renderer, video, masks)
    tracks = [_smoothed(tracker, video, cfg, name) for tracker in trackers]
    if progress is not None:
        progress(1.0)
    return tracks


def _begin(
    tracker: BodyTracker,
    renderer: RayRenderer,
    time: float,
    views: list,
    given: np.ndarray,
    where: str,
) -> None:
    """Start at a given pose; where known bodies hide the object there, leave it to the search."""
    agreed = tracker.begin(renderer, time, views, given)
    body = tracker.shape.name
    if not tracker.tracked:
        hidden = agreed.visible < tracker.cfg.accept.min_visible
        if hidden:
            tracker.pose = given
            return
        raise RecordingError(
            f"the first pose of {body!r} does not agree with the image",
            where=f"{where}, first frame",
            expected=f"at least {tracker.cfg.accept.min_agreement:.0%} of its pixels at the depth of its surface",
            found=agreed.text(),
            fix=FIX,
        )
    _check_correction(tracker, given, where)


def _check_correction(tracker: BodyTracker, given: np.ndarray, where: str) -> None:
    """Raise an error where the image shows the object far from its given first pose, shape (4, 4)."""
    cfg, body = tracker.cfg, tracker.shape.name
    shift, turn = tracker.correction(given)
    if shift > cfg.max_first_translation or np.degrees(turn) > cfg.max_first_rotation:
        raise RecordingError(
            f"the first pose of {body!r} is far from where the image shows it",
            where=f"{where}, first frame",
            expected=f"within {1e3 * cfg.max_first_translation:g} mm and {cfg.max_first_rotation:g} degrees",
            found=f"{1e3 * shift:.1f} mm and {np.degrees(turn):.1f} degrees",
            fix=FIX,
        )


def _fill_backward(
    tracker: BodyTracker, others: list[BodyTracker], renderer: RayRenderer, video: Video, masks: BodyMasks
) -> None:
    """Follow a body backward from where it was found into the moments before, in which it was not."""
    fits = tracker.fits
    for moment in range(len(fits) - 2, -1, -1):
        after = fits[moment + 1]
        if fits[moment] is not None or after is None:
            continue
        renderer.set_state(video.qpos[moment])
        for other in others:
            if other is not tracker:
                there = other.fits[moment]
                renderer.place(other.shape.row, None if there is None else there.pose)
        tracker.pose, tracker.tracked, tracker.speed = after.pose, True, np.zeros(6)
        tracker.time = float(video.time[moment])
        views = masks.on(video.views(moment, renderer), video.frames[moment], tracker.shape.name)
        fits[moment] = tracker.followed(renderer, tracker.time, views)


def _smoothed(tracker: BodyTracker, video: Video, cfg: TrackCfg, name: str) -> BodyTrack:
    """Return the smoothed track of a body, NaN in gaps."""
    time = video.time
    pose = np.full((len(time), 4, 4), np.nan)
    covariance = np.full((len(time), 6, 6), np.nan)
    seen = np.array([fit is not None for fit in tracker.fits])
    bundle = bundled(*tracker.numbered_fits(), cfg.align, tracker.keyframe_turns())
    common = np.full(bundle.common.shape, np.nan)
    centre = tracker.symmetry.centre if tracker.symmetry.chosen_turns().any() else None
    # Stretches between long gaps are independent: nothing is known of the motion in between.
    rows = np.flatnonzero(seen)
    for part in np.split(rows, np.flatnonzero(np.diff(time[rows]) > cfg.smooth.max_gap) + 1) if len(rows) else []:
        span = slice(part[0], part[-1] + 1)
        poses, covariances = smooth(time[span], bundle.measurements[span], tracker.shape.radius, cfg.smooth, centre)
        shared = np.array([bundle.common[part[np.abs(part - t).argmin()]] for t in range(part[0], part[-1] + 1)])
        pose[span], covariance[span] = poses, covariances + shared @ np.swapaxes(shared, 1, 2)
        common[span] = shared
    # A gap in which the velocity has jumped cannot be bridged.
    worst = np.sqrt(np.linalg.eigvalsh(np.where(np.isfinite(covariance), covariance, 0.0)[:, :3, :3])[:, -1])
    unknown = ~seen & (worst > cfg.accept.max_translation_std)
    pose[unknown], covariance[unknown], common[unknown] = np.nan, np.nan, np.nan
    textured = any(fit is not None and fit.texture for fit in tracker.fits)
    quality = _quality(tracker, np.isfinite(pose[:, 0, 0]))
    return BodyTrack(
        name, tracker.shape.name, time, pose, covariance, tracker.symmetry.name, textured, tracker.reason, quality,
        tuple(video.cameras), common,
    )  # fmt: skip


def _quality(tracker: BodyTracker, known: np.ndarray) -> TrackQuality:
    """Return what the frames say about each moment's pose, which is known or not, shape (T,) bool."""
    state = []
    for fit, reason, has_pose in zip(tracker.fits, tracker.reasons, known, strict=True):
        if fit is not None:
            state.append(FILLED if reason else TRACKED)
        else:
            state.append(BRIDGED if has_pose else LOST)
    values = np.full((6, len(known)), np.nan)
    for t, fit in enumerate(tracker.fits):
        if fit is not None:
            agreed = fit.agreement
            values[:4, t] = fit.depth_std, fit.edge_std, fit.texture_std, fit.texture_correlation
            values[4:, t] = (np.nan, np.nan) if agreed is None else (agreed.share, min(agreed.visible, 1.0))
    return TrackQuality(tuple(state), tuple(tracker.reasons), *values)
