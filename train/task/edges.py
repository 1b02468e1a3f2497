"""Edge spheres for training: sharp edges for a contact geometry that was fitted without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from concent_warp.errors import SceneError
from concent_warp.model import Model
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
    geometry = model.geometry
    assert geometry is not None
    surfaces: dict[int, Surface] = {}
    for body, name in enumerate(geometry.bodies):
        try:
            surfaces[body] = Surface.of_body(model.scene, name)
        except SceneError:
            continue
    area = sum(surface.area for surface in surfaces.values())
    parts = []
    for body, surface in surfaces.items():
        own = np.flatnonzero(geometry.body == body)
        near = geometry.position[own[touched[own]]]
        if not len(near):
            continue
        points, _ = surface.sample(CANDIDATES, np.random.default_rng(body))
        count = round(cfg.count * surface.area / area)
        larger = inset(surface, points, float(np.median(geometry.radius[own])))
        centres, radius = edge_spheres(surface, points, larger, count, cfg.radius, min_radius=0.1 * cfg.radius)
        beside = np.linalg.norm(centres[:, None] - near, axis=2).min(axis=1, initial=np.inf) < cfg.reach
        own_small = own[geometry.radius[own] <= 2 * cfg.radius]
        apart = np.linalg.norm(centres[:, None] - geometry.position[own_small], axis=2).min(axis=1, initial=np.inf)
        new = beside & (apart > cfg.gap)
        centres, radius = centres[new], radius[new]
        closest = np.linalg.norm(centres[:, None] - geometry.position[own], axis=2)
        friction = geometry.friction[own[closest.argmin(axis=1)]] if len(centres) else np.empty(0)
        moved = centres + displacement(surface, geometry.position[own], geometry.radius[own], closest)
        parts.append((np.full(len(centres), body), moved, radius, friction))
    if not parts:
        return model
    body, position, radius, friction = (np.concatenate(values) for values in zip(*parts, strict=True))
    extended = ContactGeometry(
        geometry.bodies,
        np.append(geometry.body, body),
        np.concatenate([geometry.position, position]),
        np.append(geometry.radius, radius),
        np.append(geometry.mass, np.zeros(len(body))),
        np.append(geometry.friction, friction),
    )
    return replace(model, geometry=extended)


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
