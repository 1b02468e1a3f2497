"""The pose of an object that nothing is known about, from one moment's frame.

Depth in front of the rendered robot and static scene is divided into clusters. From many orientations at each cluster,
iterative closest points with the shape's signed distance moves the shape to the points; the best distinct results are
refined against the image and scored by what of the object and of the cluster they explain. The best must be clearly
better than the next that no symmetry of the shape explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from concent_warp.perception.pinhole import pixel_grid
from concent_warp.perception.tracking.alignment.align import Agreement, Fit, agreement, refine
from concent_warp.perception.tracking.alignment.registration import closest_points
from concent_warp.perception.tracking.cfg import SearchCfg, TrackCfg
from concent_warp.perception.tracking.geometry.pose import rotation_angle
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import Symmetry
from concent_warp.perception.tracking.geometry.view import View


@dataclass(frozen=True)
class Found:
    """Outcome of a search."""

    fit: Fit | None
    """The pose, or None where none is clear."""
    score: float
    """Its score [-], 0 to 1."""
    reason: str
    """Why there is none, in words; empty where there is one."""


@dataclass(frozen=True)
class Cluster:
    """Measured points of one unknown thing."""

    points: np.ndarray
    """Points [m], world frame, shape (n, 3)."""
    pixels: np.ndarray
    """Their pixels (column, row), shape (n, 2)."""
    stride: int
    """Distance between neighbouring pixels [px]."""


def find_pose(
    renderer: RayRenderer, view: View, shape: TrackedShape, symmetry: Symmetry, cfg: TrackCfg, rng: np.random.Generator
) -> Found:
    """Return the pose of a body in a frame, without prior.

    Args:
        renderer: Scene with robot and known objects where they are.
        view: The frame.
        shape: The body.
        symmetry: Its symmetries.
        cfg: Settings.
        rng: Source of orientations and of samples.
    """
    renderer.place(shape.row, None)
    clusters: list[Cluster] = []
    stride = max(1, round(cfg.search.stride * view.shape[1] / 640))
    while stride >= 1 and not clusters:  # an object that is far away covers few pixels
        clusters = [c for c in foreground_clusters(renderer, view, cfg.search, stride) if _fits(c, shape)]
        stride //= 2
    if not clusters:
        return Found(None, 0.0, "nothing unknown of its size is seen in front of robot and static scene")
    starts: list[tuple[float, np.ndarray, Cluster]] = []
    turns = Rotation.random(cfg.search.orientations, rng=rng).as_matrix()
    for cluster in clusters:
        chosen = rng.choice(len(cluster.points), min(len(cluster.points), cfg.search.points), replace=False)
        cost, poses = closest_points(cluster.points[chosen], view.camera.position, shape, turns, cfg.search.rounds)
        for k in _distinct(cost, poses, symmetry, cfg.search):
            starts.append((float(cost[k]), poses[k], cluster))
    starts.sort(key=lambda s: s[0])
    results: list[tuple[float, Fit, Agreement]] = []
    for _, pose, cluster in starts[: cfg.search.kept]:
        fit = refine(renderer, [view], shape, pose, cfg.align, rough=True, iterations=10)
        if fit is None or fit.position_std() > cfg.accept.max_translation_std:
            continue
        agreed = agreement(renderer, [view], shape, fit.pose, fit.depth_std, cfg.accept)
        results.append((_score(agreed, fit, shape, cluster, cfg), fit, agreed))
    renderer.place(shape.row, None)
    if not results:
        return Found(None, 0.0, "no start led to a pose that the image determines")
    results.sort(key=lambda r: -r[0])
    if not any(a.accepted(cfg.accept) for _, _, a in results):
        score, _, agreed = results[0]
        return Found(None, score, f"the best pose does not agree with the image: {agreed.text()}")
    results = [r for r in results if r[2].accepted(cfg.accept)]
    score, best, _ = results[0]
    settled = refine(renderer, [view], shape, best.pose, cfg.align, iterations=cfg.align.first_iterations)
    renderer.place(shape.row, None)
    best = settled or best
    for other_score, other, _ in results[1:]:
        if _same(best.pose, other.pose, symmetry, cfg.search):
            continue
        if score - other_score < cfg.search.min_margin:
            near = np.linalg.norm(_middle(other.pose, shape) - _middle(best.pose, shape))
            turn = np.degrees(rotation_angle(other.pose, symmetry.nearest(best.pose, other.pose)))
            reason = (
                f"two poses, {1e3 * near:.0f} mm and {turn:.0f} degrees apart, explain the image about as well "
                f"(scores {score:.2f} and {other_score:.2f})"
            )
            return Found(None, score, reason)
    return Found(best, score, "")


def foreground_clusters(renderer: RayRenderer, view: View, cfg: SearchCfg, stride: int) -> list[Cluster]:
    """Return what is measured in front of all that the renderer knows, largest first, in every `stride`-th pixel."""
    import cv2

    height, width = view.shape
    grid = pixel_grid(height, width)[stride // 2 :: stride, stride // 2 :: stride]
    size = grid.shape[:2]
    pixels = grid.reshape(-1, 2)
    hits = renderer.cast(view.camera, pixels)
    expected = hits.depth.reshape(size)
    columns, rows = grid[..., 0].astype(int), grid[..., 1].astype(int)
    measured = view.depth[rows, columns].astype(float)
    rim = _rim(expected, cfg.depth_jump)
    noise = cfg.foreground_noise * view.depth_noise(measured)
    front = (measured > 0) & (measured < expected - np.maximum(cfg.foreground, noise)) & ~rim
    front = cv2.morphologyEx(front.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
    # Where depth jumps from pixel to pixel, one thing ends and another begins.
    shown = np.where(measured > 0, measured, np.nan)
    jump = np.zeros(size, dtype=bool)
    with np.errstate(invalid="ignore"):
        # The noise of a difference is that of a depth times the root of 2.
        step = np.maximum(cfg.depth_jump, np.sqrt(2) * noise)
        jump[:, 1:] |= np.abs(np.diff(shown, axis=1)) > step[:, 1:]
        jump[1:] |= np.abs(np.diff(shown, axis=0)) > step[1:]
    count, label = cv2.connectedComponents((front & ~jump).astype(np.uint8), connectivity=4)
    found = []
    for k in range(1, count):
        inside = label == k
        if inside.sum() >= cfg.min_cluster:
            at = grid[inside]
            found.append(Cluster(view.camera.lift(at, measured[inside]), at, stride))
    return sorted(found, key=lambda c: -len(c.points))[:6]


def _rim(depth: np.ndarray, jump: float) -> np.ndarray:
    """Return the rims of what is known, which are not where they should be by a pixel or so, shape (h, w).

    They are where depth [m], infinite beside everything, deviates from a plane by more than `jump` [m] from pixel to
    pixel; inverse depth is linear on a plane, however slanted.
    """
    inverse = 1 / depth
    nearest = maximum_filter(inverse, 3)
    rim = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        edge = np.pad(inverse, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="reflect", reflect_type="odd")
        second = np.abs(np.diff(edge, 2, axis=axis))
        rim |= second > jump * nearest**2
    return rim


def _fits(cluster: Cluster, shape: TrackedShape) -> bool:
    """Return whether a cluster may be the shape, or hold it together with what it touches."""
    spread = np.linalg.norm(cluster.points - np.median(cluster.points, axis=0), axis=1)
    return bool(np.quantile(spread, 0.9) > 0.25 * shape.radius)


def _distinct(cost: np.ndarray, poses: np.ndarray, symmetry: Symmetry, cfg: SearchCfg) -> list[int]:
    """Return the best starts of which no two are the same, at most `kept`."""
    found: list[int] = []
    for k in np.argsort(cost):
        if all(not _same(poses[k], poses[other], symmetry, cfg) for other in found):
            found.append(int(k))
        if len(found) == cfg.kept:
            break
    return found


def _same(first: np.ndarray, second: np.ndarray, symmetry: Symmetry, cfg: SearchCfg) -> bool:
    """Return whether two poses are the same up to symmetry."""
    alike = symmetry.nearest(second, first)
    near = np.linalg.norm((first[:3, :3] - alike[:3, :3]) @ symmetry.centre + first[:3, 3] - alike[:3, 3])
    return bool(near < cfg.same_translation) and rotation_angle(first, alike) < np.radians(cfg.same_rotation)


def _middle(pose: np.ndarray, shape: TrackedShape) -> np.ndarray:
    """Return where the middle of a body is at a pose [m], shape (3,)."""
    return pose[:3, :3] @ shape.centre + pose[:3, 3]


def _score(agreed: Agreement, fit: Fit, shape: TrackedShape, cluster: Cluster, cfg: TrackCfg) -> float:
    """Return how well a pose explains object, edges and cluster, 0 to 1."""
    points = cluster.points
    near = points[np.linalg.norm(points - _middle(fit.pose, shape), axis=1) < 1.5 * shape.reach]
    local = (near - fit.pose[:3, 3]) @ fit.pose[:3, :3]
    tolerance = max(cfg.accept.depth_tolerance, 4 * fit.depth_std if np.isfinite(fit.depth_std) else 0.0)
    explained = float((np.abs(shape.surface.signed_distance(local)) < tolerance).mean()) if len(near) else 0.0
    edge = fit.edge_share if np.isfinite(fit.edge_share) else 0.0
    fair = max(agreed.share - agreed.behind, 0.0) * (1 - agreed.unexplained)
    smooth = 1 / (1 + (agreed.misfit / cfg.accept.max_misfit) ** 2)
    return fair * (0.6 * explained + 0.4 * edge) * smooth * min(agreed.visible, 1.0)
