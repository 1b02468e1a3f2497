"""Shape of a tracked body: triangles, edges between them, surface points, symmetries."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from concent_warp.perception.tracking.geometry.ray_renderer import VISUAL_GROUPS
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.surface import Surface

CREASE = np.cos(np.radians(30))
"""Cosine of the angle between two faces from which on their edge is seen inside the outline."""
SAMPLES_ALONG = 40
"""Points on an edge as long as the body's radius."""
ROUND_SECTIONS = 48
"""Faces around a cylinder, capsule or ellipsoid."""


@dataclass(frozen=True)
class Edges:
    """Points along the edges of a triangle mesh, body frame."""

    point: np.ndarray
    """Points [m], shape (n, 3)."""
    direction: np.ndarray
    """Unit vectors along the edges, shape (n, 3)."""
    normals: np.ndarray
    """Normals of the two faces, shape (n, 2, 3)."""
    inward: np.ndarray
    """Unit vectors in the two faces, away from the edge, shape (n, 2, 3)."""
    crease: np.ndarray
    """Whether the faces meet at an angle that is seen, shape (n,) bool."""
    edge: np.ndarray
    """Number of the edge, shape (n,)."""
    half: np.ndarray
    """Half the length of edge that each point stands for [m], shape (n,)."""


@dataclass(frozen=True)
class TrackedShape:
    """Geometry of one movable body."""

    name: str
    row: int
    """Row of the body in the compiled scene."""
    surface: Surface
    """Outer surface, with signed distances."""
    reach: float
    """Radius of the sphere around the body frame that holds the body [m]."""
    edges: Edges
    """Points on its edges."""
    points: np.ndarray
    """Points of the surface [m], shape (n, 3)."""
    normals: np.ndarray
    """Their outward normals, shape (n, 3)."""

    @staticmethod
    def of_body(scene: Scene, name: str, seed: int, count: int = 400) -> TrackedShape:
        """Return the shape of a body of a scene.

        Raises:
            SceneError: It has no closed surface.
        """
        row = scene.model.body(name).id
        surface = Surface.of_body(scene, name)
        points, normals = surface.sample(count, np.random.default_rng(seed))
        meshes = _triangles(scene.model, row)
        reach = max(float(np.linalg.norm(v, axis=1).max()) for v, _ in meshes)
        edges = _joined([_edges(v, f, reach / SAMPLES_ALONG) for v, f in meshes])
        if len(meshes) > 1:
            edges = _outer(edges, surface, 1e-3 * reach)
        return TrackedShape(name, row, surface, reach, edges, points, normals)

    @cached_property
    def centre(self) -> np.ndarray:
        """Mean of the surface [m], body frame, shape (3,)."""
        return self.points.mean(axis=0)

    @cached_property
    def radius(self) -> float:
        """Root mean square distance of the surface from its mean [m]."""
        return float(np.sqrt(((self.points - self.centre) ** 2).sum(axis=1).mean()))


def _triangles(model: mujoco.MjModel, body: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return vertices [m], body frame, and faces of each visible geom of a body."""
    import trimesh

    kind, create = mujoco.mjtGeom, trimesh.creation
    geoms = np.flatnonzero(model.geom_bodyid == body)
    visible = geoms[model.geom_group[geoms] < VISUAL_GROUPS]
    result = []
    for g in visible if len(visible) else geoms:
        size = model.geom_size[g]
        what = kind(int(model.geom_type[g]))
        if what == kind.mjGEOM_BOX:
            mesh = create.box(extents=2 * size)
        elif what == kind.mjGEOM_SPHERE:
            mesh = create.icosphere(subdivisions=3, radius=size[0])
        elif what == kind.mjGEOM_ELLIPSOID:
            mesh = create.icosphere(subdivisions=3, radius=1.0)
            mesh.apply_scale(size)
        elif what == kind.mjGEOM_CAPSULE:
            mesh = create.capsule(height=2 * size[1], radius=size[0], count=[ROUND_SECTIONS, ROUND_SECTIONS])
            mesh.apply_translation(-mesh.bounds.mean(axis=0))
        elif what == kind.mjGEOM_CYLINDER:
            mesh = create.cylinder(radius=size[0], height=2 * size[1], sections=ROUND_SECTIONS)
        elif what == kind.mjGEOM_MESH:
            number = int(model.geom_dataid[g])
            first, start = model.mesh_vertadr[number], model.mesh_faceadr[number]
            vertices = model.mesh_vert[first : first + model.mesh_vertnum[number]]
            mesh = trimesh.Trimesh(vertices, model.mesh_face[start : start + model.mesh_facenum[number]])
        else:
            continue
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
        mesh.merge_vertices()
        result.append((mesh.vertices @ rotation.reshape(3, 3).T + model.geom_pos[g], np.asarray(mesh.faces)))
    return result


def _edges(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> Edges:
    """Return points, about `spacing` [m] apart, on the edges of a mesh that are not within a flat face."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    pairs, ends = mesh.face_adjacency, mesh.face_adjacency_edges
    normal = mesh.face_normals[pairs]
    bent = np.einsum("ek,ek->e", normal[:, 0], normal[:, 1]) < 1 - 1e-6
    pairs, ends, normal = pairs[bent], ends[bent], normal[bent]
    start, stop = vertices[ends[:, 0]], vertices[ends[:, 1]]
    length = np.linalg.norm(stop - start, axis=1)
    direction = (stop - start) / np.maximum(length, 1e-12)[:, None]
    middle = vertices[faces].mean(axis=1)[pairs] - start[:, None]
    inward = middle - np.einsum("efk,ek->ef", middle, direction)[..., None] * direction[:, None]
    inward /= np.maximum(np.linalg.norm(inward, axis=2, keepdims=True), 1e-12)
    crease = np.einsum("ek,ek->e", normal[:, 0], normal[:, 1]) < CREASE
    # Creases of a shape that bends inward are kept, too: light changes across them.
    count = np.maximum(np.round(length / spacing), 1).astype(int)
    edge = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[edge]
    point = start[edge] + (share * length[edge])[:, None] * direction[edge]
    half = (length / count)[edge] / 2
    return Edges(point, direction[edge], normal[edge], inward[edge], crease[edge], edge, half)


def _joined(parts: list[Edges]) -> Edges:
    """Return the edges of several meshes as one."""
    offset, number = 0, []
    for part in parts:
        number.append(part.edge + offset)
        offset += int(part.edge.max(initial=-1)) + 1
    return Edges(
        np.concatenate([p.point for p in parts]),
        np.concatenate([p.direction for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.inward for p in parts]),
        np.concatenate([p.crease for p in parts]),
        np.concatenate(number),
        np.concatenate([p.half for p in parts]),
    )


def _outer(edges: Edges, surface: Surface, step: float) -> Edges:
    """Return the edges at which the union of all solids has one: just beyond either face there is air."""
    first, second = edges.normals[:, 0], edges.normals[:, 1]
    free = surface.signed_distance(edges.point + step * first - step / 2 * second) > 0
    free &= surface.signed_distance(edges.point + step * second - step / 2 * first) > 0
    return Edges(
        edges.point[free], edges.direction[free], edges.normals[free], edges.inward[free], edges.crease[free],
        edges.edge[free], edges.half[free],
    )  # fmt: skip
