"""A closed triangle mesh as a solid: Warp finds the nearest face and the side, float64 gives the distance to it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.errors import SceneError
from concent_warp.scene.shapes.solid import Distances, Solid, normalised

if TYPE_CHECKING:
    import trimesh
    import warp as wp


@dataclass(frozen=True)
class MeshCfg:
    """Tolerances of meshes."""

    surface_tolerance: float = 1e-6
    """Distance below which a point lies on the surface and takes the normal of the face, relative to the mesh's extent
    [-]: above the rounding of the search, which is in float32."""
    flat_tolerance: float = 1e-9
    """Thickness below which points lie in one plane, relative to their spread [-]: above the rounding of float64."""


@dataclass(frozen=True)
class MeshSolid(Solid):
    """Closed triangle mesh with outward faces."""

    vertices: np.ndarray
    """Vertices [m], shape (v, 3)."""
    faces: np.ndarray
    """Vertex indices, counter-clockwise seen from outside, shape (f, 3)."""
    cfg: MeshCfg = field(default_factory=MeshCfg)
    """Tolerances."""

    @staticmethod
    def of(mesh: trimesh.Trimesh, name: str = "<mesh>", cfg: MeshCfg | None = None) -> MeshSolid:
        """Return the solid of a mesh, or of its convex hull, with a warning, where the mesh is not watertight."""
        cfg = cfg or MeshCfg()
        closed = closed_mesh(mesh, name, cfg)
        return MeshSolid(np.array(closed.vertices, dtype=float), np.array(closed.faces, dtype=int), cfg)

    @property
    def area(self) -> float:
        """Area of the surface [m^2]."""
        return float(_areas(self.vertices[self.faces]).sum())

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """See `Solid.sample`."""
        corners = self.vertices[self.faces]
        weight = _areas(corners)
        face = rng.choice(len(corners), size=count, p=weight / weight.sum())
        u, v = rng.random((2, count, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
        return a + u * (b - a) + v * (c - a), _face_normals(corners)[face]

    @cached_property
    def search(self) -> wp.Mesh:
        """The mesh in Warp's search tree, on the CPU, centred and scaled to an extent of 1 to spare float32."""
        import warp as wp

        return wp.Mesh(
            points=wp.array((self.vertices - self.centre) / self.extent, dtype=wp.vec3, device="cpu"),
            indices=wp.array(self.faces.ravel(), dtype=wp.int32, device="cpu"),
            support_winding_number=True,
        )

    @property
    def centre(self) -> np.ndarray:
        """Centre of the bounding box [m], shape (3,)."""
        return (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2

    @property
    def extent(self) -> float:
        """Longest side of the bounding box [m]."""
        return float(np.ptp(self.vertices, axis=0).max())

    def distance(self, points: np.ndarray) -> Distances:
        """See `Solid.distance`."""
        import warp as wp

        from concent_warp.kernels.mesh_distance import nearest_face

        scaled = (np.asarray(points, dtype=float) - self.centre) / self.extent
        face = np.empty(len(scaled), dtype=np.int32)
        side = np.empty(len(scaled), dtype=np.float32)
        reach = float(np.linalg.norm(scaled, axis=1).max(initial=0)) + 2.0
        # On the CPU a Warp array made with copy=False writes into the NumPy array.
        written = [wp.array(values, copy=False, device="cpu") for values in (face, side)]
        inputs = [self.search.id, wp.array(scaled, dtype=wp.vec3, device="cpu"), reach, *written]
        wp.launch(nearest_face, len(scaled), inputs=inputs, device="cpu")
        corners = self.vertices[self.faces[face]]
        sign = side.astype(float)
        away = points - _nearest_on_triangles(points, corners)
        length = np.linalg.norm(away, axis=1)
        touching = length < self.cfg.surface_tolerance * self.extent
        gradient = normalised(sign[:, None] * away, length)
        return sign * length, np.where(touching[:, None], _face_normals(corners), gradient)


def closed_mesh(mesh: trimesh.Trimesh, name: str, cfg: MeshCfg | None = None) -> trimesh.Trimesh:
    """Return a mesh with outward faces that bounds a volume: the mesh itself, or its convex hull with a warning."""
    import trimesh

    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    merged.update_faces(merged.nondegenerate_faces())
    merged.remove_unreferenced_vertices()
    if not len(merged.faces) or not np.isfinite(merged.vertices).all():
        raise SceneError("the mesh has no faces, or vertices that are not finite", where=name)
    if not merged.is_watertight:
        warnings.warn(f"{name}: the mesh is not watertight; its convex hull is used in its place", stacklevel=3)
        merged = convex_hull(merged.vertices, name, cfg)
    if not merged.is_winding_consistent:
        trimesh.repair.fix_normals(merged)
    if merged.volume < 0:
        merged.invert()
    return merged


def convex_hull(points: np.ndarray, name: str, cfg: MeshCfg | None = None) -> trimesh.Trimesh:
    """Return the convex hull of points [m], shape (n, 3).

    Raises `SceneError` where all points lie in one plane.
    """
    import trimesh
    from scipy.spatial import QhullError

    points = np.asarray(points, dtype=float)
    flat = (cfg or MeshCfg()).flat_tolerance
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    try:
        if len(spread) == 3 and spread[2] > flat * spread[0]:
            return trimesh.convex.convex_hull(points)
    except (QhullError, ValueError):
        pass
    raise SceneError("the points span no volume", where=name, expected="points that are not all in one plane")


def _areas(corners: np.ndarray) -> np.ndarray:
    """Return areas [m^2], shape (n,), of triangles (n, 3, 3)."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.linalg.norm(cross, axis=1) / 2


def _face_normals(corners: np.ndarray) -> np.ndarray:
    """Return unit normals, shape (n, 3), of triangles (n, 3, 3)."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normalised(cross, np.linalg.norm(cross, axis=1))


def _nearest_on_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the point of each triangle (n, 3, 3) that is nearest to each point (n, 3) [m], shape (n, 3).

    By the regions of the plane in which a corner, an edge or the inside is nearest (Ericson, "Real-Time Collision
    Detection", section 5.1.5).
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    d1, d2 = _dot(ab, points - a), _dot(ac, points - a)
    d3, d4 = _dot(ab, points - b), _dot(ac, points - b)
    d5, d6 = _dot(ab, points - c), _dot(ac, points - c)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    whole = va + vb + vc
    whole = np.where(whole > 0, whole, 1.0)
    # v and w are the barycentric weights of b and c; later choices override earlier ones.
    v, w = vb / whole, vc / whole
    with np.errstate(divide="ignore", invalid="ignore"):
        along_bc = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        along_ac = d2 / (d2 - d6)
        along_ab = d1 / (d1 - d3)
    for where, on_v, on_w in (
        ((va <= 0) & (d4 >= d3) & (d5 >= d6), 1 - along_bc, along_bc),
        ((vb <= 0) & (d2 >= 0) & (d6 <= 0), 0.0, along_ac),
        ((vc <= 0) & (d1 >= 0) & (d3 <= 0), along_ab, 0.0),
        ((d1 <= 0) & (d2 <= 0), 0.0, 0.0),
        ((d3 >= 0) & (d4 <= d3), 1.0, 0.0),
        ((d6 >= 0) & (d5 <= d6), 0.0, 1.0),
    ):
        v, w = np.where(where, on_v, v), np.where(where, on_w, w)
    return a + v[:, None] * ab + w[:, None] * ac


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the dot products of rows, shape (n, 3) -> (n,)."""
    return np.einsum("nd,nd->n", first, second)
