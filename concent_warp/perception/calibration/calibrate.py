"""Camera poses of a recording, with intervals, from tags or from the robot itself in view."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from concent_warp.checks import check_settings
from concent_warp.errors import RecordingError
from concent_warp.files import all_or_none, write_json
from concent_warp.perception.calibration.by_robot import calibrate_by_robot
from concent_warp.perception.calibration.by_targets import calibrate_by_targets, find_views
from concent_warp.perception.calibration.cfg import CalibrateCfg
from concent_warp.perception.calibration.footage import Footage, footage_of
from concent_warp.perception.calibration.joint_motion import JointMotion
from concent_warp.perception.calibration.result import Calibration, CameraCalibration
from concent_warp.perception.calibration.targets import mistaken_target, no_target_error
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene

JSON_NAME = "calibration.json"
"""Name of the file beside the recording."""


def calibrate(
    recording: Recording,
    cfg: CalibrateCfg | None = None,
    *,
    out: str | Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Calibration:
    """Return the poses of a recording's cameras with 95 % intervals, the clock offset, and what is off.

    A camera fixed in the world sees a tag on the hand, or a camera on the hand sees a tag fixed in the world; where no
    tag is found, the robot itself is aligned with the depth of a fixed camera. Joint sensors of the scene give the
    robot's angles.

    Args:
        recording: Frames and joint readings; the recorded camera poses matter only without tags, as a rough start.
        cfg: Settings.
        out: Recording to write, with calibrated poses, intrinsics and times of frames; `calibration.json` goes beside
            it.
        progress: Called with the share done, 0..1.

    Raises:
        RecordingError: There are no images, joint readings or targets, the motion does not determine a pose, or no pose
            agrees with the images; nothing is returned that has not been confirmed.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.calibrate(cw.load_recording(cw.example("servo")))
        ... except cw.RecordingError as error:
        ...     "no camera" in str(error)
        True
    """
    cfg = cfg or CalibrateCfg()
    check_settings(cfg)
    report = progress or (lambda _: None)
    names = list(dict.fromkeys(name for d in recording.demonstrations for name in d.image))
    if not names:
        raise RecordingError(
            "there is no camera to calibrate",
            where=recording.source,
            expected="RGB-D frames in image/<camera>",
            found="no images",
        )
    if unknown := sorted(set(cfg.cameras) - set(names)):
        raise RecordingError(
            "there is no such camera", where=recording.source, expected=f"some of {names}", found=unknown
        )
    chosen = [name for name in names if not cfg.cameras or name in cfg.cameras]
    scene = Scene(recording.scene, recording.source)
    filmed = [d for d in recording.demonstrations if d.image]
    motions = {d.name: JointMotion(scene, d, recording.source) for d in filmed}
    cameras = {}
    for k, name in enumerate(chosen):
        footage = footage_of(recording, name, scene, motions, cfg.limits.max_offset)
        cameras[name] = _calibrated(footage, cfg, lambda share, k=k: report((k + share) / len(chosen)))
    result = Calibration(recording, cameras)
    if out is not None:
        write_calibration(result, Path(out))
    return result


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Write the calibrated recording, and `calibration.json` beside it, both or none.

    Raises:
        RecordingError: A file cannot be written.
    """
    with all_or_none():
        write_hdf5(calibration.recording, path)
        write_json(path.parent / JSON_NAME, calibration.to_json())


def _calibrated(footage: Footage, cfg: CalibrateCfg, progress: Callable[[float], None]) -> CameraCalibration:
    """Return the calibration of one camera by what is to be seen."""
    if cfg.target.method == "robot":
        return calibrate_by_robot(footage, cfg, progress)
    views = find_views(footage, cfg, lambda share: progress(0.4 * share))
    if any(views.values()) or cfg.target.method != "auto":
        return calibrate_by_targets(footage, views, cfg, lambda share: progress(0.4 + 0.6 * share))
    # Another dictionary or mirrored tags are a mistake; a view of the robot without any tag is none.
    mistake = mistaken_target(footage.first, cfg, footage.where)
    if (
        mistake is not None
        or footage.first.body is not None
        or not any(s.depth.any() for s in footage.streams.values())
    ):
        raise mistake or no_target_error(footage.first, cfg, footage.where)
    return calibrate_by_robot(footage, cfg, progress)
