"""Sphere centres that keep the spheres within an object: signed distance of at most minus the radius, to all faces.

Moving each surface point in along its own normal is not enough: near an edge such a sphere sticks out of the
neighbouring face. So each centre is pushed on, along the gradient of the signed distance, until every face is far
enough. Where the object is thinner than the sphere there is no such centre, and the sphere shrinks to what fits.
"""

from __future__ import annotations

import numpy as np

from concent_warp.scene.shapes.surface import Surface

STAGES = 6
"""Radii on the way to the wanted one: a centre goes in step by step, and does not jump through a thin wall."""
PUSHES = 16
"""Pushes after which a centre that is still too near a face is held to have no room."""
HALVINGS = 10
"""Bisection steps towards the largest radius that fits where the wanted one does not."""
SLACK = (1e-9, 1e-3)
"""How much deeper than needed a push goes, relative to the radius: first against rounding alone, in the second half of
the pushes more, because the distance to a point cloud is no smooth function and the last micrometre is slow."""


def inset(surface: Surface, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Push surface points inward until spheres about them are covered by the object.

    Args:
        surface: surface of the object.
        points: points on it [m], shape (n, 3).
        radius: wanted radius [m].

    Returns:
        Centres [m], shape (n, 3), and radii [m], shape (n,), with ``surface.signed_distance(centres) <= -radii``. A
        radius is the wanted one, or smaller where the object is too thin; where nothing fits it is 0 or below.
    """
    centres = np.array(points, dtype=float)
    fits = np.zeros(len(centres))
    open_above = np.full(len(centres), radius)
    rising = np.arange(len(centres))
    for stage in radius * np.arange(1, STAGES + 1) / STAGES:
        moved, arrived = _push(surface, centres[rising], np.full(len(rising), stage))
        open_above[rising[~arrived]] = stage
        rising = rising[arrived]
        centres[rising], fits[rising] = moved[arrived], stage
    stuck = np.setdiff1d(np.arange(len(centres)), rising)
    fits[rising] = radius
    for _ in range(HALVINGS if len(stuck) else 0):
        trial = (fits[stuck] + open_above[stuck]) / 2
        moved, arrived = _push(surface, centres[stuck], trial)
        open_above[stuck[~arrived]] = trial[~arrived]
        centres[stuck[arrived]], fits[stuck[arrived]] = moved[arrived], trial[arrived]
    fits[stuck] = np.minimum(-surface.signed_distance(centres[stuck]), radius)
    return centres, fits


def _push(surface: Surface, centres: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move centres (n, 3) inward until they lie `depth` [m], shape (n,), deep; return them and which arrived."""
    centres = centres.copy()
    left = np.arange(len(centres))
    for turn in range(PUSHES):
        distance, gradient = surface.distance(centres[left])
        lacking = distance + depth[left]
        near = lacking > 0
        left = left[near]
        if not len(left):
            break
        centres[left] -= (lacking[near] + SLACK[2 * turn >= PUSHES] * depth[left])[:, None] * gradient[near]
    arrived = np.ones(len(centres), dtype=bool)
    arrived[left] = surface.signed_distance(centres[left]) <= -depth[left]
    return centres, arrived
