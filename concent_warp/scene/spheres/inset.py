"""Sphere centres that keep the spheres within an object: signed distance of at most minus the radius, to all faces.

Moving each surface point in along its own normal is not enough: near an edge such a sphere sticks out of the
neighbouring face. So each centre is moved on, along the gradient of the signed distance, until every face is far
enough. Where the object is thinner than the sphere there is no such centre, and the sphere shrinks to what fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from concent_warp.checks import Bounds
from concent_warp.scene.shapes.surface import Surface


@dataclass(frozen=True)
class InsetCfg:
    """How sphere centres are moved into an object."""

    radius_steps: Annotated[int, Bounds(1, 10_000)] = 6
    """Steps from radius 0 to the wanted one [-]: so that no centre passes through a thin wall."""
    max_moves: Annotated[int, Bounds(1, 10_000)] = 16
    """Moves after which a centre that is still too near a face counts as without room [-]. Empirical."""
    bisections: Annotated[int, Bounds(0, 100)] = 10
    """Bisection steps towards the largest radius that fits where the wanted one does not [-]: to a thousandth."""
    overshoot: tuple[float, float] = (1e-9, 1e-3)
    """Depth that a move exceeds the wanted one by, relative to it, in the first and the second half of the moves [-]:
    first above rounding, then more, because the distance to a point cloud is not smooth and converges slowly."""


def inset(
    surface: Surface, points: np.ndarray, radius: float, cfg: InsetCfg | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Move surface points inward until spheres about them are covered by the object.

    Args:
        surface: surface of the object.
        points: points on it [m], shape (n, 3).
        radius: wanted radius [m].
        cfg: settings.

    Returns:
        Centres [m], shape (n, 3), and radii [m], shape (n,), with ``surface.signed_distance(centres) <= -radii``. A
        radius is the wanted one, or smaller where the object is too thin; where nothing fits it is 0 or below.
    """
    cfg = cfg or InsetCfg()
    centres = np.array(points, dtype=float)
    fits = np.zeros(len(centres))
    open_above = np.full(len(centres), radius)
    rising = np.arange(len(centres))
    for stage in radius * np.arange(1, cfg.radius_steps + 1) / cfg.radius_steps:
        moved, arrived = _moved_inward(surface, centres[rising], np.full(len(rising), stage), cfg)
        open_above[rising[~arrived]] = stage
        rising = rising[arrived]
        centres[rising], fits[rising] = moved[arrived], stage
    stuck = np.setdiff1d(np.arange(len(centres)), rising)
    fits[rising] = radius
    for _ in range(cfg.bisections if len(stuck) else 0):
        trial = (fits[stuck] + open_above[stuck]) / 2
        moved, arrived = _moved_inward(surface, centres[stuck], trial, cfg)
        open_above[stuck[~arrived]] = trial[~arrived]
        centres[stuck[arrived]], fits[stuck[arrived]] = moved[arrived], trial[arrived]
    fits[stuck] = np.minimum(-surface.signed_distance(centres[stuck]), radius)
    return centres, fits


def _moved_inward(
    surface: Surface, centres: np.ndarray, depth: np.ndarray, cfg: InsetCfg
) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (n, 3) moved inward until they lie `depth` [m], shape (n,), deep, and which of them do."""
    centres = centres.copy()
    left = np.arange(len(centres))
    for turn in range(cfg.max_moves):
        distance, gradient = surface.distance(centres[left])
        lacking = distance + depth[left]
        near = lacking > 0
        left = left[near]
        if not len(left):
            break
        centres[left] -= (lacking[near] + cfg.overshoot[2 * turn >= cfg.max_moves] * depth[left])[:, None] * gradient[
            near
        ]
    arrived = np.ones(len(centres), dtype=bool)
    arrived[left] = surface.signed_distance(centres[left]) <= -depth[left]
    return centres, arrived
