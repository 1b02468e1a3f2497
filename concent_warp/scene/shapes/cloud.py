"""A cloud of surface points as a solid: normals by local planes, signed distance by the planes of the nearest points.

The accuracy depends on the cloud: the distance is exact near a surface that the points cover densely, and to a
few point spacings at edges. Inside it is the distance to the plane of the nearest surface, which near a concave edge is
less than the true depth. The outward side is that from which a point is visible, as in a scan: a part never
recorded has no inside, and where a wall is thinner than a few spacings some points (about 1 in 20) come out reversed. A
box of 70 mm with a hole and a floor of 5 mm needs about 5,000 points.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from concent_warp.checks import MAX_COUNT, Bounds, Count
from concent_warp.errors import SceneError
from concent_warp.scene.shapes.solid import Distances, Solid, normalised

if TYPE_CHECKING:
    from scipy.spatial import KDTree


@dataclass(frozen=True)
class PointCloudCfg:
    """How a cloud of points becomes a solid. Values were set on scans of boxes with holes, at noise below a spacing."""

    plane_neighbours: Annotated[int, Bounds(3, MAX_COUNT)] = 12
    """Nearest points that a local plane is fitted to, the point itself included [-]."""
    views: Count = 48
    """Viewpoints around the object from which visibility is determined [-]."""
    flip_radius: Annotated[float, Bounds(1, above_low=True)] = 100.0
    """Radius of the sphere at which the cloud is inverted, over the distance of the farthest point [-]: larger values
    count more points as visible (Katz, Tal and Basri 2007)."""
    vote_averagings: int = 2
    """How often votes on the outward side are averaged over neighbours [-]."""
    max_points: Count = 20_000
    """Points to about which a larger cloud is thinned out [-]."""
    distance_neighbours: Count = 6
    """Nearest points over whose planes the distance is averaged [-]."""
    min_points: Count = 50
    """Fewest points that describe a surface [-]."""


@dataclass(frozen=True)
class PointCloud(Solid):
    """Points on the surface of one closed object."""

    points: np.ndarray
    """Surface points [m], shape (n, 3)."""
    normals: np.ndarray
    """Outward unit normals, shape (n, 3)."""
    cfg: PointCloudCfg = field(default_factory=PointCloudCfg)
    """Settings."""

    @staticmethod
    def of(
        points: np.ndarray,
        normals: np.ndarray | None = None,
        name: str = "<point cloud>",
        cfg: PointCloudCfg | None = None,
    ) -> PointCloud:
        """Return the solid of surface points [m], shape (n, 3); normals not given are estimated.

        Raises `SceneError` where the points are too few, not finite, or all in one place.
        """
        cfg = cfg or PointCloudCfg()
        points = np.asarray(points, dtype=float)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < cfg.min_points:
            raise SceneError(
                "too few points for a surface",
                where=name,
                expected=f"(n, 3) with n >= {cfg.min_points}",
                found=points.shape,
            )
        if not np.isfinite(points).all():
            raise SceneError("the point cloud holds coordinates that are not finite", where=name)
        first = np.unique(points, axis=0, return_index=True)[1]
        first = first[_thinned(points[first], cfg.max_points)]
        points = points[first]
        if len(points) < cfg.min_points:
            raise SceneError(
                "too few different points for a surface",
                where=name,
                expected=f"at least {cfg.min_points}",
                found=len(points),
            )
        if normals is None:
            return PointCloud(points, _outward_normals(points, cfg), cfg)
        normals = np.asarray(normals, dtype=float)[first]
        return PointCloud(points, normalised(normals, np.linalg.norm(normals, axis=1)), cfg)

    @cached_property
    def tree(self) -> KDTree:
        """Search tree over the points."""
        from scipy.spatial import KDTree

        return KDTree(self.points)

    @cached_property
    def patch(self) -> np.ndarray:
        """Area that each point stands for [m^2], shape (n,): a share of the disc that reaches its eighth neighbour."""
        return np.pi * nearest_points(self.tree, self.points, 9)[0][:, -1] ** 2 / 8.5

    @property
    def area(self) -> float:
        """Area of the surface [m^2], from the density of the points."""
        return float(self.patch.sum())

    def distance(self, points: np.ndarray) -> Distances:
        """See `Solid.distance`."""
        reach, nearest = nearest_points(self.tree, points, self.cfg.distance_neighbours)
        width = np.sqrt(self.patch[nearest[:, :1]])
        weight = np.exp((reach[:, :1] ** 2 - reach**2) / width**2)
        weight /= weight.sum(axis=1, keepdims=True)
        height = np.einsum("nkd,nkd->nk", points[:, None] - self.points[nearest], self.normals[nearest])
        gradient = np.einsum("nk,nkd->nd", weight, self.normals[nearest])
        return np.sum(weight * height, axis=1), normalised(gradient, np.linalg.norm(gradient, axis=1))

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """See `Solid.sample`; samples the points with weights inverse to their density."""
        row = rng.choice(len(self.points), size=count, p=self.patch / self.patch.sum())
        return self.points[row].copy(), self.normals[row].copy()


def nearest_points(tree: Any, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [m] and indices of the nearest points in a SciPy tree, each (n, count), at points (n, 3)."""
    return tree.query(points, k=[*range(1, count + 1)])


def _outward_normals(points: np.ndarray, cfg: PointCloudCfg) -> np.ndarray:
    """Estimate outward normals of surface points, shape (n, 3).

    Directions are those of least spread among the nearest points. Signs are voted for: seen from each of many places
    around the object, the points in sight face the viewer. A point is in sight if it lies on the convex hull of the
    cloud turned inside out about the viewer (Katz, Tal and Basri, "Direct visibility of point sets", 2007). Neighbours
    share their votes.
    """
    from scipy.spatial import ConvexHull, KDTree, QhullError

    near = nearest_points(KDTree(points), points, cfg.plane_neighbours)[1]
    spread = points[near] - points[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    reach = float(np.linalg.norm(points - middle, axis=1).max())
    votes = np.zeros(len(points))
    for direction in _fibonacci_sphere(cfg.views):
        ray = (points - middle) / reach - 4 * direction
        length = np.linalg.norm(ray, axis=1, keepdims=True)
        ray /= length
        flipped = np.vstack([(2 * cfg.flip_radius * length.max() - length) * ray, np.zeros(3)])
        try:
            seen = ConvexHull(flipped).vertices
        except QhullError:
            continue
        seen = seen[seen < len(points)]
        votes[seen] -= np.einsum("nd,nd->n", normals[seen], ray[seen])
    agreement = np.einsum("nkd,nd->nk", normals[near], normals)
    agreement *= np.abs(agreement)
    for _ in range(cfg.vote_averagings):
        votes = np.mean(agreement * votes[near], axis=1)
    return normals * np.where(votes < 0, -1, 1)[:, None]


def _fibonacci_sphere(count: int) -> np.ndarray:
    """Return unit vectors spread evenly over the sphere, shape (count, 3)."""
    step = np.arange(count) + 0.5
    height = 1 - 2 * step / count
    angle = np.pi * (1 + np.sqrt(5)) * step
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def _thinned(points: np.ndarray, most: int) -> np.ndarray:
    """Return the indices of at most `most` points (n, 3), one of each cell of a grid where there are more."""
    if len(points) <= most:
        return np.arange(len(points))
    low = points.min(axis=0)
    cell = float(np.ptp(points, axis=0).max()) / np.sqrt(most)
    while True:
        first = np.unique(np.floor((points - low) / cell).astype(np.int64), axis=0, return_index=True)[1]
        if len(first) <= most:
            return np.sort(first)
        cell *= 1.2


def without_outliers(points: np.ndarray, *, neighbours: int = 12, spread: float = 4.0) -> np.ndarray:
    """Return which points are near others, shape (n, 3) -> (n,) bool.

    A point is an outlier if the mean distance to its nearest neighbours exceeds the median over all points by more than
    `spread` times the median deviation from that median.
    """
    from scipy.spatial import KDTree

    count = min(neighbours + 1, len(points))
    away = nearest_points(KDTree(points), points, count)[0][:, 1:].mean(axis=1)
    middle = np.median(away)
    return away <= middle + spread * np.median(np.abs(away - middle)) + 1e-12
