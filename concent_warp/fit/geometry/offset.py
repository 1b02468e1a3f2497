"""The direction in which each sphere moves when its body grows evenly: the offset of every face by the same distance.

Moving spheres along averaged unit normals rounds a body off as it grows and hollows its faces as it shrinks: at an edge
of a box the average is diagonal, and a unit step along it moves each of the two faces by less than one. Growth by a
distance d needs a displacement x with n . x = d for the normal n of every face that the sphere makes up, which at a
corner of a box is d (1, 1, 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from concent_warp.checks import Count, Positive
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.contact_geometry import ContactGeometry


@dataclass(frozen=True)
class OffsetCfg:
    """Settings of the directions in which spheres move when their body grows."""

    probes: Count = 40_000
    """Sampled surface points among which the faces of a sphere are found [-]: about 1 mm apart on a hand-held
    object."""
    slack: float = 1e-3
    """A sphere is on all faces no farther from its centre than the nearest one plus this [m]: the distance of
    samples."""
    ridge: Positive = 1e-3
    """Regularisation of the least squares, relative to the eigenvalue 1 of a normal's outer product [-]: nothing
    moves along directions without a face."""


def offset_directions(geometry: ContactGeometry, scene: Scene, cfg: OffsetCfg | None = None) -> np.ndarray:
    """Return the displacement of each sphere for a unit of growth of its body, shape (S, 3).

    It is the shortest x that satisfies ``n . x = 1`` in the least-squares sense for the normals n near the sphere: the
    normal itself on a face or a smooth surface, longer at edges and corners.
    """
    cfg = cfg or OffsetCfg()
    result = np.zeros((len(geometry), 3))
    for body in geometry.bodies:
        rows = geometry.of(body)
        points, normals = Surface.of_body(scene, body).sample(cfg.probes, np.random.default_rng(0))
        tree = KDTree(points)
        nearest, _ = tree.query(geometry.position[rows])
        for row, distance in zip(rows, np.atleast_1d(nearest), strict=True):
            near = normals[tree.query_ball_point(geometry.position[row], float(distance) + cfg.slack)]
            gram = near.T @ near / len(near) + cfg.ridge * np.eye(3)
            result[row] = np.linalg.solve(gram, near.mean(axis=0))
    return result
