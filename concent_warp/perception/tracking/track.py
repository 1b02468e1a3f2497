"""Tracking of the movable objects in the RGB-D video of a recording: ``concent_warp.track``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from concent_warp.checks import check_settings
from concent_warp.errors import ConcentError, RecordingError, SceneError
from concent_warp.perception.backends.protocols import Masker, PointTracker
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.checkpoint import TrackCheckpoint, parts_key, tracking_key
from concent_warp.perception.tracking.first_pose import first_poses, is_pose_file, read_first_poses
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.moment import TrackedMoment
from concent_warp.perception.tracking.output import with_pose_sensors, written
from concent_warp.perception.tracking.pose_tracker import (
    ModelToFrameTracker,
    PointPoseTracker,
    PoseTracker,
    TrackingInput,
)
from concent_warp.perception.tracking.prompts import check_names, given_prompts, video_prompts, without_prompted
from concent_warp.perception.tracking.result import Tracked
from concent_warp.perception.tracking.video import Video
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.recording.validation.validate import validate
from concent_warp.run_folder import make_folder, versions
from concent_warp.scene.scene import Scene


def track(
    recording: Recording,
    cfg: TrackCfg | None = None,
    *,
    bodies: Sequence[str] | None = None,
    cameras: Sequence[str] = (),
    pose: str | Path | Mapping[str, np.ndarray] = "initial",
    scene: Scene | None = None,
    prompts: str | Path | Mapping[str, Any] | None = None,
    masker: Masker | None = None,
    points: PointTracker | None = None,
    tracker: PoseTracker | None = None,
    keep_measured: bool = False,
    images: bool = False,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[float], None] | None = None,
    watch: Callable[[TrackedMoment], None] | None = None,
) -> Tracked:
    """Return the recording with the poses of its movable objects tracked in its RGB-D video.

    Each frame's depth and edges are compared with the shape of the object, and its texture, where it has one, with
    former frames; robot and scene are rendered at the measured joint angles, so that what they hide is left out. A
    pose that does not agree with the image is not reported: the object is lost, its channels are NaN, and it is
    searched everywhere in view. Poses are smoothed forward and backward. Measured poses in the recording are not read.

    Args:
        recording: The recording; joint sensors tell the robot's configuration.
        cfg: Settings.
        bodies: Bodies with a free joint; by default all of them.
        cameras: Cameras that are used; by default all with depth.
        pose: First poses: "initial", the recording's initial state, or a search where it has none; "none", a search; a
            TOML or JSON file with position and quaternion of each body; or transforms, shape (4, 4), by body.
        scene: Scene in place of the recording's own.
        prompts: Where bodies are in the first frame of a camera, in place of first poses: by body, a click on it
            (`{"block": {"click": (312, 240)}}`, column and row in pixels) or a box around it (left, top, right,
            bottom), with `camera` where there are several; or a TOML or JSON file of these, see docs/track.md.
        masker: Makes masks of the bodies, such as `DepthMasker` or `Sam2Masker`; what is outside them is left out.
        points: Follows points, such as `FlowTracker`, `FeatureTracker` or `TapirTracker`, which then give the poses.
        tracker: Tracker of poses in place of the default, in place of `masker` and `points`, too.
        keep_measured: Whether measured poses in the recording stay instead of the tracked ones.
        images: Whether the result keeps the video.
        out: File to write the recording to, whole or not at all. The state is kept beside it until then.
        resume: Continue an interrupted tracking to the same file; the result is the same as without the interruption.
        progress: Called with the share done, 0..1.
        watch: Called after each moment, with its frames and what was found in them.

    Raises:
        RecordingError: There is no video with depth, no such body or camera, a first pose disagrees with the image, a
            prompt is outside of it, no body was found, or the state to continue from is of something else.
        ConcentError: `tracker` is given together with `masker` or `points`.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.track(cw.load_recording(cw.example("servo")))
        ... except cw.RecordingError as error:
        ...     "free joint" in str(error)
        True
    """
    cfg = cfg or TrackCfg()
    check_settings(cfg)
    tracker = _tracker(cfg, masker, points, tracker)
    scene = scene or Scene(recording.scene, recording.source)
    names = _movable(scene, bodies)
    try:
        shapes = [TrackedShape.of_body(scene, name, cfg.seed) for name in names]
    except SceneError as error:
        raise RecordingError("a body cannot be tracked", where=recording.source, found=str(error).rstrip(".")) from None
    sensed = with_pose_sensors(scene, names)
    entries = given_prompts(prompts)
    check_names(entries, [d.name for d in recording.demonstrations], names)
    kept = None
    if out is not None:
        make_folder(Path(out).parent)
        given = read_first_poses(Path(pose)) if is_pose_file(pose) else pose
        key = tracking_key(
            recording,
            cfg,
            scene.xml,
            names,
            list(cameras),
            given,
            entries,
            versions(),
            parts_key(tracker, masker, points),
        )
        kept = TrackCheckpoint.of(Path(out), key, resume=resume)
    demonstrations, tracks, remarks = [], [], []
    share_of = _shares(recording)
    for k, demonstration in enumerate(recording.demonstrations):
        where = f"{recording.source}, {demonstration.name}"
        video = Video.of(scene.model, demonstration, cameras, cfg.simultaneous, where)
        if video.unmeasured:
            remarks.append(
                f"{demonstration.name}: nothing measures {', '.join(video.unmeasured)}; taken to stand still"
            )
        first = first_poses(pose, scene, demonstration, shapes, where)
        pointed = video_prompts(entries, demonstration.name, video, where)
        first = without_prompted(first, pointed, where, initial=pose == "initial")
        step = None if progress is None else lambda share, k=k: progress(share_of(k, share))
        found = None if kept is None else kept.finished.get(demonstration.name)
        if found is None:
            given = TrackingInput(scene, video, shapes, first, demonstration.name, where, watch, pointed, kept)
            try:
                found = tracker.track(given, step)
            except RecordingError:  # it would end in the same way again
                if kept is not None:
                    kept.remove()
                raise
        if all(t.lost.all() for t in found):
            reasons = "; ".join(f"{t.body}: {t.reason or 'hidden'}" for t in found)
            if kept is not None:
                kept.remove()
            raise RecordingError(
                "no body was found in the video", where=where, expected=f"one of {list(names)}", found=reasons,
                fix="check the camera's pose and the scene, or give the first pose in a file",
            )  # fmt: skip
        if kept is not None and demonstration.name not in kept.finished:
            kept.finish(demonstration.name, found)
        options = {"keep_measured": keep_measured, "images": images}
        demonstrations.append(written(demonstration, sensed, found, shapes, video, cfg.points, **options))
        tracks += found
    result = replace(recording, scene=sensed.xml, demonstrations=tuple(demonstrations))
    if out is not None:
        write_hdf5(result, out)
        if kept is not None:
            kept.remove()
    else:
        validate(result)
    return Tracked(result, tuple(tracks), tuple(remarks))


def _tracker(
    cfg: TrackCfg, masker: Masker | None, points: PointTracker | None, tracker: PoseTracker | None
) -> PoseTracker:
    """Return what tracks poses.

    Raises:
        ConcentError: Both a tracker and parts of another one are given.
    """
    if tracker is not None:
        if masker is not None or points is not None:
            raise ConcentError("a tracker of poses has its own masks and points", expected="tracker, or masker, points")
        return tracker
    return ModelToFrameTracker(cfg, masker=masker) if points is None else PointPoseTracker(points, cfg, masker=masker)


def _shares(recording: Recording) -> Callable[[int, float], float]:
    """Return what gives the share of all frames that are done, from the demonstration's number and its own share."""
    frames = [max((len(s.time) for s in d.image.values()), default=1) for d in recording.demonstrations]
    before = np.concatenate([[0], np.cumsum(frames)])
    return lambda k, share: float((before[k] + share * frames[k]) / before[-1])


def _movable(scene: Scene, bodies: Sequence[str] | None) -> list[str]:
    """Return the names of the bodies to track.

    Raises:
        RecordingError: One has no free joint, or there is none.
    """
    model = scene.model
    free = [
        model.body(int(model.jnt_bodyid[j])).name
        for j in range(model.njnt)
        if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE
    ]
    if not free:
        raise RecordingError(
            "the scene has no object to track", where=scene.source, expected="a body with a free joint", found="none"
        )
    if unknown := [b for b in bodies or () if b not in free]:
        raise RecordingError(
            "a body cannot be tracked", where=scene.source, expected=f"bodies with a free joint: {free}", found=unknown
        )
    return list(bodies or free)
