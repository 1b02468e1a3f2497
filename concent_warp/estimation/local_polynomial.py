"""Values and derivatives of a measured quantity: a polynomial fitted to the few readings around each time.

Least squares over a short interval (Savitzky and Golay, Smoothing and differentiation of data by simplified least
squares procedures, 1964), at the readings' own times. A velocity sensor replaces the derivative of the positions where
its standard error is smaller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.checks import Count, PositiveDuration
from concent_warp.estimation.rotations import continuous_quaternions
from concent_warp.estimation.sensors import Kind
from concent_warp.estimation.signals import Estimate, OrientationEstimate, sample_values_and_rates
from concent_warp.recording.recording import Channel


@dataclass(frozen=True)
class LocalPolynomialCfg:
    """Settings of local polynomials."""

    half_width: PositiveDuration = 0.02
    """Readings within this time before and after a time count in its fit [s]."""
    min_neighbours: int = 2
    """Readings before and after a time that count even if they are farther away than `half_width`; a quantity needs
    twice as many readings altogether."""
    one_sided_ratio: float = 0.5
    """Readings on one side of a time alone are used where that reduces the standard error of the rate to less than this
    share: a jump of the velocity, as in an impact, lies on the other side."""
    precision_probes: Count = 40
    """Number of times at which the standard error of a velocity sensor is compared with that of the positions."""

    def signal(self, channel: Channel, velocity: Channel | None = None, kind: Kind = "other") -> LocalPolynomial | None:
        """Return the signal of a channel; None if it has too few valid readings.

        Args:
            channel: Readings (R, n).
            velocity: Readings of the derivative (S, n), if a sensor measured it.
            kind: Not needed: the errors are those of the fits.
        """
        del kind
        position = self._valid(channel, degree=2)
        return None if position is None else self._with_velocity(position, velocity)

    def readings(self, channel: Channel, kind: Kind = "other") -> LocalPolynomial | None:
        """Return the readings of a rate, smoothed by straight lines; None if too few are valid.

        Args:
            channel: Readings (R, n).
            kind: Not needed: the errors are those of the fits.
        """
        del kind
        return self._valid(channel, degree=1)

    def orientation(self, channel: Channel, velocity: Channel | None = None) -> LocalPolynomialOrientation | None:
        """Return the signal of a channel of quaternions wxyz; None if it has too few valid readings.

        Args:
            channel: Orientation of a body, readings (R, 4).
            velocity: Angular velocity in the body frame [rad/s], readings (S, 3), if a sensor measured it.
        """
        valid = np.isfinite(channel.value).all(axis=1)
        if valid.sum() < 2 * self.min_neighbours:
            return None
        rotation = Rotation.from_quat(channel.value[valid], scalar_first=True)
        signal = LocalPolynomialOrientation(self, channel.time[valid], rotation)
        rate = None if velocity is None else self.readings(velocity)
        if rate is None or not self._is_more_precise(rate, signal):
            return signal
        return LocalPolynomialOrientation(self, signal.time, rotation, rate)

    def _with_velocity(self, position: LocalPolynomial, velocity: Channel | None) -> LocalPolynomial:
        """Return the signal with its velocity sensor if that is more precise than the derivative of the positions."""
        rate = None if velocity is None else self.readings(velocity)
        if rate is None or not self._is_more_precise(rate, position):
            return position
        return LocalPolynomial(self, position.time, position.value, position.degree, rate)

    def _valid(self, channel: Channel, degree: int) -> LocalPolynomial | None:
        """Return the valid readings of a channel as a signal, None if they are too few."""
        valid = np.isfinite(channel.value).all(axis=1)
        if valid.sum() < 2 * self.min_neighbours:
            return None
        return LocalPolynomial(self, channel.time[valid], channel.value[valid], degree)

    def _is_more_precise(self, rate: LocalPolynomial, signal: LocalPolynomial | LocalPolynomialOrientation) -> bool:
        """Return whether a velocity sensor has a smaller median standard error than the derivative of a signal."""
        return self._median_error(rate, 0) < self._median_error(signal, 1)

    def _median_error(self, signal: LocalPolynomial | LocalPolynomialOrientation, order: int) -> float:
        """Return the median standard error of a signal's value (`order` 0) or rate (1)."""
        rows = np.unique(np.linspace(0, len(signal.time) - 1, self.precision_probes).astype(int))
        return float(np.median([fit.errors[order] for fit in signal.fits(signal.time[rows])]))


@dataclass(frozen=True)
class LocalFit:
    """A polynomial about one time."""

    derivatives: np.ndarray
    """Value, rate and second derivative, shape (3, n); zero beyond the degree of the polynomial."""
    errors: tuple[float, float, float]
    """Standard errors of a component of these, from the scatter about the polynomial."""
    covariance: np.ndarray
    """Covariance of these for a component, shape (3, 3)."""
    scatter: float
    """Root mean square distance of a component of the readings from the polynomial."""


@dataclass(frozen=True)
class LocalPolynomial:
    """A quantity whose readings can be averaged, such as a position."""

    cfg: LocalPolynomialCfg
    time: np.ndarray
    """Times of the readings [s], shape (R,)."""
    value: np.ndarray
    """Readings, finite, shape (R, n)."""
    degree: int = 2
    """Degree of the polynomials."""
    velocity: LocalPolynomial | None = None
    """Readings of the rate that are more precise than the derivative of `value`."""

    @property
    def std(self) -> float:
        """Noise of a component: the median scatter of the readings about their polynomials."""
        return float(np.median(self.scatter(self.time)))

    def fits(self, time: np.ndarray) -> list[LocalFit]:
        """Return the polynomials about each of `time` (T,) [s]."""
        return [self._fit(float(now)) for now in time]

    def estimate(self, time: np.ndarray) -> Estimate:
        """Return the estimate at `time` (T,) [s]."""
        value, rate, second = np.array([fit.derivatives for fit in self.fits(time)]).transpose(1, 0, 2)
        return Estimate(value, rate if self.velocity is None else self.velocity.estimate(time).value, second)

    def covariance(self, time: np.ndarray) -> np.ndarray:
        """Return the covariance of value, rate and second derivative of a component at `time` (T,), (T, 3, 3)."""
        return _with_rate_sensor(self.fits(time), self.velocity, time)

    def scatter(self, time: np.ndarray) -> np.ndarray:
        """Return the root mean square distance of the readings around each time from their polynomial, shape (T,)."""
        return np.array([fit.scatter for fit in self.fits(time)])

    def scatter_of_both_sides(self, time: np.ndarray) -> np.ndarray:
        """Return the same of the polynomial through the readings on both sides, shape (T,).

        It is large where an impact lies among them, though one side may be smooth.
        """
        return np.array([self._around(float(now)).scatter for now in time])

    def acceleration(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the second derivative from readings on both sides of each time (T, n), its standard error (T,)."""
        fits = [self._around(float(now)) for now in time]
        return np.array([fit.derivatives[2] for fit in fits]), np.array([fit.errors[2] for fit in fits])

    def sample(self, time: np.ndarray, count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return value and rate at `time` (T,), then `count` samples under their errors, (1 + count, T, n)."""
        found = self.estimate(time)
        if rng is None or not count:
            return found.value[None], found.rate[None]
        return sample_values_and_rates(found.value, found.rate, self.covariance(time)[:, :2, :2], count, rng)

    def _fit(self, now: float) -> LocalFit:
        """Return the polynomial about a time."""
        return _best_fit(
            self.cfg,
            [self._local_fit(rows, now) for rows in _neighbourhoods(self.cfg, self.time, now, self.degree)],
        )

    def _around(self, now: float) -> LocalFit:
        """Return the polynomial through the readings on both sides of a time."""
        return self._local_fit(_neighbourhoods(self.cfg, self.time, now, self.degree)[0], now)

    def _local_fit(self, rows: slice, now: float) -> LocalFit:
        """Return the polynomial through some readings."""
        return _local_fit(self.time[rows] - now, self.value[rows.start : rows.stop], self.degree)


@dataclass(frozen=True)
class LocalPolynomialOrientation:
    """The orientation of a body; polynomials of the rotation vector from the reading nearest to each time."""

    cfg: LocalPolynomialCfg
    time: np.ndarray
    """Times of the readings [s], shape (R,)."""
    rotation: Rotation
    """R rotations from body to world."""
    velocity: LocalPolynomial | None = None
    """Readings of the angular velocity [rad/s], body frame, that are more precise than the derivative."""

    @property
    def value(self) -> np.ndarray:
        """Readings as quaternions wxyz with aligned signs, shape (R, 4)."""
        return continuous_quaternions(self.rotation.as_quat(scalar_first=True))

    @property
    def std(self) -> float:
        """Noise of a component of the rotation vector [rad]: the median scatter of the readings."""
        return float(np.median(self.scatter(self.time)))

    def fits(self, time: np.ndarray) -> list[LocalFit]:
        """Return the polynomials of the rotation vector [rad] about each of `time` (T,) [s]."""
        return [self._fit(float(now)) for now in time]

    def estimate(self, time: np.ndarray) -> OrientationEstimate:
        """Return the estimate at `time` (T,) [s]; rates of the rotation vector serve as angular velocity [rad/s]."""
        fits = self.fits(time)
        turns = [
            self._nearest(float(now)) * Rotation.from_rotvec(fit.derivatives[0])
            for now, fit in zip(time, fits, strict=True)
        ]
        rate = np.array([fit.derivatives[1] for fit in fits])
        return OrientationEstimate(
            np.array([turn.as_quat(scalar_first=True) for turn in turns]),
            rate if self.velocity is None else self.velocity.estimate(time).value,
            np.array([fit.derivatives[2] for fit in fits]),
        )

    def covariance(self, time: np.ndarray) -> np.ndarray:
        """Return the covariance of a component of the rotation vector and its derivatives at `time` (T,), (T, 3, 3)."""
        return _with_rate_sensor(self.fits(time), self.velocity, time)

    def scatter(self, time: np.ndarray) -> np.ndarray:
        """Return the root mean square distance of the readings around each time from their polynomial [rad], (T,)."""
        return np.array([fit.scatter for fit in self.fits(time)])

    def scatter_of_both_sides(self, time: np.ndarray) -> np.ndarray:
        """Return the same of the polynomial through the readings on both sides [rad], (T,).

        It is large where an impact lies among them, though one side may be smooth.
        """
        return np.array([self._fits_about(float(now))[0].scatter for now in time])

    def sample(self, time: np.ndarray, count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return quaternion (1 + count, T, 4) and angular velocity (1 + count, T, 3) at `time` (T,), then samples."""
        found = self.estimate(time)
        if rng is None or not count:
            return found.quaternion[None], found.velocity[None]
        zero = np.zeros_like(found.velocity)
        turn, rate = sample_values_and_rates(zero, found.velocity, self.covariance(time)[:, :2, :2], count, rng)
        middle = Rotation.from_quat(found.quaternion, scalar_first=True)
        return np.stack([(middle * Rotation.from_rotvec(t)).as_quat(scalar_first=True) for t in turn]), rate

    def _nearest(self, now: float) -> Rotation:
        """Return the reading nearest to a time."""
        return self.rotation[int(np.abs(self.time - now).argmin())]

    def _fit(self, now: float) -> LocalFit:
        """Return the polynomial about a time."""
        return _best_fit(self.cfg, self._fits_about(now))

    def _fits_about(self, now: float) -> list[LocalFit]:
        """Return the polynomials through the readings on both sides of a time, and on either."""
        middle = self._nearest(now).inv()
        return [
            _local_fit(self.time[rows] - now, (middle * self.rotation[rows.start : rows.stop]).as_rotvec(), 2)
            for rows in _neighbourhoods(self.cfg, self.time, now, 2)
        ]


def _with_rate_sensor(fits: Sequence[LocalFit], velocity: LocalPolynomial | None, time: np.ndarray) -> np.ndarray:
    """Return the covariances of local fits; the rate's is that of a sensor if there is one, shape (T, 3, 3)."""
    covariance = np.array([fit.covariance for fit in fits])
    if velocity is not None:
        covariance[:, 1], covariance[:, :, 1] = 0, 0
        covariance[:, 1, 1] = [fit.errors[0] ** 2 for fit in velocity.fits(time)]
    return covariance


def _neighbourhoods(cfg: LocalPolynomialCfg, time: np.ndarray, now: float, degree: int) -> list[slice]:
    """Return the readings around a time, then as many of those after it and before it alone, where there are enough."""
    nearest = int(np.abs(time - now).argmin())
    low = min(int(np.searchsorted(time, now - cfg.half_width)), nearest - cfg.min_neighbours)
    high = max(
        int(np.searchsorted(time, now + cfg.half_width, side="right")),
        nearest + cfg.min_neighbours + 1,
    )
    count = max(high - low, degree + 2)
    centred = slice(max(low, 0), min(high, len(time)))
    sides = [slice(nearest, nearest + count), slice(nearest + 1 - count, nearest + 1)]
    sides = [side for side in sides if side.start >= 0 and side.stop <= len(time)]
    return [centred, *sides] if centred.stop - centred.start >= min(degree + 2, len(time)) else sides or [centred]


def _best_fit(cfg: LocalPolynomialCfg, fits: Sequence[LocalFit]) -> LocalFit:
    """Return the first fit, or another one where the standard error of its rate is far smaller."""
    best = min(fits, key=lambda fit: fit.errors[1])
    return best if best.errors[1] < cfg.one_sided_ratio * fits[0].errors[1] else fits[0]


def _local_fit(offset: np.ndarray, value: np.ndarray, degree: int) -> LocalFit:
    """Fit a polynomial by least squares to values (k, n) at times `offset` (k,) from the time of interest [s]."""
    degree = min(degree, len(offset) - 1)
    scale = max(float(np.abs(offset).max()), 1e-9)
    powers = (offset / scale)[:, None] ** np.arange(degree + 1)
    inverse = np.linalg.pinv(powers)
    coefficient = inverse @ value
    free = max(len(offset) - degree - 1, 1)
    squares = ((value - powers @ coefficient) ** 2).sum(axis=0)
    deviation = float(np.sqrt(squares.mean() / free))
    errors = [0.0, 0.0, 0.0]
    derivatives = np.zeros((3, value.shape[1]))
    rows = np.zeros((3, len(offset)))
    for order, factor in enumerate((1.0, 1 / scale, 2 / scale**2)[: degree + 1]):
        derivatives[order] = factor * coefficient[order]
        errors[order] = factor * deviation * float(np.linalg.norm(inverse[order]))
        rows[order] = factor * deviation * inverse[order]
    scatter = float(np.sqrt(squares.mean() / len(offset)))
    return LocalFit(derivatives, (errors[0], errors[1], errors[2]), rows @ rows.T, scatter)
