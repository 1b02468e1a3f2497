"""Small spheres along the edges of a body, which larger spheres round off.

A block of spheres of 4 mm slides over a rim that catches the real one. The gap between a surface point and its inset
sphere tells where that happens: at a right-angled edge it is (sqrt(2) - 1) of the radius, on a face 0.
"""

from __future__ import annotations

import numpy as np

from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.inset import InsetCfg, inset
from concent_warp.scene.spheres.sampling import farthest_point_sampling


def edge_spheres(
    surface: Surface,
    points: np.ndarray,
    inset_spheres: tuple[np.ndarray, np.ndarray],
    count: int,
    radius: float,
    *,
    min_radius: float = 0.0,
    cfg: InsetCfg | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return spheres along the edges of a body, within it.

    Args:
        surface: Surface of the body.
        points: Points on it [m], body frame, shape (n, 3).
        inset_spheres: Centres [m], shape (n, 3), and radii [m], shape (n,), of the larger spheres inset at the points.
        count: Largest number of spheres.
        radius: Their radius [m], smaller where the body is too thin.
        min_radius: Radius from which on such a smaller one is taken [m].
        cfg: How centres are moved into the body.

    Returns:
        Centres [m], shape (k, 3), and radii [m], shape (k,), of k <= count spheres.
    """
    centres, radii = inset_spheres
    gap = np.linalg.norm(points - centres, axis=1) - radii
    near = points[gap > (np.sqrt(2) - 1) * radius]
    if not count or not len(near):
        return np.empty((0, 3)), np.empty(0)
    inner, fits = inset(surface, near, radius, cfg)
    roomy = fits > min_radius
    inner, fits = inner[roomy], fits[roomy]
    chosen = farthest_point_sampling(inner, min(count, len(inner)))
    return inner[chosen], fits[chosen]
