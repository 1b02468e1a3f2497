"""Solids in the body frame: signed distance with its gradient, and points sampled uniformly from the surface.

Box, sphere, capsule, cylinder and ellipsoid are exact, inside and outside. Signed distances are negative inside.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

Distances = tuple[np.ndarray, np.ndarray]
"""Signed distance [m], shape (n,), and its gradient (outward normal of the nearest surface point), shape (n, 3)."""


class Solid(ABC):
    """A closed body with signed distances."""

    @property
    @abstractmethod
    def area(self) -> float:
        """Area of the surface [m^2]."""

    @abstractmethod
    def distance(self, points: np.ndarray) -> Distances:
        """Return signed distances [m] and gradients at `points` [m], shape (n, 3)."""

    @abstractmethod
    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return points [m] sampled uniformly from the surface, with outward normals, each of shape (count, 3)."""


@dataclass(frozen=True)
class PlacedSolid(Solid):
    """A solid moved into the body frame."""

    solid: Solid
    rotation: np.ndarray
    """Rotation matrix from the solid's frame to the body's, shape (3, 3)."""
    position: np.ndarray
    """Origin of the solid's frame in the body frame [m], shape (3,)."""

    @property
    def area(self) -> float:
        """Area of the surface [m^2]."""
        return self.solid.area

    def distance(self, points: np.ndarray) -> Distances:
        """See `Solid.distance`."""
        distance, gradient = self.solid.distance((points - self.position) @ self.rotation)
        return distance, gradient @ self.rotation.T

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """See `Solid.sample`."""
        points, normals = self.solid.sample(count, rng)
        return points @ self.rotation.T + self.position, normals @ self.rotation.T


@dataclass(frozen=True)
class Box(Solid):
    """Box about the origin."""

    half: np.ndarray
    """Half sizes [m], shape (3,)."""

    @property
    def area(self) -> float:
        """Area of the surface [m^2]."""
        x, y, z = self.half
        return float(8 * (x * y + y * z + z * x))

    def distance(self, points: np.ndarray) -> Distances:
        """See `Solid.distance`."""
        sign = np.where(points < 0, -1.0, 1.0)
        beyond = np.abs(points) - self.half
        axis = np.argmax(beyond, axis=1)
        rows = np.arange(len(points))
        distance = beyond[rows, axis]
        gradient = np.zeros_like(beyond)
        gradient[rows, axis] = 1.0
        outside = distance > 0
        away = np.maximum(beyond[outside], 0)
        distance[outside] = np.linalg.norm(away, axis=1)
        gradient[outside] = away / distance[outside, None]
        return distance, gradient * sign

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """See `Solid.sample`."""
        x, y, z = self.half
        faces = np.array([y * z, z * x, x * y])
        axis = rng.choice(3, size=count, p=faces / faces.sum())
        side = rng.choice([-1.0, 1.0], size=count)
        points = rng.uniform(-1, 1, (count, 3)) * self.half
        normals = np.zeros((count, 3))
        rows = np.arange(count)
        points[rows, axis] = side * self.half[axis]
        normals[rows, axis] = side
        return points, normals


@dataclass(frozen=True)
class Capsule(Solid):
    """Capsule along z about the origin; a sphere where `half_length` is 0."""

    radius: float
    """Radius [m]."""
    half_length: float = 0.0
    """Half the length of the axis [m]."""

    @property
    def area(self) -> float:
        """Area of the surface [m^2]."""
        return 4 * np.pi * self.radius * (self.radius + self.half_length)

    def distance(self, points: np.ndarray) -> Distances:
        """See `Solid.distance`."""
        away = points.astype(float)
        away[:, 2] -= np.clip(away[:, 2], -self.half_length, self.half_length)
        length = np.linalg.norm(away, axis=1)
        return length - self.radius, normalised(away, length)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """See `Solid.sample`."""
        normals = _directions(count, rng)
        points = self.radius * normals
        points[:, 2] += np.where(normals[:, 2] < 0, -1, 1) * self.half_length
        side = rng.random(count) < self.half_length / (self.half_length + self.radius)
        ring = _circle(count, rng)
        normals[side] = ring[side]
        points[side] = self.radius * ring[side]
        points[side, 2] = rng.uniform(-1, 1, count)[side] * self.half_length
        return points, normals


@dataclass(frozen=True)
class Cylinder(Solid):
    """Cylinder along z about the origin."""

    radius: float
    """Radius [m]."""
    half_length: float
    """Half the length [m]."""

    @property
    def area(self) -> float:
        """Area of the surface [m^2]."""
        return 2 * np.pi * self.radius * (self.radius + 2 * self.half_length)

    def distance(self, points: np.ndarray) -> Distances:
        """See `Solid.distance`."""
        flat = points.astype(float)
        flat[:, 2] = 0
        across = np.linalg.norm(flat, axis=1)
        radial = normalised(flat, across, fallback=(1.0, 0.0, 0.0))
        axial = np.zeros_like(flat)
        axial[:, 2] = np.where(points[:, 2] < 0, -1, 1)
        side, cap = across - self.radius, np.abs(points[:, 2]) - self.half_length
        distance = np.maximum(side, cap)
        gradient = np.where((side > cap)[:, None], radial, axial)
        rim = (side > 0) & (cap > 0)
        distance[rim] = np.hypot(side[rim], cap[rim])
        corner = side[:, None] * radial + cap[:, None] * axial
        gradient[rim] = corner[rim] / distance[rim, None]
        return distance, gradient

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """See `Solid.sample`."""
        normals = _circle(count, rng)
        points = self.radius * normals
        points[:, 2] = rng.uniform(-1, 1, count) * self.half_length
        end = rng.random(count) < self.radius / (self.radius + 2 * self.half_length)
        up = rng.choice([-1.0, 1.0], size=count)
        inward = np.sqrt(rng.random(count))
        points[end, :2] *= inward[end, None]
        points[end, 2] = up[end] * self.half_length
        normals[end] = 0
        normals[end, 2] = up[end]
        return points, normals


@dataclass(frozen=True)
class Ellipsoid(Solid):
    """Ellipsoid about the origin."""

    half: np.ndarray
    """Semi-axes [m], shape (3,)."""

    @property
    def area(self) -> float:
        """Area of the surface [m^2], by quadrature over the unit sphere (relative error below 1e-3)."""
        height, angle = np.meshgrid((np.arange(400) + 0.5) / 200 - 1, (np.arange(400) + 0.5) * np.pi / 200)
        ring = np.sqrt(1 - height**2)
        stretch = self.stretch(np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1).reshape(-1, 3))
        return float(4 * np.pi * stretch.mean())

    def stretch(self, direction: np.ndarray) -> np.ndarray:
        """Return the area of the ellipsoid per area of the unit sphere [m^2] at unit vectors, shape (n, 3) -> (n,)."""
        return float(np.prod(self.half)) * np.linalg.norm(direction / self.half, axis=1)

    def distance(self, points: np.ndarray) -> Distances:
        """See `Solid.distance`.

        The nearest point is x_i = a_i^2 y_i / (t + a_i^2), with t the root above -a_min^2 of
        sum((a_i y_i / (t + a_i^2))^2) = 1, by bisection (Eberly, "Distance from a point to an ellipse, an ellipsoid, or
        a hyperellipsoid", section 3).
        """
        rows = np.arange(len(points))
        folded = np.abs(points)
        square = self.half**2
        thin = int(np.argmin(self.half))
        low = np.full(len(points), -square[thin])
        high = np.linalg.norm(folded * self.half, axis=1)
        for _ in range(80):
            middle = (low + high) / 2
            value = np.sum((self.half * folded / np.maximum(middle[:, None] + square, 1e-300)) ** 2, axis=1)
            beyond = value > 1
            low, high = np.where(beyond, middle, low), np.where(beyond, high, middle)
        nearest = square * folded / np.maximum(high[:, None] + square, 1e-300)
        others = [i for i in range(3) if i != thin]
        left = 1 - np.sum((nearest[:, others] / self.half[others]) ** 2, axis=1)
        shallow = folded[rows, thin] < 1e-9 * self.half[thin]
        nearest[shallow, thin] = (self.half[thin] * np.sqrt(np.maximum(left, 0)))[shallow]
        nearest *= np.where(points < 0, -1.0, 1.0)
        inside = np.sum((points / self.half) ** 2, axis=1) < 1
        gradient = nearest / square
        gradient = normalised(gradient, np.linalg.norm(gradient, axis=1))
        return np.where(inside, -1, 1) * np.linalg.norm(points - nearest, axis=1), gradient

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """See `Solid.sample`."""
        most = float(np.prod(self.half)) / self.half.min()
        kept: list[np.ndarray] = []
        while sum(map(len, kept)) < count:
            direction = _directions(2 * count, rng)
            kept.append(direction[rng.random(2 * count) * most < self.stretch(direction)])
        direction = np.concatenate(kept)[:count]
        normals = direction / self.half
        return direction * self.half, normalised(normals, np.linalg.norm(normals, axis=1))


def normalised(
    vectors: np.ndarray, length: np.ndarray, fallback: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> np.ndarray:
    """Divide vectors (n, 3) by their lengths (n,); a vector without length becomes `fallback`."""
    short = length < 1e-300
    divided = vectors / np.where(short, 1.0, length)[:, None]
    divided[short] = fallback
    return divided


def _directions(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors sampled uniformly from the sphere, shape (count, 3)."""
    vectors = rng.standard_normal((count, 3))
    return normalised(vectors, np.linalg.norm(vectors, axis=1))


def _circle(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors sampled uniformly from the circle in the xy plane, shape (count, 3)."""
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
