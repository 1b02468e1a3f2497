"""Contacts of rigid bodies in floats: stiff springs, Coulomb friction, and a Runge-Kutta integrator of fixed step.

Normal forces are those of Hunt and Crossley (J. Appl. Mech. 42, 1975); friction is Coulomb's, rounded off below a
speed of 1 mm/s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import cos, hypot, sin, sqrt

import numpy as np

GRAVITY = 9.81
CREEP = 1e-3
"""Speed [m/s] below which friction falls off to zero."""

State = Sequence[float]


@dataclass(frozen=True)
class Path:
    """A motion at equal steps of time."""

    time: np.ndarray
    """Times [s], shape (steps,)."""
    state: np.ndarray
    """States, shape (steps, size)."""

    def __getitem__(self, column: int) -> np.ndarray:
        """Return one quantity over time."""
        return self.state[:, column]


def integrate(rate: Callable[[float, State], State], start: State, duration: float, step: float = 1e-4) -> Path:
    """Return the motion from a state, by the classical Runge-Kutta method."""
    count = round(duration / step)
    y = [float(v) for v in start]
    states = np.empty((count + 1, len(y)))
    states[0] = y
    half = step / 2
    for k in range(count):
        t = k * step
        a = rate(t, y)
        b = rate(t + half, [v + half * d for v, d in zip(y, a, strict=True)])
        c = rate(t + half, [v + half * d for v, d in zip(y, b, strict=True)])
        d = rate(t + step, [v + step * d for v, d in zip(y, c, strict=True)])
        y = [v + step / 6 * (p + 2 * q + 2 * r + s) for v, p, q, r, s in zip(y, a, b, c, d, strict=True)]
        states[k + 1] = y
    return Path(np.arange(count + 1) * step, states)


def normal_force(depth: float, rate: float, stiffness: float, damping: float) -> float:
    """Return the force [N] of a contact that is `depth` [m] deep and deepens by `rate` [m/s]; `damping` is in s/m."""
    if depth <= 0.0:
        return 0.0
    return max(0.0, stiffness * depth * (1.0 + damping * rate))


def friction_1d(speed: float, limit: float, creep: float = CREEP) -> float:
    """Return the friction [N, or N m with a creep in rad/s] against a speed."""
    return -limit * speed / sqrt(speed * speed + creep * creep)


def friction_2d(vx: float, vy: float, load: float, mu_x: float, mu_y: float) -> tuple[float, float]:
    """Return the friction [N] against a velocity, for a friction ellipse with axes x and y (maximum dissipation)."""
    gx, gy = mu_x * vx, mu_y * vy
    size = sqrt(gx * gx + gy * gy + (CREEP * mu_x) ** 2)
    return -load * mu_x * gx / size, -load * mu_y * gy / size


@dataclass(frozen=True)
class Slab:
    """A box on four feet at its corners, on a plane."""

    half_length: float
    half_width: float
    half_height: float

    def feet(self, angle: float) -> list[tuple[float, float]]:
        """Return where the feet are [m], from the centre, along the axes of the plane."""
        c, s = cos(angle), sin(angle)
        corners = [(i * self.half_length, j * self.half_width) for i in (-1, 1) for j in (-1, 1)]
        return [(c * x - s * y, s * x + c * y) for x, y in corners]

    def friction(
        self,
        angle: float,
        velocity: tuple[float, float, float],
        load: float,
        mu: Callable[[float, float], tuple[float, float]],
    ) -> tuple[float, float, float]:
        """Return force [N], [N] and torque [N m] of friction on the box, which does not tip.

        Args:
            angle: Heading of the box [rad].
            velocity: Velocity over the plane [m/s], [m/s] and turn [rad/s].
            load: Force of the box on the plane [N].
            mu: Coefficients along x and y at a foot, from its place [m] relative to the centre.
        """
        vx, vy, spin = velocity
        feet = self.feet(angle)
        unit = [friction_2d(vx - spin * y, vy + spin * x, 1.0, *mu(x, y)) for x, y in feet]
        inertia_x = sum(x * x for x, _ in feet)
        inertia_y = sum(y * y for _, y in feet)
        cross = sum(x * y for x, y in feet)
        det = inertia_x * inertia_y - cross * cross
        fx = load * sum(u[0] for u in unit) / 4
        fy = load * sum(u[1] for u in unit) / 4
        loads = [load / 4] * 4
        for _ in range(3):  # friction below the centre of mass shifts the load towards where the box slides
            mx, my = -self.half_height * fx, -self.half_height * fy
            p = (inertia_y * mx - cross * my) / det
            q = (inertia_x * my - cross * mx) / det
            loads = [max(0.0, load / 4 + p * x + q * y) for x, y in feet]
            fx = sum(n * u[0] for n, u in zip(loads, unit, strict=True))
            fy = sum(n * u[1] for n, u in zip(loads, unit, strict=True))
        torque = sum(n * (x * u[1] - y * u[0]) for n, u, (x, y) in zip(loads, unit, feet, strict=True))
        return fx, fy, torque


def string_pull(x: float, y: float, slack: float, stiffness: float) -> tuple[float, float]:
    """Return the pull [N] of a string from the origin that is taut beyond a distance `slack` [m]."""
    distance = hypot(x, y)
    if distance <= slack:
        return 0.0, 0.0
    pull = stiffness * (distance - slack)
    return -pull * x / distance, -pull * y / distance
