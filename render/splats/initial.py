"""Initial splats of a fit: points of a mesh or a point cloud, or of the visual hull of the image masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.spatial import KDTree

from concent_warp.errors import RenderError
from concent_warp.render.splats.cfg import SplatFitCfg
from concent_warp.render.splats.splats import COEFFICIENTS, Splats
from concent_warp.render.splats.views import SplatViews
from concent_warp.scene.shapes.objects import MESH_SUFFIXES, read_mesh, read_points
from concent_warp.scene.shapes.ply import read_header
from concent_warp.scene.shapes.splat import CONSTANT_HARMONIC

CAMERA_AXES = np.diag([1.0, -1.0, -1.0])
"""Turns a camera that looks along -z with y up into one that looks along z with y down."""


def read_start(path: Path, count: int, scale: float, rng: np.random.Generator) -> np.ndarray:
    """Return points on the surface of a mesh or of a point cloud [m], at most `count`, shape (n, 3).

    Raises:
        SceneError: the file is missing, broken, or of another kind.
    """
    if path.suffix.lower() in MESH_SUFFIXES or (path.suffix.lower() == ".ply" and read_header(path).count("face")):
        import trimesh

        points = trimesh.sample.sample_surface(read_mesh(path), count, seed=int(rng.integers(2**31)))[0]
    else:
        points = read_points(path)
    return scale * _thinned(np.asarray(points), count, rng)


def _thinned(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return at most `count` randomly sampled points."""
    return points if len(points) <= count else points[rng.choice(len(points), count, replace=False)]


def _project(views: SplatViews, v: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (column, row), shape (n, 2), int, and the depths [m], shape (n,), of points in a view."""
    pose, matrix = views.poses[v], views.intrinsics[v]
    seen = (points - pose[:3, 3]) @ pose[:3, :3] @ CAMERA_AXES
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.nan_to_num(seen[:, :2] / seen[:, 2:] * matrix[[0, 1], [0, 1]] + matrix[:2, 2], posinf=-9, neginf=-9)
    return np.round(np.clip(pixels, -9, 1e6)).astype(int), seen[:, 2]


def _within(views: SplatViews, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return which pixels (n, 2) are in the image and before the camera, shape (n,)."""
    return (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < views.size).all(axis=1)


def visual_hull(views: SplatViews, count: int, rng: np.random.Generator, cfg: SplatFitCfg | None = None) -> np.ndarray:
    """Return points on the surface of the visual hull of all masks [m], at most `count`, shape (n, 3).

    Raises:
        RenderError: there are no masks, or they have no volume in common.
    """
    cfg = cfg or SplatFitCfg()
    cells = cfg.hull_cells
    if not views.masked:
        raise RenderError(
            "the images do not show which pixels are the object",
            expected="images with an alpha channel, or points to start from",
            fix="pass --points with a mesh or a point cloud",
        )  # fmt: skip
    middle, half = _enclosing_cube(views, cfg.hull_alpha)
    axis = (np.arange(cells) + 0.5) / cells * 2 - 1
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) * half + middle
    inside = np.ones(len(grid), dtype=bool)
    for v in range(len(views)):
        pixels, depth = _project(views, v, grid)
        seen = _within(views, pixels, depth)
        mask = views.rgba[v, ..., 3] >= cfg.hull_alpha
        # What is beyond the image may belong to an object that the image's border cuts, and to no other.
        cut = mask[[0, -1]].any() or mask[:, [0, -1]].any()
        covered = np.full(len(grid), cut)
        covered[seen] = mask[pixels[seen, 1], pixels[seen, 0]]
        inside &= covered
    solid = np.pad(inside.reshape((cells,) * 3), 1)
    core = np.ones((cells,) * 3, dtype=bool)
    for k in range(3):
        for step in (-1, 1):
            core &= np.roll(solid, step, axis=k)[1:-1, 1:-1, 1:-1]
    surface = grid[inside & ~core.ravel()]
    if len(surface) < 10:
        raise RenderError(
            "the masks of the images have no volume in common", expected="poses and masks of one object",
            fix="check the convention of transform_matrix: cameras look along -z, with y up",
        )  # fmt: skip
    cell = 2 * half / cells
    points = surface[rng.choice(len(surface), max(count, len(surface)))]
    return _thinned(points + rng.uniform(-cell / 2, cell / 2, points.shape), count, rng)


def _enclosing_cube(views: SplatViews, alpha: int) -> tuple[np.ndarray, float]:
    """Return the middle [m], shape (3,), and half the edge [m] of a cube around the object, by its masks."""
    origins, rays, spans = [], [], []
    for v in range(len(views)):
        rows, columns = np.nonzero(views.rgba[v, ..., 3] >= alpha)
        if not len(rows):
            continue
        matrix, pose = views.intrinsics[v], views.poses[v]
        box = np.array([[columns.min(), rows.min()], [columns.max(), rows.max()]])
        across = (box.mean(axis=0) - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
        ray = pose[:3, :3] @ CAMERA_AXES @ np.append(across, 1)
        origins.append(pose[:3, 3])
        rays.append(ray / np.linalg.norm(ray))
        spans.append(np.linalg.norm((np.diff(box, axis=0)[0] + 1) / matrix[[0, 1], [0, 1]]) / 2)
    if len(rays) < 2:
        raise RenderError("fewer than two images show the object", expected="masks that are not empty")
    away = np.eye(3) - np.einsum("vi,vj->vij", rays, rays)
    total = away.sum(axis=0)
    if np.linalg.cond(total) > 1e6:
        raise RenderError("all cameras look the same way", expected="views from several sides")
    middle = np.linalg.solve(total, np.einsum("vij,vj->i", away, np.array(origins)))
    distance = np.linalg.norm(np.array(origins) - middle, axis=1)
    return middle, float((distance * np.array(spans)).max() * 1.1)


def first_splats(views: SplatViews, points: np.ndarray, cfg: SplatFitCfg, device: torch.device) -> Splats:
    """Return splats at points (n, 3) [m], as wide as the gaps between them, coloured as the images show them."""
    if len(points) < 10:
        raise RenderError("too few points to start from", expected="at least 10", found=len(points))
    gaps, _ = KDTree(points).query(points, k=4)
    scale = np.clip(gaps[:, 1:].mean(axis=1), 1e-6, None)
    total, weight = np.zeros((len(points), 3)), np.full((len(points), 1), 1e-6)
    for v in range(len(views)):
        pixels, depth = _project(views, v, points)
        seen = _within(views, pixels, depth)
        rgba = views.rgba[v, pixels[seen, 1], pixels[seen, 0]].astype(float) / 255
        total[seen] += rgba[:, :3] * rgba[:, 3:]
        weight[seen] += rgba[:, 3:]
    harmonics = np.zeros((len(points), COEFFICIENTS[cfg.degree], 3))
    harmonics[:, 0] = (total / weight - 0.5) / CONSTANT_HARMONIC

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=device)

    return Splats(
        tensor(points), tensor(np.tile([1.0, 0, 0, 0], (len(points), 1))), tensor(np.tile(scale[:, None], 3)),
        torch.full((len(points),), cfg.initial_opacity, device=device), tensor(harmonics),
    )  # fmt: skip
