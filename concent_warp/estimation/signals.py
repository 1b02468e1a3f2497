"""What a smoothing method returns for one measured quantity: values and derivatives at any time, with their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Estimate:
    """A quantity with n components and its derivatives at T times."""

    value: np.ndarray
    """Shape (T, n)."""
    rate: np.ndarray
    """First derivative [1/s], shape (T, n)."""
    second: np.ndarray
    """Second derivative [1/s^2], shape (T, n)."""


@dataclass(frozen=True)
class OrientationEstimate:
    """The orientation of a body and its angular motion at T times."""

    quaternion: np.ndarray
    """Body to world, wxyz, of unit length, shape (T, 4)."""
    velocity: np.ndarray
    """Angular velocity in the body frame [rad/s], shape (T, 3)."""
    acceleration: np.ndarray
    """Angular acceleration in the body frame [rad/s^2], shape (T, 3)."""


class Readings(Protocol):
    """The readings of one quantity and their noise."""

    @property
    def time(self) -> np.ndarray:
        """Times of the valid readings [s], shape (R,)."""
        ...

    @property
    def value(self) -> np.ndarray:
        """Valid readings, shape (R, n); of an orientation quaternions wxyz, shape (R, 4)."""
        ...

    @property
    def std(self) -> float:
        """Noise of a component; of an orientation of a component of the rotation vector [rad]."""
        ...


class _SmoothedReadings(Readings, Protocol):
    """Readings that are smoothed by some method."""

    def covariance(self, time: np.ndarray) -> np.ndarray:
        """Return the covariance of value, rate and second derivative of a component at `time` (T,), (T, 3, 3).

        Of an orientation the component is one of the rotation vector [rad].
        """
        ...

    def scatter(self, time: np.ndarray) -> np.ndarray:
        """Return the root mean square distance of the readings around each time from the estimate, shape (T,)."""
        ...

    def scatter_of_both_sides(self, time: np.ndarray) -> np.ndarray:
        """Return the same, never of the readings on one side of each time alone, shape (T,)."""
        ...


class Signal(_SmoothedReadings, Protocol):
    """A quantity with n components that can be averaged, such as a position."""

    def estimate(self, time: np.ndarray) -> Estimate:
        """Return the estimate at `time` (T,) [s]."""
        ...

    def acceleration(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the second derivative from readings on both sides of each time, and its standard error.

        Shapes (T, n) and (T,). An impact between these readings shows as a large value.
        """
        ...

    def sample(self, time: np.ndarray, count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return value and rate at `time` (T,), followed by `count` samples of them under their joint error.

        Shapes (1 + count, T, n).
        """
        ...


class OrientationSignal(_SmoothedReadings, Protocol):
    """The orientation of a body."""

    def estimate(self, time: np.ndarray) -> OrientationEstimate:
        """Return the estimate at `time` (T,) [s]."""
        ...

    def sample(self, time: np.ndarray, count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return quaternion and angular velocity at `time` (T,), followed by `count` samples under their joint error.

        Shapes (1 + count, T, 4) and (1 + count, T, 3).
        """
        ...


@dataclass(frozen=True)
class MeasuredJoint:
    """A hinge or slide whose position was measured."""

    name: str
    unit: str
    """"rad" or "m"."""
    qpos: int
    """Address in qpos."""
    dof: int
    """Address in qvel."""
    position: Signal
    velocity: Readings | None
    """Readings of the velocity, if a sensor measured it."""


@dataclass(frozen=True)
class MeasuredBody:
    """A free body whose position was measured."""

    name: str
    body: int
    """Id of the body."""
    qpos: int
    """Address in qpos."""
    dof: int
    """Address in qvel."""
    position: Signal
    """Origin of the body frame [m], world frame."""
    orientation: OrientationSignal | None
    """None if only the position was measured."""


@dataclass(frozen=True)
class MeasuredBall:
    """A ball joint whose rotation was measured."""

    name: str
    qpos: int
    """Address in qpos."""
    dof: int
    """Address in qvel."""
    orientation: OrientationSignal
    """Rotation from the body on the joint to where it is in the reference pose, with the angular velocity in the frame
    of the body."""


def sample_values_and_rates(
    value: np.ndarray, rate: np.ndarray, covariance: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return values and rates (T, n), followed by `count` samples of them under their joint error.

    Args:
        value: Shape (T, n).
        rate: Shape (T, n).
        covariance: Of value and rate of a component, shape (T, 2, 2).
        count: Number of samples.
        rng: Source of random numbers.

    Returns:
        Two arrays of shape (1 + count, T, n).
    """
    both = np.stack([value, rate], axis=1)
    spread, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(spread, 0))[:, None]
    error = np.einsum("tij,ntjd->ntid", root, rng.standard_normal((count, *both.shape)))
    both = np.concatenate([both[None], both + error])
    return both[:, :, 0], both[:, :, 1]


def worst_scatter(scatter: Sequence[np.ndarray]) -> np.ndarray:
    """Return the largest scatter of some signals at T times, each over its median, shape (T,)."""
    each = np.array(scatter)
    return (each / np.maximum(np.median(each, axis=1, keepdims=True), 1e-12)).max(axis=0)
