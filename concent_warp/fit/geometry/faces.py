"""Faces of the objects, and the distance of each sphere from the plane through its neighbours on the face.

Contact surfaces are locally smooth, so the neighbours of a sphere on the same face predict where the face is at the
sphere. One demonstration touches a face along one path only and cannot distinguish a rough face from a smooth one that
supports the object along this path; this prior can. It does not change sizes and slopes of faces, which a demonstration
determines: a face is smooth where its distance from the nominal surface varies linearly over some centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from concent_warp.checks import Angle, Count, Positive
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.contact_geometry import ContactGeometry


@dataclass(frozen=True)
class FaceCfg:
    """Settings of the search for faces and of their flattening.

    "Empirical" values were set on perturbed boxes and on the fit of the shape sorter.
    """

    probes: Count = 40_000
    """Sampled surface points among which the faces of a sphere are found [-]: about 1 mm apart on a hand-held
    object."""
    slack: float = 2e-3
    """A sphere is on all faces no farther from its centre than the nearest one plus this [m]. Empirical."""
    max_beside: float = 1e-3
    """Distance beside a face at which a sphere's foot on it may lie [m]: the distance of samples."""
    max_angle: Angle = 25.0
    """Largest angle between the normals at two places of one face [deg]. Empirical."""
    max_slope: float = 0.35
    """Distance of a face from the tangent plane at one of its places over the distance from the place, at most [-]:
    below tan(`max_angle`)."""
    min_weight: float = 1e-3
    """Weight below which a neighbour does not count [-]."""
    outlier_ratio: Positive = 4.5
    """Deviation from the plane of a face beyond which a neighbour does not count, in medians of the deviations [-]: 3
    standard deviations of a normal distribution."""
    rounding: float = 1e-9
    """Deviation below which a place counts as flat [m]: rounding errors."""
    reweightings: int = 3
    """Rounds of reweighting [-]. Empirical."""
    flattenings: int = 3
    """Rounds of flattening a whole geometry [-]: what counts as an outlier changes from one to the next. Empirical."""
    ridge: Positive = 1e-3
    """Regularisation of the least squares, relative to the eigenvalue 1 of a normal's outer product [-]: nothing
    moves along directions without a face."""

    @property
    def min_cosine(self) -> float:
        """Least cosine between the normals at two places of one face [-]."""
        return float(np.cos(np.radians(self.max_angle)))


class Faces:
    """The faces that spheres are on. A place is one sphere's part in one face; a sphere at an edge has two."""

    def __init__(self, geometry: ContactGeometry, scene: Scene, length: float, cfg: FaceCfg | None = None) -> None:
        """Find the places of all spheres.

        Args:
            geometry: Where the spheres are.
            scene: Scene with the bodies' nominal surfaces.
            length: Length over which a face is smooth [m].
            cfg: Settings.
        """
        self.cfg = cfg = cfg or FaceCfg()
        found = [place for body in geometry.bodies for place in _face_memberships(geometry, scene, body, cfg)]
        sphere, normal, foot, first = (np.array(column) for column in zip(*found, strict=True))
        self.count = len(geometry)
        self.sphere, self.normal, self.first = sphere, normal, first
        self.height = np.einsum("pd,pd->p", geometry.position[sphere] - foot, normal) + geometry.radius[sphere]
        """Height of the sphere above the nominal face at the start [m], shape (places,)."""
        self.basis, self.weight = _neighbourhoods(foot, normal, geometry.body[sphere], length, cfg)

    def roughness(self, displacement: np.ndarray) -> np.ndarray:
        """Return the height of each place above the plane through its neighbours on the face [m], shape (places,).

        The plane is relative to the nominal face and fitted by weighted least squares without outliers. A place that is
        an outlier itself belongs to another surface and counts as smooth, unless it is above the face that is nearest
        to the sphere.

        Args:
            displacement: Of the spheres from the start [m], shape (S, 3).
        """
        cfg = self.cfg
        height = self.height + np.einsum("pd,pd->p", displacement[self.sphere], self.normal)
        weight, counted = self.weight, self.weight > 0
        rough, limit = np.zeros_like(height), np.zeros_like(height)
        for _ in range(cfg.reweightings):
            weighted = self.basis * weight[:, :, None]
            gram = np.einsum("ijk,ijl->ikl", weighted, self.basis) + cfg.ridge * np.diag([0.0, 1.0, 1.0])
            plane = np.linalg.solve(gram, np.einsum("ijk,j->ik", weighted, height)[:, :, None])[:, :, 0]
            rough = height - plane[:, 0]
            deviation = np.abs(height[None] - np.einsum("ijk,ik->ij", self.basis, plane))
            spread = np.array([np.median(row[mine]) for row, mine in zip(deviation, counted, strict=True)])
            limit = cfg.outlier_ratio * spread + cfg.rounding
            weight = np.where(deviation <= limit[:, None], self.weight, 0)
        belongs = (np.abs(rough) <= limit) | (self.first & (rough > 0))
        return np.where(belongs & (np.abs(rough) > cfg.rounding), rough, 0.0)

    def flattening(self, displacement: np.ndarray) -> np.ndarray:
        """Return the displacements that bring each sphere onto the planes of its faces [m], shape (S, 3).

        It is the shortest x with ``n . x = -roughness`` for the normal n of each of the sphere's places.

        Args:
            displacement: Of the spheres from the start [m], shape (S, 3).
        """
        rough = self.roughness(displacement)
        gram = np.broadcast_to(self.cfg.ridge * np.eye(3), (self.count, 3, 3)).copy()
        right = np.zeros((self.count, 3))
        np.add.at(gram, self.sphere, self.normal[:, :, None] * self.normal[:, None, :])
        np.add.at(right, self.sphere, -rough[:, None] * self.normal)
        return np.linalg.solve(gram, right[:, :, None])[:, :, 0]


def flattened(geometry: ContactGeometry, faces: Faces) -> ContactGeometry:
    """Return the geometry with its faces flattened; `faces` are its own."""
    displacement = np.zeros_like(geometry.position)
    for _ in range(faces.cfg.flattenings):
        displacement += faces.flattening(displacement)
    return geometry.with_position(geometry.position + displacement)


def _face_memberships(
    geometry: ContactGeometry, scene: Scene, body: str, cfg: FaceCfg
) -> list[tuple[int, np.ndarray, np.ndarray, bool]]:
    """Return sphere, outward normal (3,), foot on the nominal face [m] (3,) and whether it is the nearest face."""
    points, normals = Surface.of_body(scene, body).sample(cfg.probes, np.random.default_rng(0))
    tree = KDTree(points)
    result = []
    for row in geometry.of(body):
        centre = geometry.position[row]
        nearest, _ = tree.query(centre)
        near = np.array(tree.query_ball_point(centre, float(nearest) + cfg.slack))
        near = near[np.argsort(np.linalg.norm(points[near] - centre, axis=1), kind="stable")]
        first = True
        while len(near):
            normal, foot = normals[near[0]], points[near[0]]
            near = near[normals[near] @ normal < cfg.min_cosine]
            beside = (centre - foot) - (centre - foot) @ normal * normal
            if first or np.linalg.norm(beside) <= cfg.max_beside:
                result.append((int(row), normal, foot, first))
            first = False
    return result


def _neighbourhoods(
    foot: np.ndarray, normal: np.ndarray, body: np.ndarray, length: float, cfg: FaceCfg
) -> tuple[np.ndarray, np.ndarray]:
    """Return the basis of a plane over the neighbourhood of each place, and the weights of the neighbours.

    Args:
        foot: Feet of the places [m], shape (places, 3).
        normal: Their outward normals, shape (places, 3).
        body: Their bodies, shape (places,) int.
        length: Length over which a face is smooth [m].
        cfg: Settings.

    Returns:
        One and the two tangential coordinates relative to `length` of neighbour j seen from i, shape (places, places,
        3); weights, zero for those on other faces, shape (places, places).
    """
    offset = foot[None] - foot[:, None]
    across = np.einsum("ijd,id->ij", offset, normal)
    distance = np.linalg.norm(offset, axis=2)
    flat = np.abs(across) <= cfg.max_slope * distance + cfg.rounding
    same = (body[:, None] == body) & (normal @ normal.T > cfg.min_cosine) & flat
    weight = np.where(same, np.exp(-(distance**2) / (2 * length**2)), 0.0)
    weight[weight < cfg.min_weight] = 0
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    tangent = [np.einsum("ijd,id->ij", offset, axis) / length for axis in (first, second)]
    return np.stack([np.ones_like(distance), *tangent], axis=2), weight
