"""Calibration of a fixed camera by the robot itself: its shape at its measured joint angles against depth and outline.

From a rough start, points that move are first brought onto the rendered surface (point-to-plane: Chen and Medioni,
"Object modelling by registration of multiple range images", Image and Vision Computing 10(3), 1992), then all pixels
in which the robot is rendered, and edges of brightness along its outline, are aligned in all frames together. Weights
are Tukey's. The intervals are those of a jackknife over frames (Efron and Stein, Annals of Statistics 9(3), 1981),
since errors within a frame, as of its joint angles, are not independent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.perception.calibration.cfg import CalibrateCfg
from concent_warp.perception.calibration.checks import NOTEWORTHY_DEPTH, remarks_on
from concent_warp.perception.calibration.footage import Footage
from concent_warp.perception.calibration.result import CameraCalibration, Check, FrameError
from concent_warp.perception.calibration.robot_surface import RobotSurface, Surface
from concent_warp.perception.calibration.robot_terms import (
    CLOCK,
    COUNT,
    EDGE,
    KNOWN,
    POSE,
    SCALE,
    Equations,
    State,
    depth_terms,
    half_widths,
    normal_equations,
    outline_terms,
    solve,
    spread,
)
from concent_warp.perception.pinhole import Pinhole

UNKNOWN_SCALE = 0.1
"""Standard deviation of the scale of depth where it is checked [-]."""
MOST_POINTS = 1500
"""Moving points of a frame that are used."""
FEWEST_PIXELS = 60
"""Pixels of the robot in a frame from which on it is used."""
DEPTH_STD, OUTLINE_STD = 5e-4, 2.0
"""Standard deviations of depth [m] and of the place of an outline [px] that are taken at least: shading near an
outline shifts its edge by 0.2 px and more, along all of it alike, so that its many points count for less than as many
depths."""
MAX_SLANT = 0.25
"""Cosine of the angle of view and normal up to which depth of a pixel is not used: it falls on the robot's rim [-]."""
KNOWN_POSITION, KNOWN_ANGLE = 0.03, np.radians(3.0)
"""Half widths of intervals above which a pose is not determined [m, rad]."""


@dataclass(frozen=True)
class Shot:
    """One frame."""

    demonstration: str
    row: int
    time: float
    """Time by the camera's clock [s]."""
    brightness: np.ndarray
    """Shape (H, W)."""
    depth: np.ndarray
    """Shape (H, W) [m]."""
    moving: np.ndarray
    """Points of what moves, camera frame [m], shape (n, 3)."""
    robot: RobotSurface


def calibrate_by_robot(footage: Footage, cfg: CalibrateCfg, progress: Callable[[float], None]) -> CameraCalibration:
    """Return the calibration of a fixed camera that sees the robot.

    Args:
        footage: The camera and the robot's motion.
        cfg: Settings.
        progress: Called with the share done, 0..1.

    Raises:
        RecordingError: The camera is on a body, has no depth or does not see the robot, or the robot does not come to
            agree with what it sees.
    """
    if footage.first.body is not None:
        raise RecordingError(
            f"a camera on {footage.body} cannot be calibrated by the robot in view, which moves with it",
            where=footage.where,
            expected="a camera fixed in the world, or a tag",
            fix="show it a tag that is fixed in the world",
        )
    shots = _shots(footage, cfg)
    state = State(_first_pose(footage, cfg))
    rounds = cfg.robot.coarse_rounds + cfg.robot.fine_rounds
    clock = [CLOCK] if cfg.fit_clock else []
    gates = np.geomspace(cfg.robot.capture_distance, 2 * cfg.robot.final_distance, cfg.robot.coarse_rounds)
    for k, gate in enumerate(gates):
        equations = [_coarse(shot, footage, cfg, state, float(gate)) for shot in shots]
        free = [*range(POSE), *(clock if k > len(gates) // 2 else [])]
        state = state.moved(solve(equations, free, state, {CLOCK: cfg.limits.max_offset}))
        progress((k + 1) / rounds)
    free = [*range(POSE), *clock, EDGE]
    equations: list[Equations] = []
    for k in range(cfg.robot.fine_rounds):
        gate = max(4 * cfg.robot.final_distance * 0.7**k, cfg.robot.final_distance)
        equations = _fine(shots, footage, cfg, state, gate)
        state = state.moved(solve(equations, free, state, KNOWN))
        progress((len(gates) + k + 1) / rounds)
    check, scaled, scaled_half = _depth_check(shots, footage, cfg, state, [*free, SCALE])
    half = half_widths(equations, free, state, KNOWN)
    remarks = remarks_on([check], fitted=False)
    if check.off:
        state, half = scaled, scaled_half
        remarks.append("the pose is that of a fit in which the scale of depth is free")
    agreement, frames = _agreement(shots, footage, cfg, state)
    if not agreement >= cfg.robot.min_agreement:
        raise RecordingError(
            "the robot does not come to agree with what the camera sees",
            where=footage.where,
            expected=f"{cfg.robot.min_agreement:.0%} of its pixels within {1e3 * cfg.robot.final_distance:g} mm",
            found=f"{agreement:.0%}",
            fix="give a nearer --start, check the scene's robot and joint readings, or use a tag",
        )
    _check_determined(footage, half)
    errors = np.concatenate([f.errors.ravel() for f in frames])
    return CameraCalibration(
        name=footage.name,
        method="robot",
        pose=state.pose,
        body=None,
        recorded_pose=np.asarray(footage.first.pose, float),
        position_interval=half[3:6],
        rotation_interval=half[:3],
        intrinsics=np.asarray(footage.first.intrinsics, float),
        distortion=(),
        size=footage.size,
        clock_offset=state.offset,
        clock_interval=float(half[CLOCK]) if CLOCK in free else None,
        residual=float(np.sqrt(np.mean(errors**2))),
        frames=frames,
        checks=(check,),
        remarks=tuple(remarks),
    )


def _shots(footage: Footage, cfg: CalibrateCfg) -> list[Shot]:
    """Return the frames that are used.

    Raises:
        RecordingError: There is no depth, or too few frames lie where the joints have readings.
    """
    if not any(stream.depth.any() for stream in footage.streams.values()):
        raise RecordingError(
            "without a tag, depth is needed to align the robot", where=footage.where, found="images without depth",
            fix="show the camera a tag, or record depth",
        )  # fmt: skip
    shots = []
    share = max(cfg.robot.frames // len(footage.streams), 3)
    for name, stream in footage.streams.items():
        motion = footage.motions[name]
        robot = RobotSurface(motion)
        rows = np.flatnonzero(motion.covered(list(motion.readings), stream.time, cfg.limits.max_gap))
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, share).astype(int))] if len(rows) else rows
        far = np.where(stream.depth[rows] > 0, stream.depth[rows], np.inf)
        background = far.max(axis=0) if len(rows) else far
        for k, row in enumerate(rows):
            nearer = np.isfinite(far[k]) & (far[k] < background - cfg.robot.moving_depth)
            shots.append(_shot(footage, name, int(row), nearer, robot))
    if len(shots) < cfg.limits.min_views:
        raise RecordingError(
            "too few frames lie where the joints have readings",
            where=footage.where,
            expected=f"{cfg.limits.min_views} and more",
            found=len(shots),
            fix="record more frames, or check the clocks",
        )
    return shots


def _shot(footage: Footage, name: str, row: int, moving: np.ndarray, robot: RobotSurface) -> Shot:
    """Return a frame with the points of what moves in it, mask of shape (H, W)."""
    import cv2

    stream = footage.streams[name]
    v, u = np.nonzero(moving)
    thin = slice(None, None, max(len(u) // MOST_POINTS, 1))
    camera = Pinhole(np.asarray(stream.intrinsics, float), np.eye(4))
    points = camera.lift(np.stack([u, v], axis=1)[thin].astype(float), stream.depth[row][v, u][thin].astype(float))
    brightness = cv2.cvtColor(np.ascontiguousarray(stream.rgb[row]), cv2.COLOR_RGB2GRAY).astype(float)
    return Shot(name, row, float(stream.time[row]), brightness, stream.depth[row].astype(float), points, robot)


def _first_pose(footage: Footage, cfg: CalibrateCfg) -> np.ndarray:
    """Return the pose that the alignment starts from, shape (4, 4)."""
    if not cfg.start:
        return np.asarray(footage.first.pose, float).copy()
    if len(cfg.start) != 7 or np.linalg.norm(cfg.start[3:]) < 1e-6:
        raise RecordingError(
            "the start of the camera's pose is not right",
            expected="seven numbers: x, y, z in metres and the quaternion w, x, y, z",
            found=cfg.start,
            fix="give --start",
        )
    pose = np.eye(4)
    pose[:3, 3] = cfg.start[:3]
    pose[:3, :3] = Rotation.from_quat([*cfg.start[4:], cfg.start[3]]).as_matrix()
    return pose


def _coarse(shot: Shot, footage: Footage, cfg: CalibrateCfg, state: State, gate: float) -> Equations:
    """Return the equations that bring what moves in a frame onto the visible surface within a distance [m]."""
    surface = _rendered(shot, footage, cfg, state)[0]
    if len(surface.points) < FEWEST_PIXELS or len(shot.moving) < FEWEST_PIXELS:
        return Equations(np.zeros((COUNT, COUNT)), np.zeros(COUNT))
    world = shot.moving @ state.pose[:3, :3].T + state.pose[:3, 3]
    distance, near = KDTree(surface.points).query(world, distance_upper_bound=gate)
    good = np.isfinite(distance)
    residual, jacobian = depth_terms(shot.moving[good], surface.only(np.asarray(near)[good]), state.pose)
    return normal_equations(residual, jacobian, max(gate / 3, 0.003))


def _fine(shots: list[Shot], footage: Footage, cfg: CalibrateCfg, state: State, gate: float) -> list[Equations]:
    """Return the equations of depth and outline of each frame; a pixel counts within a distance [m]."""
    intrinsics = np.asarray(footage.first.intrinsics, float)
    camera, depths, edges = Pinhole(intrinsics, np.eye(4)), [], []
    for shot in shots:
        surface, outline = _rendered(shot, footage, cfg, state)
        depth = state.true_depth(_at(shot.depth, surface.pixels))
        expected = (surface.points - state.pose[:3, 3]) @ state.pose[:3, 2]
        good = (depth > 0) & (np.abs(depth - expected) < gate) & (surface.facing(state.pose) > MAX_SLANT)
        measured = camera.lift(surface.pixels[good], depth[good])
        depths.append(depth_terms(measured, surface.only(good), state.pose))
        edges.append(outline_terms(shot.brightness, outline, intrinsics, state, cfg.robot.min_contrast))
    stds = [
        max(spread(np.concatenate([residual for residual, _ in terms])), least)
        for terms, least in ((depths, DEPTH_STD), (edges, OUTLINE_STD))
    ]
    equations = []
    for (error, slope), (edge, edge_slope) in zip(depths, edges, strict=True):
        one, two = normal_equations(error, slope, stds[0]), normal_equations(edge, edge_slope, stds[1])
        equations.append(Equations(one.matrix + two.matrix, one.vector + two.vector))
    return equations


def _rendered(shot: Shot, footage: Footage, cfg: CalibrateCfg, state: State) -> tuple[Surface, Surface]:
    """Return the visible surface of the robot and its outline in a frame."""
    low, high = shot.robot.motion.span
    time = float(np.clip(shot.time + state.offset, low, high))
    intrinsics = np.asarray(footage.first.intrinsics, float)
    return shot.robot.seen(time, state.pose, intrinsics, footage.size, cfg.robot.pixels)


def _agreement(
    shots: list[Shot], footage: Footage, cfg: CalibrateCfg, state: State
) -> tuple[float, tuple[FrameError, ...]]:
    """Return the share of the robot's pixels whose depth agrees, and the errors of the frames."""
    seen, agree, frames = 0, 0, []
    for shot in shots:
        surface, outline = _rendered(shot, footage, cfg, state)
        depth = state.true_depth(_at(shot.depth, surface.pixels))
        error = (surface.points - state.pose[:3, 3]) @ state.pose[:3, 2] - depth
        good = (depth > 0) & (np.abs(error) < cfg.robot.final_distance)
        seen, agree = seen + int((depth > 0).sum()), agree + int(good.sum())
        weight = float(good.sum() / max((depth > 0).sum(), 1))
        frames.append(
            FrameError(
                shot.demonstration, shot.row, shot.time + state.offset, surface.pixels[good], error[good][:, None],
                weight, (outline.pixels,),
            )
        )  # fmt: skip
    if seen < FEWEST_PIXELS * len(shots) / 4:
        return 0.0, tuple(frames)
    return agree / seen, tuple(frames)


def _depth_check(
    shots: list[Shot], footage: Footage, cfg: CalibrateCfg, state: State, free: list[int]
) -> tuple[Check, State, np.ndarray]:
    """Return by how much depth reads too long [%], from a fit in which nothing is known of its scale.

    Its state and half widths of its intervals (10,) come with it.
    """
    known = {**KNOWN, SCALE: UNKNOWN_SCALE}
    equations: list[Equations] = []
    for _ in range(cfg.robot.fine_rounds // 2 + 1):
        equations = _fine(shots, footage, cfg, state, 2 * cfg.robot.final_distance)
        state = state.moved(solve(equations, free, state, known))
    half = half_widths(equations, free, state, known)
    value, width = 100 * (state.scale - 1), 100 * float(half[SCALE])
    return Check("depth", value, value - width, value + width, "%", NOTEWORTHY_DEPTH), state, half


def _check_determined(footage: Footage, half: np.ndarray) -> None:
    """Raise an error where the interval of the pose is too wide."""
    if half[3:6].max() < KNOWN_POSITION and half[:3].max() < KNOWN_ANGLE:
        return
    axis = "xyz"[int(np.argmax(half[3:6]))]
    raise RecordingError(
        f"the views do not determine the camera's pose, least its position along the world's {axis}",
        where=footage.where,
        expected=f"intervals of ± {1e3 * KNOWN_POSITION:g} mm and ± {np.degrees(KNOWN_ANGLE):g} deg at most",
        found=f"± {1e3 * half[3:6].max():.0f} mm and ± {np.degrees(half[:3].max()):.1f} deg",
        fix="move the arm to more and more different poses in view",
    )


def _at(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the values of an image (H, W) at pixels (n, 2) that are whole numbers."""
    return image[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
