"""Calibration of a fixed camera by the robot itself: its shape at its measured joint angles against depth and outline.

From a rough start, points that move are first brought onto the rendered surface (point-to-plane: Chen and Medioni,
"Object modelling by registration of multiple range images", Image and Vision Computing 10(3), 1992), then all pixels in
which the robot is rendered, and edges of brightness along its outline, are aligned in all frames together. Weights are
Tukey's. The intervals are those of a jackknife over frames (Efron and Stein, Annals of Statistics 9(3), 1981), since errors
within a frame, as of its joint angles, are not independent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from concent_warp.errors import RecordingError
from concent_warp.perception.calibration.cfg import CalibrateCfg
from concent_warp.perception.calibration.checks import NOTEWORTHY_DEPTH, remarks_on
from concent_warp.perception.calibration.footage import Footage
from concent_warp.perception.calibration.result import CameraCalibration, Check, FrameError
from concent_warp.perception.calibration.robot_surface import RobotSurface, Surface
from concent_warp.perception.pinhole import Pinhole

POSE, CLOCK, SCALE = 6, 6, 7
"""Number of a pose's parameters, and the places of clock offset and scale of depth."""
TUKEY = 4.685
"""Width of Tukey's weight over the standard deviation: 95 % as efficient as least squares with normal errors."""
PROFILE = np.arange(-4.0, 4.01, 0.5)
"""Places across the outline at which brightness is read [px]."""
MOST_POINTS = 1500
"""Moving points of a frame that are used."""
FEWEST_PIXELS = 60
"""Pixels of the robot in a frame from which on it is used."""
OUTLINE_STD = 0.3
"""Standard deviation of the place of an outline that is taken at least [px]."""
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


@dataclass(frozen=True)
class Equations:
    """Normal equations of one frame."""

    matrix: np.ndarray
    """Shape (8, 8)."""
    vector: np.ndarray
    """Shape (8,)."""


def calibrate_by_robot(
    footage: Footage, cfg: CalibrateCfg, progress: Callable[[float], None]
) -> CameraCalibration:
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
    pose, offset, scale = _first_pose(footage, cfg), 0.0, 1.0
    rounds = cfg.robot.coarse_rounds + cfg.robot.fine_rounds
    gates = np.geomspace(cfg.robot.capture_distance, 2 * cfg.robot.final_distance, cfg.robot.coarse_rounds)
    for k, gate in enumerate(gates):
        equations = [_coarse(shot, footage, cfg, pose, offset, float(gate)) for shot in shots]
        free = [*range(POSE), CLOCK] if cfg.fit_clock and k > len(gates) // 2 else list(range(POSE))
        pose, offset, scale = _moved(pose, offset, scale, _solve(equations, free))
        offset = float(np.clip(offset, -cfg.limits.max_offset, cfg.limits.max_offset))
        progress((k + 1) / rounds)
    free = [*range(POSE), CLOCK] if cfg.fit_clock else list(range(POSE))
    equations: list[Equations] = []
    for k in range(cfg.robot.fine_rounds):
        gate = max(4 * cfg.robot.final_distance * 0.7**k, cfg.robot.final_distance)
        equations = _fine(shots, footage, cfg, pose, offset, scale, gate)
        pose, offset, scale = _moved(pose, offset, scale, _solve(equations, free))
        progress((len(gates) + k + 1) / rounds)
    agreement, frames = _agreement(shots, footage, cfg, pose, offset)
    if not agreement >= cfg.robot.min_agreement:
        raise RecordingError(
            "the robot does not come to agree with what the camera sees",
            where=footage.where,
            expected=f"{cfg.robot.min_agreement:.0%} of its pixels within {1e3 * cfg.robot.final_distance:g} mm",
            found=f"{agreement:.0%}",
            fix="give a nearer --start, check the scene's robot and joint readings, or use a tag",
        )
    half = _half_widths(equations, free)
    _check_determined(footage, half)
    check = _depth_check(shots, footage, cfg, pose, offset)
    errors = np.concatenate([f.errors.ravel() for f in frames])
    return CameraCalibration(
        name=footage.name,
        method="robot",
        pose=pose,
        body=None,
        recorded_pose=np.asarray(footage.first.pose, float),
        position_interval=half[3:6],
        rotation_interval=half[:3],
        intrinsics=np.asarray(footage.first.intrinsics, float),
        distortion=(),
        size=footage.size,
        clock_offset=offset,
        clock_interval=float(half[CLOCK]) if CLOCK in free else None,
        residual=float(np.sqrt(np.mean(errors**2))),
        frames=frames,
        checks=(check,),
        remarks=tuple(remarks_on([check], fitted=False)),
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


def _coarse(
    shot: Shot, footage: Footage, cfg: CalibrateCfg, pose: np.ndarray, offset: float, gate: float
) -> Equations:
    """Return the equations that bring what moves in a frame onto the visible surface within a distance [m]."""
    surface = _rendered(shot, footage, cfg, pose, offset)[0]
    if len(surface.points) < FEWEST_PIXELS or len(shot.moving) < FEWEST_PIXELS:
        return Equations(np.zeros((8, 8)), np.zeros(8))
    world = shot.moving @ pose[:3, :3].T + pose[:3, 3]
    distance, near = KDTree(surface.points).query(world, distance_upper_bound=gate)
    good = np.isfinite(distance)
    near = near[good]
    chosen = Surface(
        surface.pixels[near], surface.points[near], surface.normals[near], surface.velocities[near]
    )
    residual, jacobian = _depth_terms(shot.moving[good], chosen, pose)
    return _normal(residual, jacobian, max(gate / 3, 0.003))


def _fine(
    shots: list[Shot], footage: Footage, cfg: CalibrateCfg, pose: np.ndarray, offset: float, scale: float, gate: float
) -> list[Equations]:
    """Return the equations of depth and outline of each frame; a pixel counts within a distance [m]."""
    terms = []
    for shot in shots:
        surface, outline = _rendered(shot, footage, cfg, pose, offset)
        depth = _at(shot.depth, surface.pixels)
        expected = (surface.points - pose[:3, 3]) @ pose[:3, 2]
        good = (depth > 0) & (np.abs(depth / scale - expected) < gate)
        chosen = Surface(surface.pixels[good], surface.points[good], surface.normals[good], surface.velocities[good])
        camera = Pinhole(np.asarray(footage.first.intrinsics, float), np.eye(4))
        measured = camera.lift(chosen.pixels, depth[good] / scale)
        terms.append((_depth_terms(measured, chosen, pose), _outline_terms(shot, footage, cfg, outline, pose)))
    spread = [_spread(np.concatenate([pair[k][0] for pair in terms])) for k in (0, 1)]
    stds = max(spread[0], 5e-4), max(spread[1], OUTLINE_STD)
    equations = []
    for (depth_residual, depth_jacobian), (edge_residual, edge_jacobian) in terms:
        one = _normal(depth_residual, depth_jacobian, stds[0])
        two = _normal(edge_residual, edge_jacobian, stds[1])
        equations.append(Equations(one.matrix + two.matrix, one.vector + two.vector))
    return equations


def _rendered(
    shot: Shot, footage: Footage, cfg: CalibrateCfg, pose: np.ndarray, offset: float
) -> tuple[Surface, Surface]:
    """Return the visible surface of the robot and its outline in a frame."""
    low, high = shot.robot.motion.span
    time = float(np.clip(shot.time + offset, low, high))
    intrinsics = np.asarray(footage.first.intrinsics, float)
    return shot.robot.seen(time, pose, intrinsics, footage.size, cfg.robot.pixels)


def _depth_terms(measured: np.ndarray, surface: Surface, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances of measured points from the surface's planes [m], shape (n,), and their derivatives (n, 8).

    Args:
        measured: Points, camera frame [m], shape (n, 3).
        surface: The points that they belong to.
        pose: Camera-to-world, shape (4, 4).
    """
    world = measured @ pose[:3, :3].T + pose[:3, 3]
    residual = np.einsum("ni,ni->n", surface.normals, world - surface.points)
    in_camera = surface.normals @ pose[:3, :3]
    turn = np.cross(measured, in_camera)
    slide = -np.einsum("ni,ni->n", surface.normals, surface.velocities)
    stretch = -np.einsum("ni,ni->n", in_camera, measured)
    return residual, np.column_stack([turn, surface.normals, slide, stretch])


def _outline_terms(
    shot: Shot, footage: Footage, cfg: CalibrateCfg, outline: Surface, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances of edges of brightness from the robot's outline [px], shape (n,), and their derivatives (n, 8)."""
    intrinsics = np.asarray(footage.first.intrinsics, float)
    local = (outline.points - pose[:3, 3]) @ pose[:3, :3]
    # At the outline, normals are perpendicular to the view, so that they point across it in the image.
    across = (outline.normals @ pose[:3, :3])[:, :2]
    length = np.linalg.norm(across, axis=1)
    across = across / np.maximum(length, 1e-9)[:, None]
    place = outline.pixels[:, None] + PROFILE[None, :, None] * across[:, None]
    height, width = shot.brightness.shape
    inside = ((place >= 0) & (place <= [width - 1, height - 1])).all(axis=(1, 2))
    profile = map_coordinates(shot.brightness, [place[..., 1].ravel(), place[..., 0].ravel()], order=1, mode="nearest")
    slope = np.abs(np.diff(profile.reshape(place.shape[:2]), axis=1))
    best = np.argmax(slope, axis=1)
    within = (best > 0) & (best < slope.shape[1] - 1)
    rise = np.take_along_axis(slope, np.clip(best[:, None] + np.array([-1, 0, 1]), 0, slope.shape[1] - 1), axis=1)
    good = inside & within & (rise.sum(axis=1) > cfg.robot.min_contrast) & (length > 0.5)
    shift = (rise[:, 2] - rise[:, 0]) / np.maximum(rise.sum(axis=1), 1e-9) * 0.5
    found = PROFILE[best] + 0.25 + shift
    x, y, z = local.T
    focal = intrinsics[[0, 1], [0, 1]]
    gradient = np.column_stack(
        [across[:, 0] * focal[0] / z, across[:, 1] * focal[1] / z, -(across * focal * local[:, :2]).sum(axis=1) / z**2]
    )
    turn = np.cross(gradient, local)
    slide = np.einsum("ni,ni->n", gradient, outline.velocities @ pose[:3, :3])
    moved = np.column_stack([turn, -gradient @ pose[:3, :3].T, slide, np.zeros(len(x))])
    return found[good], -moved[good]


def _normal(residual: np.ndarray, jacobian: np.ndarray, std: float) -> Equations:
    """Return the normal equations of residuals with Tukey's weights for their standard deviation."""
    share = np.clip(np.abs(residual) / (TUKEY * std), 0, 1)
    weight = (1 - share**2) ** 2 / std**2
    return Equations((jacobian.T * weight) @ jacobian, (jacobian.T * weight) @ residual)


def _spread(residual: np.ndarray) -> float:
    """Return a robust standard deviation about 0."""
    return 1.4826 * float(np.median(np.abs(residual))) if len(residual) else 0.0


def _solve(equations: list[Equations], free: list[int], without: int | None = None) -> np.ndarray:
    """Return the step of the parameters (8,) that the equations of all frames give, one of them left out if wanted."""
    used = [e for k, e in enumerate(equations) if k != without]
    matrix = sum((e.matrix for e in used), np.zeros((8, 8)))[np.ix_(free, free)]
    vector = sum((e.vector for e in used), np.zeros(8))[free]
    step = np.zeros(8)
    # A little of a prior keeps directions still that no frame determines; they are found by their interval.
    damping = 1e-9 * np.trace(matrix) * np.eye(len(free)) + 1e-12 * np.eye(len(free))
    step[free] = np.linalg.solve(matrix + damping, -vector)
    step[:3] *= min(1.0, 0.1 / max(float(np.linalg.norm(step[:3])), 1e-12))
    step[3:6] *= min(1.0, 0.1 / max(float(np.linalg.norm(step[3:6])), 1e-12))
    step[CLOCK] = np.clip(step[CLOCK], -0.05, 0.05)
    return step


def _moved(pose: np.ndarray, offset: float, scale: float, step: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return pose, clock offset and scale of depth after a step (8,)."""
    moved = pose.copy()
    moved[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(step[:3]).as_matrix()
    moved[:3, 3] += step[3:6]
    return moved, offset + float(step[CLOCK]), scale * (1 + float(step[SCALE]))


def _half_widths(equations: list[Equations], free: list[int]) -> np.ndarray:
    """Return half widths of the 95 % intervals (8,) by a jackknife over frames."""
    count = len(equations)
    steps = np.array([_solve(equations, free, without=k) for k in range(count)])
    variance = (count - 1) / count * ((steps - steps.mean(axis=0)) ** 2).sum(axis=0)
    return float(student.ppf(0.975, count - 1)) * np.sqrt(variance)


def _agreement(
    shots: list[Shot], footage: Footage, cfg: CalibrateCfg, pose: np.ndarray, offset: float
) -> tuple[float, tuple[FrameError, ...]]:
    """Return the share of the robot's pixels whose depth agrees, and the errors of the frames."""
    seen, agree, frames = 0, 0, []
    for shot in shots:
        surface, outline = _rendered(shot, footage, cfg, pose, offset)
        depth = _at(shot.depth, surface.pixels)
        error = (surface.points - pose[:3, 3]) @ pose[:3, 2] - depth
        good = (depth > 0) & (np.abs(error) < cfg.robot.final_distance)
        seen, agree = seen + int((depth > 0).sum()), agree + int(good.sum())
        weight = float(good.sum() / max((depth > 0).sum(), 1))
        frames.append(
            FrameError(
                shot.demonstration, shot.row, shot.time + offset, surface.pixels[good], error[good][:, None], weight,
                (outline.pixels,),
            )
        )  # fmt: skip
    if seen < FEWEST_PIXELS * len(shots) / 4:
        return 0.0, tuple(frames)
    return agree / seen, tuple(frames)


def _depth_check(
    shots: list[Shot], footage: Footage, cfg: CalibrateCfg, pose: np.ndarray, offset: float
) -> Check:
    """Return by how much depth reads too long [%], from a fit in which its scale is free."""
    free, scale = [*range(POSE), CLOCK, SCALE] if cfg.fit_clock else [*range(POSE), SCALE], 1.0
    equations: list[Equations] = []
    for _ in range(cfg.robot.fine_rounds // 2 + 1):
        equations = _fine(shots, footage, cfg, pose, offset, scale, 2 * cfg.robot.final_distance)
        pose, offset, scale = _moved(pose, offset, scale, _solve(equations, free))
    half = 100 * float(_half_widths(equations, free)[SCALE])
    value = 100 * (scale - 1)
    return Check("depth", value, value - half, value + half, "%", NOTEWORTHY_DEPTH)


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
