"""Pose of a body from tracked points: rigid registration of their measured positions, then of pixels and depths.

Three-point samples are aligned by Kabsch's method and compared by how many points agree (random sample consensus,
Fischler and Bolles, CACM 24(6), 1981). The winner is refined by Gauss-Newton steps on pixels and depths with Tukey's
weights: pixels are far more exact than depth is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.perception.rigid_motion import kabsch
from concent_warp.perception.tracking.alignment.rows import DEFAULT_INFLATION, MAD, Normal, point_jacobian, weighted
from concent_warp.perception.tracking.cfg import AlignCfg, RegistrationCfg
from concent_warp.perception.tracking.geometry.pose import moved
from concent_warp.perception.tracking.geometry.view import View

FREE = np.diag([1 / 0.1**2] * 3 + [1 / 1.0**2] * 3)
"""Information on a pose of which nothing is known [1/m^2, 1/rad^2]: 0.1 m and 1 rad."""
FLAT = 1e-3
"""Ratio of the second to the first singular value of points, below which they are on a line [-]."""


@dataclass(frozen=True)
class SeenPoints:
    """Points of a body that a frame shows."""

    points: np.ndarray
    """Positions on the body [m], body frame, shape (n, 3)."""
    pixels: np.ndarray
    """Where the frame shows them [px], shape (n, 2)."""


@dataclass(frozen=True)
class Registered:
    """A pose that points agree with."""

    pose: np.ndarray
    """Shape (4, 4)."""
    normals: list[Normal]
    """Normal equations of each frame's points at the pose; of their pixels alone where the shape's depth counts."""
    count: int
    """How many points agree."""


def registered(
    views: Sequence[View],
    seen: Sequence[SeenPoints],
    cfg: RegistrationCfg,
    align: AlignCfg,
    rng: np.random.Generator,
) -> Registered | None:
    """Return the pose that the points of one moment agree with, or None where too few do.

    Args:
        views: Frames.
        seen: Points that each shows.
        cfg: Settings.
        align: Settings of scatters and weights.
        rng: Source of samples.
    """
    depths = [measured_depth(view, part.pixels) for view, part in zip(views, seen, strict=True)]
    source = np.concatenate([part.points[d > 0] for part, d in zip(seen, depths, strict=True)])
    target = np.concatenate(
        [v.camera.lift(part.pixels[d > 0], d[d > 0]) for v, part, d in zip(views, seen, depths, strict=True)]
    )
    if len(source) < cfg.min_points:
        return None
    pose = _consensus(source, target, cfg, rng)
    if pose is None:
        return None
    agreeing = [
        _agreeing(view, part, depth, pose, cfg.tolerance) for view, part, depth in zip(views, seen, depths, strict=True)
    ]
    if sum(int(rows.sum()) for rows in agreeing) < cfg.min_points:
        return None
    parts = list(zip(views, seen, depths, agreeing, strict=True))
    for _ in range(cfg.iterations):
        total = sum((point_rows(v, s, depth, pose, rows, cfg, align) for v, s, depth, rows in parts), Normal())
        pose = moved(pose, np.linalg.solve(total.information + 1e-3 * FREE, total.gradient))
    if _pixel_scatter(parts, pose) > cfg.max_scatter:
        return None
    normals = [
        point_rows(v, s, 0 * depth if cfg.shape else depth, pose, rows, cfg, align) for v, s, depth, rows in parts
    ]
    return Registered(pose, normals, sum(int(rows.sum()) for rows in agreeing))


def measured_depth(view: View, pixels: np.ndarray) -> np.ndarray:
    """Return the depth [m] that a frame measures at pixels (n, 2) [px], shape (n,), between its pixels; 0 where one of
    the four around has none.
    """
    height, width = view.shape
    result = np.zeros(len(pixels))
    low = np.floor(pixels).astype(int)
    inside = ((low >= 0) & (low < [width - 1, height - 1])).all(axis=1)
    column, row = low[inside].T
    four = np.stack([view.depth[row + i, column + j] for i in (0, 1) for j in (0, 1)], axis=-1).astype(float)
    right, below = (pixels[inside] - low[inside]).T
    weight = np.stack([(1 - below) * (1 - right), (1 - below) * right, below * (1 - right), below * right], axis=-1)
    result[inside] = np.where((four > 0).all(axis=1), (four * weight).sum(axis=1), 0.0)
    return result


def _consensus(
    source: np.ndarray, target: np.ndarray, cfg: RegistrationCfg, rng: np.random.Generator
) -> np.ndarray | None:
    """Return the rigid transform, shape (4, 4), that most pairs of points (n, 3) agree with; None where too few do."""
    chosen = rng.random((cfg.hypotheses, len(source))).argsort(axis=1)[:, :3]
    poses = kabsch(source[chosen], target[chosen])
    for _ in range(2):
        off = np.einsum("kij,nj->kni", poses[:, :3, :3], source) + poses[:, None, :3, 3] - target
        distance = np.linalg.norm(off, axis=2)
        best = int(np.minimum(distance / cfg.tolerance, 1.0).sum(axis=1).argmin())
        near = distance[best] < cfg.tolerance
        if near.sum() < cfg.min_points:
            return None
        spread = np.linalg.svd(source[near] - source[near].mean(axis=0), compute_uv=False)
        if spread[1] < FLAT * spread[0]:
            return None
        poses = kabsch(source[near], target[near])[None]
    return poses[0]


def _agreeing(view: View, seen: SeenPoints, depth: np.ndarray, pose: np.ndarray, tolerance: float) -> np.ndarray:
    """Return which points agree with a pose, by their position where depth is measured, else by their pixel."""
    points = seen.points @ pose[:3, :3].T + pose[:3, 3]
    pixels, away, _ = view.pixel_rows(points)
    focal = view.camera.intrinsics[0, 0]
    beside = np.linalg.norm(pixels - seen.pixels, axis=1) * np.abs(away) / focal
    along = np.where(depth > 0, np.abs(depth - away), 0.0)
    return (away > 0) & (np.hypot(beside, along) < tolerance)


def _pixel_scatter(parts: Sequence[tuple[View, SeenPoints, np.ndarray, np.ndarray]], pose: np.ndarray) -> float:
    """Return the scatter of the pixels of points that agree with a pose [px]; `parts` are views with their points, the
    depths of these and which of them agree.
    """
    off = []
    for view, seen, _, rows in parts:
        pixels, _, _ = view.pixel_rows(seen.points[rows] @ pose[:3, :3].T + pose[:3, 3])
        off.append((seen.pixels[rows] - pixels).ravel())
    return MAD * float(np.median(np.abs(np.concatenate(off))))


def point_rows(
    view: View,
    seen: SeenPoints,
    depth: np.ndarray,
    pose: np.ndarray,
    rows: np.ndarray,
    cfg: RegistrationCfg,
    align: AlignCfg,
) -> Normal:
    """Return the normal equations of the pixels and depths of points at a pose.

    Args:
        view: The frame.
        seen: Its points.
        depth: Measured depth of each [m], shape (n,), 0 where there is none.
        pose: The body's, shape (4, 4).
        rows: Points that count, shape (n,) bool.
        cfg: Settings.
        align: Settings of scatters and weights.
    """
    if rows.sum() < 3:
        return Normal()
    points = seen.points[rows] @ pose[:3, :3].T + pose[:3, 3]
    pixels, away, projection = view.pixel_rows(points)
    jacobian = np.concatenate([point_jacobian(points, pose[:3, 3], projection[:, axis]) for axis in (0, 1)], axis=0)
    residual = (seen.pixels[rows] - pixels).T.ravel()
    total, _, _ = weighted(jacobian, residual, align.min_texture_std, align, cfg.inflation)
    known = depth[rows] > 0
    if known.sum() >= 3:
        sight = np.broadcast_to(view.camera.pose[:3, 2], (int(known.sum()), 3))
        along = point_jacobian(points[known], pose[:3, 3], sight)
        difference = depth[rows][known] - away[known]
        total = total + weighted(along, difference, align.min_depth_std, align, DEFAULT_INFLATION)[0]
    return total
