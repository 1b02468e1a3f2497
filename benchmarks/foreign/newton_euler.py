"""Motion of a chain of links on hinges by recursive Newton-Euler: Luh, Walker, Paul, J. Dyn. Sys. Meas. Control 102(2).

Each link has a frame at its hinge, along the frame of the link before where the hinge reads 0.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def _cross(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Write the cross product of two vectors."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _turned(axis: np.ndarray, angle: float, v: np.ndarray, out: np.ndarray) -> None:
    """Write a vector that is turned about an axis of unit length, by Rodrigues' formula."""
    c, s = np.cos(angle), np.sin(angle)
    _cross(axis, v, out)
    along = (axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2]) * (1 - c)
    for i in range(3):
        out[i] = c * v[i] + s * out[i] + along * axis[i]


@njit(cache=True)
def torques(
    axes: np.ndarray,
    places: np.ndarray,
    masses: np.ndarray,
    centres: np.ndarray,
    inertias: np.ndarray,
    gravity: float,
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write the torques at the hinges that a motion takes, without rotors and friction.

    Args:
        axes: Of the hinges in the frames of their links, of unit length, shape (links, 3).
        places: Of the hinges in the frames of the links before [m], shape (links, 3).
        masses: Of the links [kg], shape (links,).
        centres: Of mass, in the frames of the links [m], shape (links, 3).
        inertias: About the centres of mass, in the frames of the links [kg m^2], shape (links, 3, 3).
        gravity: Down along the world's z axis [m/s^2].
        q: Angles [rad], shape (links,).
        v: Speeds [rad/s], shape (links,).
        a: Accelerations [rad/s^2], shape (links,).
        out: Torques [N m], shape (links,).
    """
    n = q.size
    force, moment = np.zeros((n, 3)), np.zeros((n, 3))
    turn, rise, speed = np.zeros(3), np.zeros(3), np.zeros(3)
    speed[2] = gravity
    w1, w2, w3 = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(n):
        # Acceleration of the hinge, in the frame of the link before; then all in the frame of this link.
        _cross(rise, places[k], w1)
        _cross(turn, places[k], w2)
        _cross(turn, w2, w3)
        for i in range(3):
            speed[i] += w1[i] + w3[i]
        _turned(axes[k], -q[k], speed, w1)
        speed[:] = w1
        _turned(axes[k], -q[k], turn, w1)
        _turned(axes[k], -q[k], rise, w2)
        _cross(w1, axes[k], w3)
        for i in range(3):
            turn[i] = w1[i] + axes[k, i] * v[k]
            rise[i] = w2[i] + axes[k, i] * a[k] + w3[i] * v[k]
        _cross(rise, centres[k], w1)
        _cross(turn, centres[k], w2)
        _cross(turn, w2, w3)
        for i in range(3):
            force[k, i] = masses[k] * (speed[i] + w1[i] + w3[i])
            w2[i] = 0.0
            for j in range(3):
                w2[i] += inertias[k, i, j] * turn[j]
                moment[k, i] += inertias[k, i, j] * rise[j]
        _cross(turn, w2, w1)
        _cross(centres[k], force[k], w2)
        for i in range(3):
            moment[k, i] += w1[i] + w2[i]
    for k in range(n - 1, -1, -1):
        out[k] = axes[k, 0] * moment[k, 0] + axes[k, 1] * moment[k, 1] + axes[k, 2] * moment[k, 2]
        if k > 0:
            _turned(axes[k], q[k], force[k], w1)
            _turned(axes[k], q[k], moment[k], w2)
            _cross(places[k], w1, w3)
            for i in range(3):
                force[k - 1, i] += w1[i]
                moment[k - 1, i] += w2[i] + w3[i]


@njit(cache=True)
def accelerations(
    axes: np.ndarray,
    places: np.ndarray,
    masses: np.ndarray,
    centres: np.ndarray,
    inertias: np.ndarray,
    gravity: float,
    rotors: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    driven: np.ndarray,
) -> np.ndarray:
    """Return the accelerations of the hinges [rad/s^2], shape (links,), as Walker and Orin find them.

    Args as of `torques`, and:
        rotors: Inertias of the motors about their hinges [kg m^2], shape (links,).
        driven: Torques of drives and friction [N m], shape (links,).
    """
    n = q.size
    still, zero, column = np.zeros(n), np.zeros(n), np.zeros(n)
    torques(axes, places, masses, centres, inertias, gravity, q, v, zero, column)
    wanted = driven - column
    inertia = np.zeros((n, n))
    unit = np.zeros(n)
    for k in range(n):
        unit[:] = 0.0
        unit[k] = 1.0
        torques(axes, places, masses, centres, inertias, 0.0, q, still, unit, column)
        inertia[:, k] = column
        inertia[k, k] += rotors[k]
    return np.linalg.solve(inertia, wanted)
