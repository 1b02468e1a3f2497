"""Edge spheres for training: sharp edges for a contact geometry that was fitted without them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from concent_warp.errors import SceneError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from concent_warp.scene.spheres.edges import edge_spheres
from concent_warp.scene.spheres.inset import inset
from concent_warp.train.cfg import EdgeCfg

CANDIDATES = 20_000
"""Surface points of each object to choose from."""
NEIGHBOURS = 8
"""Fitted spheres that determine how an edge sphere is moved."""
DAMPING = 1e-2
"""Damping of that displacement, relative to one neighbour's weight."""


def with_edge_spheres(model: Model, touched: np.ndarray, cfg: EdgeCfg) -> Model:
    """Return a model with small, massless spheres added along the edges near touched spheres, after all others.

    Objects without a surface in the scene get none.

    Args:
        model: The model.
        touched: Whether a sphere takes part in contact events, shape (S,) bool.
        cfg: Number, size and reach of the spheres.
    """
    assert model.geometry is not None
    geometry = model.geometry
    key = tuple(_Content(value) for value in (geometry.body, geometry.position, geometry.radius, geometry.friction))
    added = _edge_spheres(model.scene, geometry.bodies, key, _Content(touched), cfg)
    if added is None:
        return model
    body, position, radius, friction = added
    extended = ContactGeometry(
        geometry.bodies,
        np.append(geometry.body, body),
        np.concatenate([geometry.position, position]),
        np.append(geometry.radius, radius),
        np.append(geometry.mass, np.zeros(len(body))),
        np.append(geometry.friction, friction),
    )
    return replace(model, geometry=extended)


class _Content:
    """An array that is equal to another one of the same content, so that results can be remembered by it."""

    def __init__(self, value: np.ndarray) -> None:
        self.value = value.copy()
        self._key = (value.shape, value.dtype.str, value.tobytes())

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content) and self._key == other._key


@lru_cache(maxsize=4)
def _edge_spheres(
    scene: Scene, bodies: tuple[str, ...], fitted: tuple[_Content, ...], touched: _Content, cfg: EdgeCfg
) -> tuple[np.ndarray, ...] | None:
    """Return indices of bodies, centres, radii and frictions of the edge spheres; None where there are none.

    The last results are kept: each evaluation, rendering and training of one policy wants the same.
    """
    owner, position, size, friction = (one.value for one in fitted)
    surfaces: dict[int, Surface] = {}
    for body, name in enumerate(bodies):
        try:
            surfaces[body] = Surface.of_body(scene, name)
        except SceneError:
            continue
    area = sum(surface.area for surface in surfaces.values())
    parts = []
    for body, surface in surfaces.items():
        own = np.flatnonzero(owner == body)
        near = position[own[touched.value[own]]]
        if not len(near):
            continue
        points, _ = surface.sample(CANDIDATES, np.random.default_rng(body))
        count = round(cfg.count * surface.area / area)
        larger = inset(surface, points, float(np.median(size[own])))
        centres, radius = edge_spheres(surface, points, larger, count, cfg.radius, min_radius=0.1 * cfg.radius)
        beside = np.linalg.norm(centres[:, None] - near, axis=2).min(axis=1, initial=np.inf) < cfg.reach
        own_small = own[size[own] <= 2 * cfg.radius]
        apart = np.linalg.norm(centres[:, None] - position[own_small], axis=2).min(axis=1, initial=np.inf)
        new = beside & (apart > cfg.gap)
        centres, radius = centres[new], radius[new]
        closest = np.linalg.norm(centres[:, None] - position[own], axis=2)
        nearest = friction[own[closest.argmin(axis=1)]] if len(centres) else np.empty(0)
        moved = centres + displacement(surface, position[own], size[own], closest)
        parts.append((np.full(len(centres), body), moved, radius, nearest))
    if not parts:
        return None
    return tuple(np.concatenate(values) for values in zip(*parts, strict=True))


def displacement(surface: Surface, centres: np.ndarray, radius: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the displacements of edge spheres that follow those of the fitted spheres beside them [m], shape (k, 3).

    A fitted sphere stands out of the nominal surface by s along its normal n. An edge has neighbours on two faces and
    more, so that the displacement u is the damped least-squares solution of n . u = s over the nearest.

    Args:
        surface: Nominal surface.
        centres: Centres of the fitted spheres [m], shape (S, 3).
        radius: Their radii [m], shape (S,).
        distance: Distance of each edge sphere from each of them [m], shape (k, S).
    """
    depth, normal = surface.distance(centres)
    offset = depth + radius
    moves = np.zeros((len(distance), 3))
    for row, gaps in enumerate(distance):
        nearest = np.argsort(gaps)[:NEIGHBOURS]
        n = normal[nearest]
        moves[row] = np.linalg.solve(n.T @ n + DAMPING * np.eye(3), n.T @ offset[nearest])
    return moves
