"""States and rates from measured signals: a polynomial through the few samples around a time.

A window of a recording is simulated from the state in which the recording shows the scene at its start. Positions come
from the measurements; velocities from the change of the positions, or from velocity sensors where these say it more
precisely. How precisely is told by the standard error of the local fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.estimation.object_tracks import BodyTarget, body_target, frame_channel, measured_pose, observed_poses
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene

SPAN = 0.02
"""Samples within this time before and after count in a local fit [s]."""
FEWEST = 2
"""Samples before and after that count in a local fit even where they lie farther apart than that."""
ONE_SIDED = 0.5
"""Samples on one side of a time alone are taken where the standard error of the rate falls below this share."""
PROBES = 40
"""Times at which the precision of a signal is estimated."""


@dataclass(frozen=True)
class Estimate:
    """A signal and its derivatives at one time."""

    value: np.ndarray
    """Value, shape (n,)."""
    rate: np.ndarray
    """First derivative [1/s], shape (n,)."""
    second: np.ndarray
    """Second derivative [1/s^2], shape (n,); zero for a straight line."""
    value_error: float
    """Standard error of a component of the value, from the scatter about the polynomial."""
    rate_error: float
    """Standard error of a component of the rate [1/s]."""
    second_error: float
    """Standard error of a component of the second derivative [1/s^2]."""
    scatter: float
    """Root mean square distance of a sample's component from the polynomial."""


class Signal(Protocol):
    """A quantity that was sampled and can be estimated, with its rate, at any time."""

    @property
    def time(self) -> np.ndarray:
        """Clock readings [s], shape (T,)."""
        ...

    def at(self, time: float) -> Estimate:
        """Return the estimate at a time [s]."""
        ...


@dataclass(frozen=True)
class Samples:
    """A signal whose samples can be added, such as a position."""

    time: np.ndarray
    value: np.ndarray
    """Shape (T, n), finite."""
    degree: int = 2
    """Degree of the local polynomial."""

    def at(self, time: float) -> Estimate:
        """Return the estimate at a time [s]."""
        fits = [
            _local_fit(self.time[rows] - time, self.value[rows.start : rows.stop], self.degree)
            for rows in _neighbourhoods(self.time, time, self.degree)
        ]
        return _smoothest(fits)

    def through(self, time: float) -> Estimate:
        """Return the estimate from samples on both sides of a time, even where an impact lies among them."""
        rows = _neighbourhoods(self.time, time, self.degree)[0]
        return _local_fit(self.time[rows] - time, self.value[rows.start : rows.stop], self.degree)


@dataclass(frozen=True)
class Turns:
    """Orientations of a body; the estimate is about the rotation vector from the nearest sample, in the body frame."""

    time: np.ndarray
    value: Rotation
    """T rotations from body to world."""

    def at(self, time: float) -> Estimate:
        """Return the estimate at a time [s]; the rate is the angular velocity in the body frame [rad/s]."""
        middle = self.nearest(time).inv()
        fits = [
            _local_fit(self.time[rows] - time, (middle * self.value[rows.start : rows.stop]).as_rotvec(), 2)
            for rows in _neighbourhoods(self.time, time, 2)
        ]
        return _smoothest(fits)

    def nearest(self, time: float) -> Rotation:
        """Return the sample nearest to a time."""
        return self.value[int(np.abs(self.time - time).argmin())]

    def orientation(self, time: float) -> Rotation:
        """Return the estimated orientation at a time."""
        return self.nearest(time) * Rotation.from_rotvec(self.at(time).value)


@dataclass(frozen=True)
class BodyMotion:
    """How a free body was seen to move."""

    position: Samples
    """Origin of the body frame [m], world frame."""
    orientation: Turns
    velocity: Samples | None
    """Velocity of the origin [m/s], world frame, where a sensor measured it more precisely than the positions do."""
    angular: Samples | None
    """Angular velocity [rad/s], body frame, likewise."""

    def state(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and quaternion wxyz (7,), linear [world] and angular velocity [body frame] (6,)."""
        place = self.position.at(time)
        turning = self.orientation.at(time)
        linear = place.rate if self.velocity is None else self.velocity.at(time).value
        angular = turning.rate if self.angular is None else self.angular.at(time).value
        quaternion = self.orientation.orientation(time).as_quat(scalar_first=True)
        return np.concatenate([place.value, quaternion]), np.concatenate([linear, angular])


def _neighbourhoods(time: np.ndarray, now: float, degree: int) -> list[slice]:
    """Return the samples about a time, and as many of those after it and before it alone, where there are enough."""
    nearest = int(np.abs(time - now).argmin())
    low = min(int(np.searchsorted(time, now - SPAN)), nearest - FEWEST)
    high = max(int(np.searchsorted(time, now + SPAN, side="right")), nearest + FEWEST + 1)
    count = max(high - low, degree + 2)
    centred = slice(max(low, 0), min(high, len(time)))
    sides = [slice(nearest, nearest + count), slice(nearest + 1 - count, nearest + 1)]
    sides = [side for side in sides if side.start >= 0 and side.stop <= len(time)]
    return [centred, *sides] if centred.stop - centred.start >= min(degree + 2, len(time)) else sides or [centred]


def _smoothest(fits: list[Estimate]) -> Estimate:
    """Return the first fit, or one of the others whose rate has less than half its standard error.

    The samples on both sides of a time say the most, unless an impact lies among them.
    """
    best = min(fits, key=_rate_error)
    return best if best.rate_error < ONE_SIDED * fits[0].rate_error else fits[0]


def _rate_error(estimate: Estimate) -> float:
    """Return the standard error of the rate."""
    return estimate.rate_error


def _local_fit(offset: np.ndarray, value: np.ndarray, degree: int) -> Estimate:
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
    for order, factor in enumerate((1.0, 1 / scale, 2 / scale**2)[: degree + 1]):
        derivatives[order] = factor * coefficient[order]
        errors[order] = factor * deviation * float(np.linalg.norm(inverse[order]))
    scatter = float(np.sqrt(squares.mean() / len(offset)))
    return Estimate(
        value=derivatives[0],
        rate=derivatives[1],
        second=derivatives[2],
        value_error=errors[0],
        rate_error=errors[1],
        second_error=errors[2],
        scatter=scatter,
    )


def _precision(signal: Signal, order: int) -> float:
    """Return the median standard error of a signal's value (`order` 0) or rate (1)."""
    times = signal.time[np.unique(np.linspace(0, len(signal.time) - 1, PROBES).astype(int))]
    estimates = [signal.at(float(t)) for t in times]
    return float(np.median([e.rate_error if order else e.value_error for e in estimates]))


def body_motion(scene: Scene, demonstration: Demonstration, body: str, qpos: np.ndarray) -> BodyMotion | None:
    """Return how a body was seen to move, by its pose sensors or its tracked points; None where it was not.

    Args:
        scene: The scene.
        demonstration: What was measured.
        body: Name of a body with a free joint.
        qpos: State at the demonstration's start, shape (nq,): says where on the body the tracked points are.
    """
    pose = measured_pose(scene.model, demonstration, body)
    if pose is not None and body not in demonstration.points:
        time, position, turn = pose
        known = np.flatnonzero(np.isfinite(position).all(axis=1))
        time, position, turn = time[known], position[known], Rotation.from_quat(turn.as_quat()[known])
    else:
        target = body_target(scene, demonstration, body, qpos)
        if target is None:
            return None
        time, position, turn = _tracked_pose(target)
    if len(time) < 2 * FEWEST:
        return None
    place, turning = Samples(time, position), Turns(time, turn)
    velocity, angular = _velocity_sensors(scene.model, demonstration, body)
    return BodyMotion(place, turning, more_precise(velocity, place), more_precise(angular, turning))


def _tracked_pose(target: BodyTarget) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Return times [s], positions [m] and rotations of a body's frame from its observed points (Kabsch)."""
    pose = observed_poses(target, np.arange(len(target.time)))
    seen = np.isfinite(pose).all(axis=1)
    return target.time[seen], pose[seen, :3], Rotation.from_quat(pose[seen, 3:], scalar_first=True)


def _velocity_sensors(
    model: mujoco.MjModel, demonstration: Demonstration, body: str
) -> tuple[Samples | None, Samples | None]:
    """Return the velocity [m/s, world] and angular velocity [rad/s, body frame] of a body's frame, as sensors say."""
    linear = frame_channel(model, demonstration, body, mujoco.mjtSensor.mjSENS_FRAMELINVEL)
    for name, channel in demonstration.measured.items():
        sensor = model.sensor(name).id
        site = int(model.sensor_objid[sensor])
        gyro = int(model.sensor_type[sensor]) == int(mujoco.mjtSensor.mjSENS_GYRO)
        if gyro and int(model.site_bodyid[site]) == model.body(body).id:
            rotation = Rotation.from_quat(model.site_quat[site], scalar_first=True)
            return finite(linear), finite(Channel(channel.time, rotation.apply(channel.value)))
    return finite(linear), None


def finite(channel: Channel | None) -> Samples | None:
    """Return the valid samples of a channel as a signal, None where they are too few."""
    if channel is None:
        return None
    known = np.isfinite(channel.value).all(axis=1)
    return Samples(channel.time[known], channel.value[known], 1) if known.sum() >= 2 * FEWEST else None


def more_precise(sensor: Samples | None, signal: Signal) -> Samples | None:
    """Return the sensor if it says the rate of a signal more precisely than the signal itself does, else None."""
    if sensor is None or _precision(sensor, 0) >= _precision(signal, 1):
        return None
    return sensor
