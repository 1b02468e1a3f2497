"""Steps to the minimum of a quadratic cost within bounds."""

from __future__ import annotations

import numpy as np


def step_within(normal: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the step x, shape (P,), to the minimum of slope.x + x.normal.x / 2 between bounds.

    Where the free step leads outside, it is a least-squares problem with bounds (Stark and Parker, "Bounded-variable
    least-squares", Computational Statistics 10, 1995): the others do not move as if it did.

    Args:
        normal: Curvature, positive definite, shape (P, P).
        slope: Gradient, shape (P,).
        low: Lower bounds, shape (P,).
        high: Upper bounds, above the lower ones, shape (P,).
    """
    step = -np.linalg.solve(normal, slope)
    if (step >= low).all() and (step <= high).all():
        return step
    from scipy.optimize import lsq_linear

    root = np.linalg.cholesky(normal)
    return lsq_linear(root.T, -np.linalg.solve(root, slope), (low, high), method="bvls").x
