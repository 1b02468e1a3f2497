"""Split a body's mass over its spheres so that mass, centre of mass and inertia are kept, as evenly as possible.

The masses solve the quadratic programme: minimise ``sum (m_i - M/n)^2`` subject to ``m >= 0`` and ten linear equations
(mass, three for the centre of mass, six for the inertia tensor, to which a solid sphere contributes its own
``2/5 m r^2`` and ``m (|d|^2 I - d d^T)`` by the parallel-axis theorem). Its dual has ten variables and is solved by a
semi-smooth Newton method.

Spheres that lie near the surface may be unable to reach the inertia of a solid body: every one of them is farther from
the centre than the body's mass is. Then the nearest inertia is taken and the error is reported. Nothing is lost in a
simulation: a body keeps the explicit inertia of its scene, whatever its spheres weigh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from concent_warp.checks import Bounds, OpenShare, Positive
from concent_warp.errors import ModelError


@dataclass(frozen=True)
class MassSplitCfg:
    """Settings of the quadratic programme."""

    tolerance: Positive = 1e-9
    """Residual of the scaled equations below which they hold [-]: above the rounding of float64."""
    softness: Positive = 1e-6
    """Inverse weight of equations that need only hold nearly [-]: small against 1, large against rounding."""
    max_steps: Annotated[int, Bounds(1, 100_000)] = 200
    """Most Newton steps [-]; a few dozen are usual."""
    min_step_length: Positive = 1e-8
    """Length of a damped Newton step below which the equations count as without solution [-]."""
    sufficient_decrease: OpenShare = 1e-4
    """Share of the linearly predicted decrease that a step must reach [-] (Armijo; Nocedal and Wright, "Numerical
    Optimization", section 3.1)."""


@dataclass(frozen=True)
class MassSplit:
    """Masses and how well they match the body."""

    mass: np.ndarray
    """Mass of each sphere [kg], shape (n,), none negative; they sum to the body's mass."""
    com_error: float
    """Distance between the spheres' centre of mass and the body's [m]."""
    inertia_error: float
    """Frobenius norm of the difference of the inertia tensors, relative to the body's [-]."""


def split_mass(
    positions: np.ndarray,
    radii: np.ndarray,
    mass: float,
    com: np.ndarray,
    inertia: np.ndarray,
    cfg: MassSplitCfg | None = None,
) -> MassSplit:
    """Split a body's mass over solid spheres.

    Args:
        positions: sphere centres, body frame [m], shape (n, 3).
        radii: sphere radii [m], shape (n,).
        mass: mass of the body [kg].
        com: its centre of mass, body frame [m], shape (3,).
        inertia: its inertia tensor about the centre of mass, axes of the body frame [kg m^2], shape (3, 3).
        cfg: settings.

    Returns:
        Masses that keep mass, centre of mass and inertia where that is possible; else mass and centre of mass, with the
        nearest inertia; else, where the centre of mass is outside the spheres' convex hull, the mass alone.
    """
    count = len(radii)
    if count == 0 or not np.isfinite(mass) or mass < 0:
        raise ModelError("the mass cannot be split", expected="a mass >= 0 and a sphere", found=f"{mass} kg, {count}")
    if mass == 0:
        return MassSplit(np.zeros(count), 0.0, 0.0)
    away = positions - com
    length = float(np.sqrt(np.mean(np.sum(away**2, axis=1) + radii**2)))
    second = _inertia_rows(away / length, radii / length)
    target = _tensor_entries(inertia) / (mass * length**2)
    rows = np.vstack([np.ones(count), away.T / length, second])
    right = np.concatenate([[1.0, 0, 0, 0], target])
    share = np.full(count, 1 / count)
    for exact in (10, 4, 1):
        weights = _nearest_weights(rows, right, share, exact, cfg or MassSplitCfg())
        if weights is not None:
            break
    else:
        weights = share
    weights = weights / weights.sum()
    com_error = float(np.linalg.norm(weights @ away))
    scale = float(np.linalg.norm(FROBENIUS_WEIGHTS @ target))
    inertia_error = float(np.linalg.norm(FROBENIUS_WEIGHTS @ (second @ weights - target))) / scale if scale > 0 else 0.0
    return MassSplit(mass * weights, com_error, inertia_error)


FROBENIUS_WEIGHTS = np.diag(np.sqrt([1.0, 1, 1, 2, 2, 2]))
"""Weights under which the norm of the six entries of a symmetric tensor is its Frobenius norm."""


def _tensor_entries(tensor: np.ndarray) -> np.ndarray:
    """Return xx, yy, zz, xy, xz, yz of symmetric tensors, shape (..., 3, 3) -> (..., 6)."""
    return tensor[..., [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _inertia_rows(away: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the inertia of spheres of unit mass about the origin, shape (6, n), from centres (n, 3) and radii (n,)."""
    own = 0.4 * radii**2 + np.sum(away**2, axis=1)
    tensors = own[:, None, None] * np.eye(3) - away[:, :, None] * away[:, None, :]
    return _tensor_entries(tensors).T


def _nearest_weights(
    rows: np.ndarray, right: np.ndarray, share: np.ndarray, exact: int, cfg: MassSplitCfg
) -> np.ndarray | None:
    """Minimise ``|w - share|^2 n / 2`` over ``w >= 0`` with the first `exact` equations kept and the rest near.

    The rest enter as a heavy quadratic penalty. Semi-smooth Newton on the dual: ``w = max(0, share + A^T y / n)``.

    Args:
        rows: equations, shape (m, n).
        right: right-hand side, shape (m,).
        share: wanted weights, shape (n,).
        exact: number of leading equations that must hold.
        cfg: settings.

    Returns:
        Weights, shape (n,), or None where the exact equations cannot hold.
    """
    count = len(share)
    soft = np.zeros(len(right))
    soft[exact:] = cfg.softness
    # Equations that depend on others (all centres in a plane, say) make the Newton matrix singular.
    tiny = 1e-13 * np.eye(len(right))

    def dual(y: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        weights = np.maximum(0, share + rows.T @ y / count)
        value = 0.5 * count * float(weights @ weights) + 0.5 * float(soft @ y**2) - float(right @ y)
        return value, weights, rows @ weights + soft * y - right

    y = np.zeros(len(right))
    value, weights, gradient = dual(y)
    for _ in range(cfg.max_steps):
        if np.abs(gradient).max() < cfg.tolerance:
            return weights
        active = rows[:, weights > 0]
        curvature = active @ active.T / count + np.diag(soft)
        step = -np.linalg.solve(curvature + tiny * max(1.0, float(np.trace(curvature))), gradient)
        slope = float(gradient @ step)
        length = 1.0
        while length > cfg.min_step_length:
            trial, trial_weights, trial_gradient = dual(y + length * step)
            if trial <= value + cfg.sufficient_decrease * length * slope + 1e-15 * abs(value):
                break
            length /= 2
        else:
            return None
        y, value, weights, gradient = y + length * step, trial, trial_weights, trial_gradient
    return weights if np.abs(gradient).max() < cfg.tolerance else None
