"""Faces of the objects, and how far each sphere stands out of the smooth course of its face.

Contact surfaces are locally smooth: what a sphere's neighbours on the same face say about where the face lies holds for
the sphere too. One demonstration touches a face along one path only and cannot tell a rough face from a smooth one that
carries the object along this path; this prior can. Sizes and slopes of faces, which a demonstration does tell, it
leaves alone: a face is smooth where its distance from the nominal surface varies linearly over some centimetres.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

PROBES = 40_000
"""Surface points looked at to find the faces that a sphere belongs to."""
SLACK = 2e-3
"""A sphere makes up the faces no farther from its centre than the nearest one plus this [m]."""
BESIDE = 1e-3
"""How far beside a face a sphere's foot on it may lie [m]."""
SAME_FACE = float(np.cos(np.radians(25.0)))
"""Least cosine between the normals of places of one face."""
BEND = 0.35
"""How far a face may leave a place's tangent plane, relative to the distance from the place."""
FAR = 1e-3
"""Neighbours of less weight than this do not count."""
OUTLIER = 4.5
"""Deviation from the course of a face beyond which a neighbour does not count, in medians of the deviations."""
SETTLED = 1e-9
"""Deviations below this are rounding [m]."""
ROUNDS = 3
"""Rounds of reweighting."""
FLATTENINGS = 3
"""Rounds of flattening a whole geometry: what counts as an outlier changes."""
RIDGE = 1e-3
"""Regularisation of least squares, relative to one: directions about which nothing is said do not move."""


class Faces:
    """Which spheres make up which faces. A place is one sphere's part in one face; a sphere at an edge has two."""

    def __init__(self, geometry: ContactGeometry, scene: Scene, length: float) -> None:
        """Find the places of all spheres.

        Args:
            geometry: Where the spheres are.
            scene: Scene with the bodies' nominal surfaces.
            length: Length over which a face is smooth [m].
        """
        found = [place for body in geometry.bodies for place in _places(geometry, scene, body)]
        sphere, normal, foot, first = (np.array(column) for column in zip(*found, strict=True))
        self.count = len(geometry)
        self.sphere, self.normal, self.first = sphere, normal, first
        self.height = np.einsum("pd,pd->p", geometry.position[sphere] - foot, normal) + geometry.radius[sphere]
        """How far the sphere stands out of the nominal face at the start [m], shape (places,)."""
        self.basis, self.weight = _neighbourhoods(foot, normal, geometry.body[sphere], length)

    def roughness(self, displacement: np.ndarray) -> np.ndarray:
        """Return how far each place stands out of the smooth course of its face [m], shape (places,).

        The course is a plane through the neighbours relative to the nominal face, fitted by weighted least squares with
        outliers left out. A place that is an outlier itself belongs to something else and counts as smooth, unless it
        is the sphere's nearest face that it stands out of.

        Args:
            displacement: Of the spheres from the start [m], shape (S, 3).
        """
        height = self.height + np.einsum("pd,pd->p", displacement[self.sphere], self.normal)
        weight, counted = self.weight, self.weight > 0
        rough, limit = np.zeros_like(height), np.zeros_like(height)
        for _ in range(ROUNDS):
            weighted = self.basis * weight[:, :, None]
            gram = np.einsum("ijk,ijl->ikl", weighted, self.basis) + RIDGE * np.diag([0.0, 1.0, 1.0])
            course = np.linalg.solve(gram, np.einsum("ijk,j->ik", weighted, height)[:, :, None])[:, :, 0]
            rough = height - course[:, 0]
            deviation = np.abs(height[None] - np.einsum("ijk,ik->ij", self.basis, course))
            spread = np.array([np.median(row[mine]) for row, mine in zip(deviation, counted, strict=True)])
            limit = OUTLIER * spread + SETTLED
            weight = np.where(deviation <= limit[:, None], self.weight, 0)
        belongs = (np.abs(rough) <= limit) | (self.first & (rough > 0))
        return np.where(belongs & (np.abs(rough) > SETTLED), rough, 0.0)

    def flattening(self, displacement: np.ndarray) -> np.ndarray:
        """Return what brings each sphere onto the smooth course of its faces [m], shape (S, 3).

        It is the shortest x with ``n . x = -roughness`` for the normal n of each of the sphere's places.

        Args:
            displacement: Of the spheres from the start [m], shape (S, 3).
        """
        rough = self.roughness(displacement)
        gram = np.broadcast_to(RIDGE * np.eye(3), (self.count, 3, 3)).copy()
        right = np.zeros((self.count, 3))
        np.add.at(gram, self.sphere, self.normal[:, :, None] * self.normal[:, None, :])
        np.add.at(right, self.sphere, -rough[:, None] * self.normal)
        return np.linalg.solve(gram, right[:, :, None])[:, :, 0]


def flattened(geometry: ContactGeometry, faces: Faces) -> ContactGeometry:
    """Return the geometry with its faces flattened; `faces` are its own."""
    displacement = np.zeros_like(geometry.position)
    for _ in range(FLATTENINGS):
        displacement += faces.flattening(displacement)
    return geometry.with_position(geometry.position + displacement)


def _places(geometry: ContactGeometry, scene: Scene, body: str) -> list[tuple[int, np.ndarray, np.ndarray, bool]]:
    """Return sphere, outward normal (3,), foot on the nominal face [m] (3,) and whether it is the nearest face."""
    points, normals = Surface.of_body(scene, body).sample(PROBES, np.random.default_rng(0))
    tree = KDTree(points)
    result = []
    for row in geometry.of(body):
        centre = geometry.position[row]
        nearest, _ = tree.query(centre)
        near = np.array(tree.query_ball_point(centre, float(nearest) + SLACK))
        near = near[np.argsort(np.linalg.norm(points[near] - centre, axis=1), kind="stable")]
        first = True
        while len(near):
            normal, foot = normals[near[0]], points[near[0]]
            near = near[normals[near] @ normal < SAME_FACE]
            beside = (centre - foot) - (centre - foot) @ normal * normal
            if first or np.linalg.norm(beside) <= BESIDE:
                result.append((int(row), normal, foot, first))
            first = False
    return result


def _neighbourhoods(
    foot: np.ndarray, normal: np.ndarray, body: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a plane over each place's surroundings is made of, and which neighbours count how much.

    Args:
        foot: Feet of the places [m], shape (places, 3).
        normal: Their outward normals, shape (places, 3).
        body: Their bodies, shape (places,) int.
        length: Length over which a face is smooth [m].

    Returns:
        One and the two tangential coordinates relative to `length` of neighbour j seen from i, shape (places, places,
        3); weights, zero for those on other faces, shape (places, places).
    """
    offset = foot[None] - foot[:, None]
    across = np.einsum("ijd,id->ij", offset, normal)
    distance = np.linalg.norm(offset, axis=2)
    same = (body[:, None] == body) & (normal @ normal.T > SAME_FACE) & (np.abs(across) <= BEND * distance + SETTLED)
    weight = np.where(same, np.exp(-(distance**2) / (2 * length**2)), 0.0)
    weight[weight < FAR] = 0
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    tangent = [np.einsum("ijd,id->ij", offset, axis) / length for axis in (first, second)]
    return np.stack([np.ones_like(distance), *tangent], axis=2), weight
