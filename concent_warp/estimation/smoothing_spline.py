"""Smoothing splines: position, velocity and acceleration from noisy readings, with their covariance.

A quintic spline with even knots whose third differences are penalised (Eilers and Marx, Flexible smoothing with
B-splines and penalties, 1996), read as a Gaussian process: jerk is white noise, whose strength maximises the marginal
likelihood of the readings. The result is band-limited: an impact is spread over as many readings as the noise requires.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.spatial.transform import Rotation

from concent_warp.checks import Bounds, Count, Positive
from concent_warp.estimation.noise import channel_noise
from concent_warp.estimation.rotations import continuous_quaternions
from concent_warp.estimation.sensors import Kind
from concent_warp.estimation.signals import Estimate, OrientationEstimate, sample_values_and_rates

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from concent_warp.recording.recording import Channel

DEGREE = 5
"""Degree of the spline."""
PENALISED = 3
"""Derivative whose differences are penalised: the third, jerk."""


@dataclass(frozen=True)
class SmoothingSplineCfg:
    """Settings of smoothing splines."""

    min_readings: Count = 5
    """Fewest valid readings of a quantity."""
    max_knots: Count = 4000
    """Most intervals between knots; by default there are as many as between readings."""
    min_noise: Positive = 1e-5
    """Least noise assumed, as a share of the range of the readings: the error of a simulation's time step."""
    min_range: Positive = 1e-3
    """Least range of the readings in that, in their unit."""
    jerk_range: Annotated[tuple[float, float], Bounds(-30, 30, ascending=True)] = (-4.0, 6.0)
    """Decimal logarithms of the smallest and largest standard deviation of a coefficient's third difference tried, in
    standard deviations of the noise."""
    jerk_steps: Count = 3
    """Values tried in each decade of that range."""

    def readings(self, channel: Channel, kind: Kind) -> ChannelReadings | None:
        """Return the valid readings of a channel and their noise; None if they are too few."""
        valid = np.isfinite(channel.value).all(axis=1)
        if valid.sum() < self.min_readings:
            return None
        return ChannelReadings(channel.time[valid], channel.value[valid], self._noise(channel, kind))

    def signal(
        self, channel: Channel, velocity: Channel | None = None, kind: Kind = "other", offset: np.ndarray | None = None
    ) -> SplineSignal | None:
        """Return the signal of a channel; None if it has too few valid readings.

        Args:
            channel: Readings (R, n).
            velocity: Readings of the derivative (S, n), if a sensor measured it.
            kind: What the channel measures.
            offset: Subtracted from the readings, shape (R, n).
        """
        std = self._noise(channel, kind)
        rate = None if velocity is None else self.readings(velocity, kind)
        value = np.asarray(channel.value, dtype=float)
        value = value if offset is None else value - offset
        valid = np.isfinite(value).all(axis=1)
        spline = fit_spline(channel.time, value, std, rate, self)
        return (
            None if spline is None else SplineSignal(np.asarray(channel.time[valid], float), value[valid], std, spline)
        )

    def orientation(self, channel: Channel, turn: Rotation) -> SplineOrientation | None:
        """Return the orientation of a body; None if the channel has too few valid readings.

        Args:
            channel: Quaternions wxyz of a frame on the body, readings (R, 4).
            turn: Rotation from that frame to the body frame.
        """
        std = self._noise(channel, "orientation")
        valid = np.isfinite(channel.value).all(axis=1)
        if not valid.any():
            return None
        body = Rotation.from_quat(channel.value[valid], scalar_first=True) * turn.inv()
        quaternion = continuous_quaternions(body.as_quat(scalar_first=True))
        time = np.asarray(channel.time[valid], float)
        # A rotation by a small vector v changes a unit quaternion by v / 2.
        spline = fit_spline(time, quaternion, std / 2, cfg=self)
        return None if spline is None else SplineOrientation(time, quaternion, std, spline)

    def _noise(self, channel: Channel, kind: Kind) -> float:
        """Return the noise of a channel, never 0."""
        valid = channel.value[np.isfinite(channel.value).all(axis=1)]
        spread = float(np.ptp(valid, axis=0).max(initial=0)) if len(valid) else 0.0
        return float(np.fmax(channel_noise(channel, kind).std, self.min_noise * max(spread, self.min_range)))


@dataclass(frozen=True)
class ChannelReadings:
    """Valid readings of a channel."""

    time: np.ndarray
    """Shape (R,) [s]."""
    value: np.ndarray
    """Shape (R, n)."""
    std: float
    """Noise of a component."""


@dataclass(frozen=True)
class SmoothingSpline:
    """A spline of n components that share their noise."""

    knots: np.ndarray
    """Shape (k + 6,) [s]."""
    coefficient: np.ndarray
    """Shape (k, n)."""
    factor: np.ndarray
    """Banded Cholesky factor of the posterior precision of the coefficients of a component, shape (6, k)."""
    noise: float
    """Standard deviation of the noise that was assumed."""
    span: tuple[float, float]
    """First and last reading [s]."""

    def at(self, time: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the value (`order` 0), rate (1) or second derivative (2) at `time` (T,) [s], shape (T, n)."""
        return _rows(self.knots, time, order) @ self.coefficient

    def covariance(self, time: np.ndarray) -> np.ndarray:
        """Return the covariance of value, rate and second derivative of a component at `time` (T,), (T, 3, 3)."""
        basis = np.stack([_rows(self.knots, time, order).toarray() for order in range(3)], axis=1)
        flat = basis.reshape(-1, basis.shape[2])
        solved = cho_solve_banded((self.factor, False), flat.T).T.reshape(basis.shape)
        return np.einsum("tin,tjn->tij", basis, solved)

    def scatter(self, time: np.ndarray, clock: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Return the root mean square distance of readings within two knots of each time from the spline, shape (T,).

        Args:
            time: Shape (T,) [s].
            clock: Times of the readings [s], shape (R,).
            value: Readings, shape (R, n).
        """
        square = np.concatenate([[0.0], np.cumsum(((value - self.at(clock)) ** 2).mean(axis=1))])
        reach = 2 * (self.knots[1] - self.knots[0])
        low = np.minimum(np.searchsorted(clock, time - reach), len(clock) - 1)
        high = np.maximum(np.searchsorted(clock, time + reach, side="right"), low + 1)
        return np.sqrt(np.maximum(square[high] - square[low], 0) / (high - low))


@dataclass(frozen=True)
class SplineSignal:
    """A quantity whose readings can be averaged, such as a position."""

    time: np.ndarray
    """Times of the valid readings [s], shape (R,)."""
    value: np.ndarray
    """Shape (R, n)."""
    std: float
    """Noise of a component."""
    spline: SmoothingSpline

    def estimate(self, time: np.ndarray) -> Estimate:
        """Return the estimate at `time` (T,) [s]."""
        return Estimate(*(self.spline.at(time, order) for order in range(3)))

    def covariance(self, time: np.ndarray) -> np.ndarray:
        """Return the covariance of value, rate and second derivative of a component at `time` (T,), (T, 3, 3)."""
        return self.spline.covariance(time)

    def scatter(self, time: np.ndarray) -> np.ndarray:
        """Return the root mean square distance of the readings around each time from the spline, shape (T,)."""
        return self.spline.scatter(time, self.time, self.value)

    def scatter_of_both_sides(self, time: np.ndarray) -> np.ndarray:
        """Return the same: the readings are those on both sides, shape (T,)."""
        return self.scatter(time)

    def acceleration(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the second derivative at `time` (T,) and its standard error, shapes (T, n) and (T,)."""
        return self.spline.at(time, 2), np.sqrt(self.spline.covariance(time)[:, 2, 2])

    def sample(self, time: np.ndarray, count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return value and rate at `time` (T,), then `count` samples under their errors, (1 + count, T, n)."""
        return _sampled_spline(self.spline, time, count, rng)


@dataclass(frozen=True)
class SplineOrientation:
    """The orientation of a body; the spline is of the quaternion and normalised afterwards."""

    time: np.ndarray
    """Times of the valid readings [s], shape (R,)."""
    value: np.ndarray
    """Quaternions wxyz, body to world, with aligned signs, shape (R, 4)."""
    std: float
    """Noise of a component of the rotation vector [rad]."""
    spline: SmoothingSpline

    def estimate(self, time: np.ndarray) -> OrientationEstimate:
        """Return the estimate at `time` (T,) [s]."""
        value, rate, second = (self.spline.at(time, order) for order in range(3))
        quaternion = value / np.linalg.norm(value, axis=-1, keepdims=True)
        return OrientationEstimate(quaternion, angular_velocity(value, rate), angular_acceleration(value, rate, second))

    def covariance(self, time: np.ndarray) -> np.ndarray:
        """Return the covariance of a component of the rotation vector and its derivatives at `time` (T,), (T, 3, 3)."""
        return 4 * self.spline.covariance(time)

    def scatter(self, time: np.ndarray) -> np.ndarray:
        """Return the root mean square distance of the readings around each time from the spline [rad], shape (T,)."""
        return 2 * self.spline.scatter(time, self.time, self.value)

    def scatter_of_both_sides(self, time: np.ndarray) -> np.ndarray:
        """Return the same: the readings are those on both sides, shape (T,)."""
        return self.scatter(time)

    def sample(self, time: np.ndarray, count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return quaternion (1 + count, T, 4) and angular velocity (1 + count, T, 3) at `time` (T,), then samples."""
        quaternion, rate = _sampled_spline(self.spline, time, count, rng)
        velocity = angular_velocity(quaternion, rate)
        return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), velocity


def angular_velocity(quaternion: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return angular velocities in the body frame [rad/s], (..., 3), of quaternions wxyz (..., 4) and their rates.

    omega = 2 conj(q) dq / |q|^2, vector part.
    """
    return 2 * _conjugate_product(quaternion, rate) / (quaternion**2).sum(axis=-1, keepdims=True)


def angular_acceleration(quaternion: np.ndarray, rate: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return angular accelerations in the body frame [rad/s^2], (..., 3), of quaternions and their two derivatives.

    The derivative of omega = 2 conj(q) dq / |q|^2; conj(dq) dq has no vector part.
    """
    square = (quaternion**2).sum(axis=-1, keepdims=True)
    growth = 2 * (quaternion * rate).sum(axis=-1, keepdims=True) / square
    return 2 * _conjugate_product(quaternion, second) / square - growth * angular_velocity(quaternion, rate)


def _conjugate_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the vector part of conj(first) second, shape (..., 3), of quaternions wxyz (..., 4)."""
    w, v = first[..., :1], first[..., 1:]
    return w * second[..., 1:] - second[..., :1] * v - np.cross(v, second[..., 1:])


def _sampled_spline(
    spline: SmoothingSpline, time: np.ndarray, count: int, rng: np.random.Generator | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return value and rate at `time` (T,), then `count` samples under their errors, (1 + count, T, n)."""
    value, rate = spline.at(time), spline.at(time, 1)
    if rng is None or not count:
        return value[None], rate[None]
    return sample_values_and_rates(value, rate, spline.covariance(time)[:, :2, :2], count, rng)


def fit_spline(
    time: np.ndarray,
    value: np.ndarray,
    noise: float,
    velocity: ChannelReadings | None = None,
    cfg: SmoothingSplineCfg | None = None,
) -> SmoothingSpline | None:
    """Fit a smoothing spline.

    Args:
        time: Times of the readings [s], shape (R,), increasing.
        value: Readings, shape (R, n); rows with NaN are left out.
        noise: Standard deviation of a component.
        velocity: Readings of the derivative, if a sensor measured it.
        cfg: Settings.

    Returns:
        The spline, or None if there are fewer than `cfg.min_readings` readings.
    """
    cfg = cfg or SmoothingSplineCfg()
    valid = np.isfinite(value).all(axis=1)
    time, value = np.asarray(time, float)[valid], np.asarray(value, float)[valid]
    if len(time) < cfg.min_readings:
        return None
    knots = _even_knots(time, cfg.max_knots)
    count = len(knots) - DEGREE - 1
    design = _rows(knots, time, 0)
    normal = (design.T @ design) / noise**2
    right = design.T @ value / noise**2
    square = float((value**2).sum()) / noise**2
    if velocity is not None:
        clock, speed, std = velocity.time, velocity.value, velocity.std
        kept = np.isfinite(speed).all(axis=1) & (clock >= time[0]) & (clock <= time[-1])
        rate = _rows(knots, clock[kept], 1)
        normal = normal + (rate.T @ rate) / std**2
        right = right + rate.T @ speed[kept] / std**2
        square += float((speed[kept] ** 2).sum()) / std**2
    data = _upper_bands(normal)
    penalty = _penalty_bands(count)
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    low, high = cfg.jerk_range
    for scale in 10.0 ** np.arange(low, high + 0.01, 1 / cfg.jerk_steps) * noise:
        factor = cholesky_banded(data + penalty / scale**2 + _ridge(data, scale), lower=False)
        coefficient = cho_solve_banded((factor, False), right)
        evidence = float((right * coefficient).sum() - square)
        evidence -= value.shape[1] * (2 * np.log(factor[-1]).sum() + 2 * (count - PENALISED) * np.log(scale))
        if best is None or evidence > best[0]:
            best = evidence, coefficient, factor
    assert best is not None
    return SmoothingSpline(knots, best[1], best[2], noise, (float(time[0]), float(time[-1])))


def _even_knots(time: np.ndarray, most: int) -> np.ndarray:
    """Return even knots about as far apart as the readings, with 5 beyond either end, shape (k + 6,)."""
    length = time[-1] - time[0]
    pieces = int(np.clip(round(length / float(np.median(np.diff(time)))), 1, most))
    step = length / pieces
    return time[0] + step * np.arange(-DEGREE, pieces + DEGREE + 1)


def _rows(knots: np.ndarray, time: np.ndarray, order: int) -> csr_array:
    """Return the matrix that takes coefficients to the derivative of some order at `time` (T,), sparse, (T, n)."""
    from scipy.sparse import csr_array, diags_array

    inside = np.clip(np.asarray(time, float), knots[DEGREE], knots[-DEGREE - 1])
    trimmed = knots[order : len(knots) - order]
    matrix = csr_array(BSpline.design_matrix(inside, trimmed, DEGREE - order))
    step = knots[1] - knots[0]
    for left in range(order):
        size = len(knots) - DEGREE - 1 - (order - 1 - left)
        difference = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(size - 1, size)) / step  # pyright: ignore
        matrix = csr_array(matrix @ difference)
    return matrix


def _upper_bands(matrix: csr_array) -> np.ndarray:
    """Return the upper bands of a symmetric banded matrix as `scipy.linalg` takes them, shape (6, n)."""
    count = int(matrix.diagonal().size)
    bands = np.zeros((DEGREE + 1, count))
    for offset in range(min(DEGREE + 1, count)):
        bands[DEGREE - offset, offset:] = matrix.diagonal(offset)
    return bands


def _penalty_bands(count: int) -> np.ndarray:
    """Return the upper bands of D'D, D the third differences of `count` coefficients, shape (6, count)."""
    from scipy.sparse import csr_array, diags_array

    third = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - PENALISED, count))  # pyright: ignore
    return _upper_bands(csr_array(third.T @ third))


def _ridge(data: np.ndarray, scale: float) -> np.ndarray:
    """Return bands that keep coefficients definite where a gap leaves them to the penalty alone."""
    bands = np.zeros_like(data)
    bands[-1] = 1e-10 * max(float(data[-1].max()), 1 / scale**2)
    return bands
