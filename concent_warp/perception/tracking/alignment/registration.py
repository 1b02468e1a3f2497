"""Alignment of a shape to measured points, by iterative closest points with the shape's signed distance.

The distance to the nearest surface point and its gradient are those of the exact shape, so no search for neighbours is
needed. It converges from half the object's size away, and needs no image.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.perception.pinhole import pixel_grid
from concent_warp.perception.tracking.cfg import SearchCfg
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.view import View

WIDTHS = (0.01, 0.003)
"""Distances at which a point has half its weight, in the first and in the last iterations [m]."""
MAX_COST = 0.01
"""Distance that counts for points farther away [m]."""
UNSEEN_WEIGHT = 0.1
"""Weight of a point that lies on a side of the shape which the camera does not see [-]."""
MAX_TURN = 0.5
"""Largest turn of one iteration [rad]."""


def closest_points(
    points: np.ndarray,
    eye: np.ndarray,
    shape: TrackedShape,
    starts: np.ndarray,
    rounds: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return costs [m], shape (k,), and poses, shape (k, 4, 4), that starts become.

    Points on a side that faces away from the camera cannot have been measured: they cost as much as distant ones.

    Args:
        points: Measured points of the shape, world frame [m], shape (n, 3).
        eye: Camera that measured them [m], shape (3,).
        shape: The shape.
        starts: Poses to start from, shape (k, 4, 4), see `placed`.
        rounds: Iterations.
    """
    poses = starts.copy()
    count, rays = len(points), points - eye
    distance, unseen = np.zeros((len(poses), count)), np.zeros((len(poses), count), dtype=bool)
    for k in range(rounds + 1):
        offset = points[None] - poses[:, None, :3, 3]
        local = np.einsum("kji,knj->kni", poses[:, :3, :3], offset)
        flat, gradient = shape.surface.distance(local.reshape(-1, 3))
        distance = flat.reshape(len(poses), count)
        normal = np.einsum("kij,knj->kni", poses[:, :3, :3], gradient.reshape(len(poses), count, 3))
        unseen = np.einsum("kni,ni->kn", normal, rays) > 0
        if k == rounds:
            break
        jacobian = np.concatenate([normal, np.cross(offset, normal)], axis=2)
        width = max(WIDTHS[0] * (1 - k / rounds), WIDTHS[1])
        weight = np.where(unseen, UNSEEN_WEIGHT, 1.0) / (1 + (distance / width) ** 2)
        matrix = np.einsum("kna,kn,knb->kab", jacobian, weight, jacobian) + np.diag(
            [1e-3] * 3 + [1e-3 * shape.radius**2] * 3
        )
        step = np.linalg.solve(matrix, np.einsum("kna,kn,kn->ka", jacobian, weight, distance)[..., None])[..., 0]
        large = np.maximum(np.linalg.norm(step[:, 3:], axis=1) / MAX_TURN, 1.0)
        step /= large[:, None]
        poses[:, :3, :3] = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += step[:, :3]
    return np.where(unseen, MAX_COST, np.minimum(np.abs(distance), MAX_COST)).mean(axis=1), poses


def placed(points: np.ndarray, eye: np.ndarray, shape: TrackedShape, turns: np.ndarray) -> np.ndarray:
    """Return poses (k, 4, 4) in orientations (k, 3, 3) at which the shape's visible side is at points (n, 3)."""
    sight = points.mean(axis=0) - eye
    sight /= np.linalg.norm(sight)
    poses = np.repeat(np.eye(4)[None], len(turns), axis=0)
    poses[:, :3, :3] = turns
    # The points lie on the side that faces the camera; the mean of that side is put on theirs.
    facing = np.einsum("kij,nj,i->kn", turns, shape.normals, sight) < 0
    middle = np.einsum("kn,nj->kj", facing, shape.points) / np.maximum(facing.sum(axis=1), 1)[:, None]
    poses[:, :3, 3] = points.mean(axis=0) - np.einsum("kij,kj->ki", turns, middle)
    return poses


def unknown_points(
    renderer: RayRenderer, view: View, shape: TrackedShape, centre: np.ndarray, radius: float, cfg: SearchCfg
) -> np.ndarray:
    """Return measured points, world frame [m], shape (n, 3), in front of all that is known, around a place.

    Args:
        renderer: Scene with robot and known objects where they are; the body is put out of sight.
        view: The frame.
        shape: The body.
        centre: Where it is looked for [m], world frame, shape (3,).
        radius: How far around [m].
        cfg: Settings.
    """
    renderer.place(shape.row, None)
    window = view.window(centre, radius)
    if window is None:
        return np.zeros((0, 3))
    area = (window[0].stop - window[0].start) * (window[1].stop - window[1].start)
    stride = max(1, round(np.sqrt(area / 3000)))
    pixels = pixel_grid(*view.shape)[window][::stride, ::stride].reshape(-1, 2)
    measured = view.depth[window][::stride, ::stride].ravel().astype(float)
    expected = renderer.cast(view.camera, pixels).depth
    front = (measured > 0) & (measured < expected - cfg.foreground) & view.may_show(pixels)
    points = view.camera.lift(pixels[front], measured[front])
    return points[np.linalg.norm(points - centre, axis=1) < radius]


def relocated(
    renderer: RayRenderer, view: View, shape: TrackedShape, pose: np.ndarray, reach: float, cfg: SearchCfg
) -> np.ndarray | None:
    """Return where the unknown points within `reach` [m] around a body's pose (4, 4) put it, orientation kept
    roughly.
    """
    centre = pose[:3, :3] @ shape.centre + pose[:3, 3]
    points = unknown_points(renderer, view, shape, centre, shape.reach + reach, cfg)
    if len(points) < cfg.min_cluster:
        return None
    some = points[np.linspace(0, len(points) - 1, min(len(points), cfg.points)).astype(int)]
    eye = view.camera.position
    return closest_points(some, eye, shape, placed(some, eye, shape, pose[None, :3, :3]), cfg.rounds)[1][0]
