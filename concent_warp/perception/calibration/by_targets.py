"""Calibration of a camera by tags and boards: which body carries them, a closed-form start, and the joint fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.perception.calibration.bundle import (
    CAMERA,
    CLOCK,
    INTRINSICS,
    SIZE,
    BundleFit,
    Estimate,
    Frame,
    Problem,
    fit,
    project,
)
from concent_warp.perception.calibration.cfg import CalibrateCfg
from concent_warp.perception.calibration.checks import (
    UNKNOWN_FOCAL,
    depth_check,
    intrinsic_checks,
    quantile,
    radial_check,
    remarks_on,
    size_check,
)
from concent_warp.perception.calibration.clock import ClockSearch
from concent_warp.perception.calibration.footage import Footage
from concent_warp.perception.calibration.hand_eye import (
    HandEye,
    is_distinct,
    park_martin,
    placed_target,
    rotation_spread,
    target_poses,
)
from concent_warp.perception.calibration.result import CameraCalibration, Check, FrameError
from concent_warp.perception.calibration.targets import CORNERS, TargetView, detect, no_target_error

FITTING_ANGLE, FITTING_DISTANCE = np.radians(3.0), 0.03
"""Median disagreement of the views [rad, m] up to which bodies may carry camera and target."""
SURE_SHARE = 0.4
"""Disagreement of another pair of bodies, over that of the given one, below which it is named."""
MAX_OUTLIERS = 0.35
"""Share of frames without weight above which a fit is refused."""
KNOWN_POSITION, KNOWN_ANGLE = 0.03, np.radians(3.0)
"""Half widths of intervals above which a pose is not determined [m, rad]."""
UNKNOWN_SIZE = 1.0
"""Standard deviation of the size of a target where it is not what was stated [-]."""
SUSPICIOUS_RESIDUAL, SUSPICIOUS_SIZE = 1.0, 0.05
"""Residual [px], and logarithm of the size in the closed form, above which the stated size is not held to."""
CLEARLY_BETTER = 0.8
"""Residual with fitted intrinsics over that with another size, below which intrinsics are wrong, and not the size
[-]."""
MIN_TURN = np.radians(2.0)
"""Rotation of the bodies against one another below which the arm stands still [rad]."""


@dataclass(frozen=True)
class Run:
    """Views of the most frequent target in one demonstration."""

    demonstration: str
    time: np.ndarray
    """Times by the camera's clock [s], shape (n,)."""
    seen: np.ndarray
    """Poses of the target in the camera's frame, shape (n, 4, 4)."""


def find_views(footage: Footage, cfg: CalibrateCfg, progress: Callable[[float], None]) -> dict[str, list[TargetView]]:
    """Return the views of targets that are large enough, by demonstration; none at all where there is no target."""
    views, done = {}, 0.0
    for name, stream in footage.streams.items():
        step = 1 / len(footage.streams)
        views[name] = detect(stream, cfg.target, lambda share, done=done, step=step: progress(done + step * share))
        done += step
    return views


def calibrate_by_targets(
    footage: Footage, views: dict[str, list[TargetView]], cfg: CalibrateCfg, progress: Callable[[float], None]
) -> CameraCalibration:
    """Return the calibration of a camera by the targets that it sees.

    Args:
        footage: The camera and the robot's motion.
        views: Views of targets by demonstration.
        cfg: Settings.
        progress: Called with the share done, 0..1.

    Raises:
        RecordingError: There are too few views, the motion does not determine the pose, or no pose agrees with them.
    """
    views = _large_enough(footage, views, cfg)
    main = _most_frequent(views)
    runs = [_run(name, footage, v, main) for name, v in views.items() if any(one.target == main for one in v)]
    bodies, offset, start = _carriers(footage, views, runs, cfg)
    progress(0.2)
    frames = _frames(footage, views, bodies, offset, cfg)
    _check_spread(footage, frames, bodies, offset, cfg)
    estimate = _start(footage, frames, bodies, offset, start, main)
    free = (SIZE, CLOCK) if cfg.fit_clock else (SIZE,)
    problem = Problem(frames, *bodies, free, cfg.limits.robust_width)
    remarks: list[str] = []
    fitted = fit(problem, estimate)
    if cfg.fit_clock and fitted.std(CLOCK)[0] * 2 > 0.25 * cfg.limits.max_offset:
        remarks.append("the clock offset cannot be seen, since the arm stands still in the views; it is taken as 0")
        problem = Problem(frames, *bodies, (SIZE,), cfg.limits.robust_width)
        fitted = fit(problem, Estimate(estimate.camera, estimate.targets, estimate.intrinsics))
    if fitted.rms > SUSPICIOUS_RESIDUAL and abs(np.log(start.size)) > SUSPICIOUS_SIZE:
        problem = replace(problem, size_std=UNKNOWN_SIZE)
        fitted = fit(problem, estimate)
    elif abs(np.log(fitted.estimate.size)) > 2 * problem.size_std:
        problem = replace(problem, size_std=UNKNOWN_SIZE)
        fitted = fit(problem, fitted.estimate)
    _check_agreement(footage, problem, fitted, cfg)
    progress(0.6)
    wide_problem = replace(problem, free=(*problem.free, INTRINSICS))
    wide = fit(wide_problem, fitted.estimate)
    progress(0.9)
    stated = np.asarray(footage.first.intrinsics, float)
    checks = intrinsic_checks(wide, stated)
    unknown = max(c.high - c.low for c in checks[:2]) / 2 > UNKNOWN_FOCAL
    if cfg.fit_intrinsics:
        if unknown:
            raise RecordingError(
                "the views do not determine the focal length: the target is seen from one direction",
                where=footage.where,
                expected=f"an interval of ± {UNKNOWN_FOCAL:g} % at most",
                found=f"± {max(c.high - c.low for c in checks[:2]) / 2:.1f} %",
                fix="tilt the target by 30 degrees and more to several sides and show it at two distances, or leave "
                "--fit-intrinsics out",
            )
        problem, fitted = wide_problem, wide
    radial = radial_check(wide, wide_problem)
    checks = [] if unknown else [*checks, radial]
    wrong = any(c.off for c in checks)
    size = size_check(wide if wrong and wide.rms < CLEARLY_BETTER * fitted.rms else fitted)
    depth = depth_check(wide if wrong else fitted, wide_problem if wrong else problem, footage)
    _check_size(footage, size, depth, cfg)
    _check_determined(footage, fitted)
    checks += [size] + ([] if depth is None else [depth])
    remarks += remarks_on(checks, fitted=cfg.fit_intrinsics)
    if wrong and not cfg.fit_intrinsics:
        shift = float(np.linalg.norm(wide.estimate.camera[:3, 3] - fitted.estimate.camera[:3, 3]))
        remarks.append(
            "the intervals of the pose assume that the recorded intrinsics are right, which they seem not to be: with "
            f"fitted ones the position is {1e3 * shift:.1f} mm aside"
        )
    remarks += _pose_remarks(footage, fitted)
    estimate = fitted.estimate
    factor = quantile(fitted)
    half = factor * fitted.std(CAMERA)
    has_clock = CLOCK in problem.free
    return CameraCalibration(
        name=footage.name,
        method=cfg.target.method if cfg.target.method != "auto" else "tags",
        pose=estimate.camera,
        body=footage.first.body,
        recorded_pose=np.asarray(footage.first.pose, float),
        position_interval=half[3:],
        rotation_interval=half[:3],
        intrinsics=estimate.intrinsics,
        distortion=(*map(float, estimate.radial), 0.0, 0.0) if cfg.fit_intrinsics else (),
        size=footage.size,
        clock_offset=estimate.offset,
        clock_interval=factor * float(fitted.std(CLOCK)[0]) if has_clock else None,
        residual=fitted.rms,
        frames=_frame_errors(problem, fitted),
        target_body=None if bodies[1] == "world" else bodies[1],
        targets=estimate.targets,
        checks=tuple(checks),
        remarks=tuple(remarks),
    )


def _large_enough(
    footage: Footage, views: dict[str, list[TargetView]], cfg: CalibrateCfg
) -> dict[str, list[TargetView]]:
    """Return the views whose targets are large enough in the image.

    Raises:
        RecordingError: There is no target, all are too small, or there are too few frames.
    """
    kept = {name: [v for v in some if v.edge >= cfg.limits.min_edge] for name, some in views.items()}
    found = [v for some in views.values() for v in some]
    if not found:
        raise no_target_error(footage.first, cfg, footage.where)
    frames = {(name, v.frame) for name, some in kept.items() for v in some}
    if not frames:
        raise RecordingError(
            "the tags are too small in the images",
            where=footage.where,
            expected=f"edges of {cfg.limits.min_edge:g} px and more",
            found=f"{max(v.edge for v in found):.1f} px in images of {footage.size[0]} x {footage.size[1]} px",
            fix="record larger images, print larger tags, or move them nearer",
        )
    if len(frames) < cfg.limits.min_views:
        raise RecordingError(
            "too few frames show a target",
            where=footage.where,
            expected=f"{cfg.limits.min_views} and more, with the hand turned to all sides",
            found=len(frames),
            fix="record more views, or give --limits.min-views",
        )
    return kept


def _most_frequent(views: dict[str, list[TargetView]]) -> str:
    """Return the target with most views."""
    names = [v.target for some in views.values() for v in some]
    return max(sorted(set(names)), key=names.count)


def _run(name: str, footage: Footage, views: list[TargetView], target: str) -> Run:
    """Return the views of a target in a demonstration."""
    stream = footage.streams[name]
    solved = [(v.frame, target_poses(v, stream.intrinsics)) for v in views if v.target == target]
    sure = [(row, poses[0][0]) for row, poses in solved if is_distinct(poses)]
    if len(sure) < 3:
        sure = [(row, poses[0][0]) for row, poses in solved]
    return Run(name, stream.time[[row for row, _ in sure]], np.array([pose for _, pose in sure]))


def _carriers(
    footage: Footage, views: dict[str, list[TargetView]], runs: list[Run], cfg: CalibrateCfg
) -> tuple[tuple[str, str], float, HandEye]:
    """Return the bodies that carry camera and target, the clock offset [s] and the closed-form solution.

    Raises:
        RecordingError: No body carries a target so that the views agree.
    """
    motion = next(iter(footage.motions.values()))
    moving = motion.moving_bodies()
    if cfg.target.body != "auto":
        _check_body(footage, cfg.target.body)
        candidates = [cfg.target.body]
    else:
        candidates = [*(["world"] if footage.body != "world" else []), *moving]
    motion.joints(*(b for b in (footage.body, *candidates[:1]) if b != "world"))
    data = [(footage.motions[r.demonstration], r.time, r.seen) for r in runs]
    clock = ClockSearch(data, cfg.limits.max_offset, fixed=not cfg.fit_clock)
    tried = [(body, *_closed_form(footage, runs, (footage.body, body), clock)) for body in candidates]
    if all(start is None for _, _, start in tried):
        raise RecordingError(
            "camera and target do not move against one another, so nothing can be calibrated",
            where=footage.where,
            expected="a hand that carries one of the two and turns to all sides while the other one is fixed",
            found="joints that stand still",
            fix="move the arm, or name the body that carries the target with --target-body",
        )
    body, offset, start = min(((b, o, s) for b, o, s in tried if s is not None), key=lambda one: _disagreement(one[2]))
    if start.angle_error < FITTING_ANGLE and start.position_error < FITTING_DISTANCE:
        return (footage.body, body), offset, start
    _frames(footage, views, (footage.body, body), offset, cfg)  # gaps in the readings come first
    for camera in ["world", *moving]:
        for target in ["world", *moving]:
            if camera not in (target, footage.body):
                other = _closed_form(footage, runs, (camera, target), clock)[1]
                if other is not None and _disagreement(other) < SURE_SHARE * min(_disagreement(start), 1.0):
                    raise RecordingError(
                        f"the camera is not on {footage.body}",
                        where=footage.where,
                        expected=f"views that agree with a camera on {footage.body}",
                        found=f"views that agree with a camera on {camera} and a target on {target}",
                        fix="correct the attribute `body` of the camera",
                    )
    raise RecordingError(
        f"no pose of the camera on {footage.body} agrees with the views",
        where=footage.where,
        expected="a target that is fixed to the world or to a body of the robot",
        found=f"views that differ by {np.degrees(start.angle_error):.1f} deg and {1e3 * start.position_error:.0f} mm "
        f"in the middle, with a target on {body}",
        fix="check that the tag is not moved, that joint readings belong to this robot, and their signs and units",
    )


def _check_body(footage: Footage, body: str) -> None:
    """Raise an error unless the scene has a body."""
    model = footage.scene.model
    names = [model.body(i).name for i in range(model.nbody)]
    if body not in names:
        raise RecordingError(
            "the target is on a body that the scene lacks",
            where=footage.where,
            expected=f"one of {names}, or auto",
            found=body,
            fix="give --target-body",
        )


def _disagreement(start: HandEye) -> float:
    """Return by how much views disagree, 1 where it is just too much."""
    return max(start.angle_error / FITTING_ANGLE, start.position_error / FITTING_DISTANCE)


def _closed_form(
    footage: Footage, runs: list[Run], bodies: tuple[str, str], clock: ClockSearch
) -> tuple[float, HandEye | None]:
    """Return the clock offset [s] and the closed-form solution; None where the bodies do not turn."""
    offset = clock.offset(bodies)
    relative = np.concatenate([_relative(footage, r.demonstration, r.time + offset, bodies) for r in runs])
    seen = np.concatenate([r.seen for r in runs])
    if len(relative) < 3 or rotation_spread(relative)[0][0] < MIN_TURN:
        return offset, None
    return offset, park_martin(relative, seen)


def _relative(footage: Footage, demonstration: str, time: np.ndarray, bodies: tuple[str, str]) -> np.ndarray:
    """Return the poses of the camera's body in the frame of the target's body at times (n,) [s], shape (n, 4, 4)."""
    motion = footage.motions[demonstration]
    qpos = motion.angles(np.clip(time, *motion.span))
    return np.linalg.inv(motion.poses(qpos, bodies[1])) @ motion.poses(qpos, bodies[0])


def _frames(
    footage: Footage, views: dict[str, list[TargetView]], bodies: tuple[str, str], offset: float, cfg: CalibrateCfg
) -> list[Frame]:
    """Return the frames in which there are targets and the joints have readings.

    Raises:
        RecordingError: There are too few of them.
    """
    frames = []
    for name, some in views.items():
        motion, stream = footage.motions[name], footage.streams[name]
        joints = motion.joints(*(b for b in bodies if b != "world"))
        rows = sorted({v.frame for v in some})
        covered = motion.covered(joints, stream.time[rows] + offset, cfg.limits.max_gap)
        frames += [
            Frame(motion, name, float(stream.time[row]), tuple(v for v in some if v.frame == row), row)
            for row, ok in zip(rows, covered, strict=True)
            if ok
        ]
    if len(frames) < cfg.limits.min_views:
        raise RecordingError(
            "too few frames lie where the joints have readings",
            where=footage.where,
            expected=f"{cfg.limits.min_views} frames with gaps of at most {cfg.limits.max_gap:g} s between readings",
            found=f"{len(frames)} of {sum(len({v.frame for v in some}) for some in views.values())} with a target",
            fix="check the clocks and gaps of the joint sensors, or give --limits.max-gap",
        )
    step = len(frames) / min(len(frames), cfg.limits.max_frames)
    return [frames[int(i * step)] for i in range(min(len(frames), cfg.limits.max_frames))]


def _check_spread(
    footage: Footage, frames: list[Frame], bodies: tuple[str, str], offset: float, cfg: CalibrateCfg
) -> None:
    """Raise an error where the bodies turn about one axis only."""
    relative = np.concatenate(
        [_relative(footage, f.demonstration, np.array([f.time + offset]), bodies) for f in frames]
    )
    size, axes = rotation_spread(relative)
    if np.degrees(size[1]) >= cfg.limits.min_rotation:
        return
    carrier = bodies[0] if bodies[0] != "world" else bodies[1]
    if bodies[0] == "world":
        axes = rotation_spread(np.linalg.inv(relative))[1]
    axis = ", ".join(f"{value:.2f}" for value in axes[0] * np.sign(axes[0][np.argmax(np.abs(axes[0]))]))
    raise RecordingError(
        f"the motion does not determine the camera's pose: {carrier} turns about one axis only, ({axis}) in its frame, "
        "and positions along it cannot be distinguished",
        where=footage.where,
        expected=f"rotations of {cfg.limits.min_rotation:g} deg about a second axis",
        found=f"{np.degrees(size[0]):.1f} deg about this axis and {np.degrees(size[1]):.1f} deg about others",
        fix="tilt the hand to several sides while the target is in view",
    )


def _start(
    footage: Footage, frames: list[Frame], bodies: tuple[str, str], offset: float, start: HandEye, main: str
) -> Estimate:
    """Return where the joint fit starts: the closed-form solution, and other targets placed by it."""
    intrinsics = np.asarray(footage.first.intrinsics, float)
    targets = {main: start.target}
    for name in sorted({v.target for f in frames for v in f.views} - {main}):
        seen = [(f, target_poses(v, intrinsics)[0][0]) for f in frames for v in f.views if v.target == name]
        relative = np.concatenate(
            [_relative(footage, f.demonstration, np.array([f.time + offset]), bodies) for f, _ in seen]
        )
        targets[name] = placed_target(relative, start.camera, np.array([pose for _, pose in seen]), start.size)[0]
    return Estimate(start.camera, targets, intrinsics, offset, size=start.size)


def _check_agreement(footage: Footage, problem: Problem, fitted: BundleFit, cfg: CalibrateCfg) -> None:
    """Raise an error where the views do not agree with one pose."""
    lost = [f for f, w in zip(problem.frames, fitted.weights, strict=True) if w < 0.5]
    share = len(lost) / len(problem.frames)
    if share > MAX_OUTLIERS:
        first, last = min(f.time for f in lost), max(f.time for f in lost)
        raise RecordingError(
            "many frames contradict the others, as when the tag or the camera is moved",
            where=footage.where,
            expected=f"at most {MAX_OUTLIERS:.0%} of the frames",
            found=f"{share:.0%}, from {first:.1f} to {last:.1f} s",
            fix="fix tag and camera, or cut the recording there",
        )
    if fitted.rms > cfg.limits.max_residual:
        raise RecordingError(
            "the views do not agree with one pose of the camera",
            where=footage.where,
            expected=f"reprojection errors of {cfg.limits.max_residual:g} px at most",
            found=f"{fitted.rms:.1f} px",
            fix="check joint readings, the body of the camera and that nothing was moved",
        )


def _check_size(footage: Footage, check: Check, depth: Check | None, cfg: CalibrateCfg) -> None:
    """Raise an error where the targets have another size than stated."""
    if not check.off or abs(check.value) < 100 * cfg.limits.size_tolerance:
        return
    size = cfg.target.tag_size * (1 + check.value / 100)
    low, high = (cfg.target.tag_size * (1 + v / 100) for v in (check.low, check.high))
    # Depth was compared with targets of the fitted size.
    agreed = "and depth say" if depth is not None and abs(depth.value) < abs(check.value) / 2 else "says"
    raise RecordingError(
        "the size of the tags is wrong",
        where=footage.where,
        expected=f"edges of {size:.4f} m (95 %: {low:.4f} to {high:.4f}), as the robot's motion {agreed}",
        found=f"{cfg.target.tag_size:g} m",
        fix="measure the black square and give --tag-size in metres",
    )


def _check_determined(footage: Footage, fitted: BundleFit) -> None:
    """Raise an error where the interval of the pose is too wide, and name the direction."""
    block, factor = fitted.block(CAMERA), quantile(fitted)
    for part, limit, unit, name in (
        (block[3:, 3:], KNOWN_POSITION, 1e3, "position along"),
        (block[:3, :3], KNOWN_ANGLE, 180 / np.pi, "rotation about"),
    ):
        value, vector = np.linalg.eigh(part)
        half = factor * float(np.sqrt(value[-1]))
        if half > limit:
            axis = ", ".join(f"{v:.2f}" for v in vector[:, -1])
            frame = footage.body if name.startswith("position") else "the camera"
            raise RecordingError(
                f"the views do not determine the camera's {name} ({axis}) in the frame of {frame}",
                where=footage.where,
                expected=f"an interval of ± {limit * unit:.0f} {'mm' if unit == 1e3 else 'deg'} at most",
                found=f"± {half * unit:.0f}",
                fix="turn the hand to more sides, farther, and show the target larger",
            )


def _pose_remarks(footage: Footage, fitted: BundleFit) -> list[str]:
    """Return what is said about the recorded pose where it was written in other axes or the other way round."""
    recorded, found = np.asarray(footage.first.pose, float), fitted.estimate.camera

    def angle(pose: np.ndarray) -> float:
        return float(np.arccos(np.clip((np.trace(pose[:3, :3].T @ found[:3, :3]) - 1) / 2, -1, 1)))

    remarks = []
    if angle(recorded) > np.radians(30):
        if angle(recorded @ np.diag([1.0, -1, -1, 1])) < np.radians(15):
            remarks.append(
                "the recorded pose has y up and z backwards, as in OpenGL; recordings have y down, z forward"
            )
        elif angle(np.linalg.inv(recorded)) < np.radians(15):
            remarks.append("the recorded pose is the inverse one; recordings have camera-to-world, or camera-to-body")
    return remarks


def _frame_errors(problem: Problem, fitted: BundleFit) -> tuple[FrameError, ...]:
    """Return the errors of all frames, with the projected outlines of tags."""
    result = []
    estimate = fitted.estimate
    relative = np.linalg.inv(estimate.camera) @ problem.relative(estimate.offset)
    for frame, errors, weight, pose in zip(problem.frames, fitted.residuals, fitted.weights, relative, strict=True):
        outlines = []
        for view in frame.views:
            low, high = view.points.min(axis=0), view.points.max(axis=0)
            corners = np.where(CORNERS > 0, high, low) * np.array([1, 1, 0])
            placed = pose @ estimate.targets[view.target]
            outlines.append(project(placed, estimate.size * corners, estimate.intrinsics, estimate.radial))
        pixels = np.concatenate([v.pixels for v in frame.views])
        time = frame.time + estimate.offset
        result.append(FrameError(frame.demonstration, frame.row, time, pixels, errors, float(weight), tuple(outlines)))
    return tuple(result)
