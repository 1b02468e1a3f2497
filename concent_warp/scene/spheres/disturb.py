"""Perturbed contact geometries for benchmarks and tests: noise on the centres, or faces moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from concent_warp.errors import ModelError
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.cloud import nearest_points
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

SelectFaces = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From surface points [m] and outward normals, each (n, 3) in the body frame, to which of them are meant, (n,) bool."""


def disturb(
    geometry: ContactGeometry,
    *,
    position_std: float,
    rng: np.random.Generator,
    bodies: Sequence[str] | None = None,
) -> ContactGeometry:
    """Add independent Gaussian noise to the centres.

    Args:
        geometry: contact geometry.
        position_std: standard deviation of each coordinate [m].
        rng: source of the noise.
        bodies: bodies whose spheres move; None for all. The noise of a sphere does not depend on this choice.
    """
    noise = position_std * rng.standard_normal(geometry.position.shape)
    if bodies is not None:
        noise[~np.isin(geometry.body, [_body_index(geometry, name) for name in bodies])] = 0
    return geometry.with_position(geometry.position + noise)


def offset_normal(
    geometry: ContactGeometry,
    scene: Scene,
    distance: float,
    select: SelectFaces,
    *,
    body: str,
    slack: float = 1e-3,
    surface: Surface | None = None,
    samples: int = 40_000,
) -> ContactGeometry:
    """Move the spheres that make up some faces of a body along the outward normals there.

    A sphere makes up a face if the face is no farther from its centre than radius plus `slack`; it moves along the
    normal of the nearest point of the selected faces.

    Args:
        geometry: contact geometry.
        scene: scene that holds the body.
        distance: how far to move [m]; negative moves inward.
        select: the faces, say ``toward_axis()`` for the walls of a hole.
        body: name of the body.
        slack: allowance [m] for spheres that do not quite reach the face.
        surface: surface to use in place of the geoms of the scene.
        samples: surface points that represent the faces.

    Raises `ModelError` where no sphere is at the selected faces.
    """
    from scipy.spatial import KDTree

    surface = surface or Surface.of_body(scene, body)
    mine = np.flatnonzero(geometry.body == _body_index(geometry, body))
    points, normals = surface.sample(samples, np.random.default_rng(0))
    meant = select(points, normals)
    points, normals = points[meant], normals[meant]
    if not len(points):
        raise ModelError(f"no faces of body {body!r} are selected", fix="check the selection")
    away, nearest = (column[:, 0] for column in nearest_points(KDTree(points), geometry.position[mine], 1))
    moved = away <= geometry.radius[mine] + slack
    if not moved.any():
        raise ModelError(
            f"no sphere of body {body!r} is at the selected faces",
            expected=f"a gap of at most {slack:g} m",
            found=f"{(away - geometry.radius[mine]).min():.3g} m",
        )
    position = geometry.position.copy()
    position[mine[moved]] += distance * normals[nearest[moved]]
    return geometry.with_position(position)


def toward_axis(
    point: Sequence[float] = (0.0, 0.0, 0.0), direction: Sequence[float] = (0.0, 0.0, 1.0), *, cosine: float = 0.5
) -> SelectFaces:
    """Select the faces whose normals point at an axis, such as the walls of a hole.

    Args:
        point: a point of the axis, body frame [m], shape (3,).
        direction: direction of the axis, shape (3,).
        cosine: least cosine between the normal and the way to the axis.
    """
    axis = np.asarray(direction, dtype=float) / np.linalg.norm(direction)

    def select(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        away = np.asarray(point, dtype=float) - points
        away -= (away @ axis)[:, None] * axis
        return np.einsum("nd,nd->n", away, normals) >= cosine * np.maximum(np.linalg.norm(away, axis=1), 1e-12)

    return select


def _body_index(geometry: ContactGeometry, name: str) -> int:
    """Return the index of a body of the geometry."""
    if name not in geometry.bodies:
        raise ModelError(f"the contact geometry has no body {name!r}", expected=f"one of {list(geometry.bodies)}")
    return geometry.bodies.index(name)
