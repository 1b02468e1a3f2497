"""Farthest point sampling, which spreads the spheres evenly over an object (paper, appendix E.1)."""

from __future__ import annotations

import numpy as np

from concent_warp.errors import ModelError


def farthest_point_sampling(points: np.ndarray, count: int, start: int = 0) -> np.ndarray:
    """Choose points that lie far from each other, in Euclidean space.

    Each choice is the point farthest from all chosen before (Gonzalez, "Clustering to minimize the maximum intercluster
    distance", 1985), so the largest gap is at most twice the best possible. The first n choices of a larger `count`
    are those of a smaller one. Ties go to the lower index: the result depends on nothing but the arguments.

    Args:
        points: candidates [m], shape (n, 3).
        count: how many to choose, at most n.
        start: index of the first choice.

    Returns:
        Indices into `points` in the order of choice, shape (count,).
    """
    if not 0 <= count <= len(points):
        raise ModelError("farthest point sampling: not enough points", expected=f"at least {count}", found=len(points))
    chosen = np.empty(count, dtype=np.intp)
    if count == 0:
        return chosen
    columns = np.ascontiguousarray(np.asarray(points, dtype=float).T)
    nearest = np.full(len(points), np.inf)
    squares = np.empty_like(nearest)
    offset = np.empty_like(nearest)
    chosen[0] = start
    for k in range(1, count):
        squares.fill(0)
        for column in columns:
            np.subtract(column, column[chosen[k - 1]], out=offset)
            np.multiply(offset, offset, out=offset)
            np.add(squares, offset, out=squares)
        np.minimum(nearest, squares, out=nearest)
        chosen[k] = np.argmax(nearest)
    return chosen
