"""Forward-backward smoothing of poses: an extended Kalman filter with constant velocity, and Rauch-Tung-Striebel's
pass.

Each moment gives the normal equations of a pose rather than a pose, so directions that a frame does not show (the
turn of a cylinder about its axis) stay open. The acceleration's standard deviation is the most likely of a few, for
each stretch of the motion: objects rest for most of the time and are jerked in between. In single steps, in which a
measurement contradicts the prediction, the velocity may change at once: an impact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from concent_warp.perception.tracking.cfg import SmoothCfg
from concent_warp.perception.tracking.geometry.pose import moved, twist_between

MAX_IMPACTS = 20
"""Most impacts looked for in one stretch of a track."""
ANY_TURN = np.pi / np.sqrt(3)
"""Standard deviation of a turn of which nothing is known [rad]: all up to half a turn either way are equally likely."""
START_SPEED = 0.5
"""Standard deviation of the speed before the first measurement [m/s], of rotations over the radius."""


@dataclass(frozen=True)
class PoseMeasurement:
    """What one moment says about a pose."""

    pose: np.ndarray
    """Where it is linearised, shape (4, 4)."""
    information: np.ndarray
    """Shape (6, 6)."""
    gradient: np.ndarray
    """Shape (6,)."""


def smooth(
    time: np.ndarray,
    measurements: Sequence[PoseMeasurement | None],
    radius: float,
    cfg: SmoothCfg,
    centre: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return poses, shape (T, 4, 4), and covariances of their twists, shape (T, 6, 6).

    Args:
        time: Times [s], shape (T,).
        measurements: What each says, the first and at least one; None where the object was not seen.
        radius: Radius of the object [m].
        cfg: Settings.
        centre: Middle of a round object [m], body frame, shape (3,). Its motion is smoothed: that of the body's origin
            beside it would be as little known as turns that nothing shows, whose errors grow without limit.
    """
    if centre is not None:
        poses, covariances = smooth(time, [m and _about(m, centre) for m in measurements], radius, cfg)
        found = [_from(pose, covariance, centre) for pose, covariance in zip(poses, covariances, strict=True)]
        return np.array([pose for pose, _ in found]), np.array([covariance for _, covariance in found])
    runs = [_filtered(time, measurements, radius, np.full(len(time), a)) for a in cfg.acceleration]
    likelihood = np.array([run.likelihood for run in runs])
    window = np.abs(time[:, None] - time[None]) <= cfg.window / 2
    best = (likelihood @ window).argmax(axis=0)
    # A change of motion is felt on both sides of it.
    widest = np.array([best[row].max() for row in window])
    acceleration = np.array(cfg.acceleration)[widest]
    run = _filtered(time, measurements, radius, acceleration)
    for _ in range(MAX_IMPACTS):
        surprise = np.where(acceleration < cfg.impact, run.surprise, 0.0)
        worst = int(surprise.argmax())
        if surprise[worst] <= chdtri(6, 1 - cfg.surprising):
            break
        # Between two frames the impact may be near either; in a gap before this one, anywhere.
        first = worst
        while first > 1 and measurements[first - 1] is None:
            first -= 1
        acceleration[first : worst + 2] = cfg.impact
        run = _filtered(time, measurements, radius, acceleration)
    return _backward(run)


def _about(measurement: PoseMeasurement, centre: np.ndarray) -> PoseMeasurement:
    """Return a measurement of a body's pose as that of a frame in another point of it [m], shape (3,)."""
    pose = measurement.pose.copy()
    arm = pose[:3, :3] @ centre
    pose[:3, 3] += arm
    back = _shift(arm)
    return PoseMeasurement(pose, back.T @ measurement.information @ back, back.T @ measurement.gradient)


def _from(pose: np.ndarray, covariance: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pose and covariance of a body from those of a frame in a point of it [m], shape (3,).

    No turn is less known than one of which nothing is known.
    """
    pose, arm = pose.copy(), pose[:3, :3] @ centre
    pose[:3, 3] -= arm
    variance, axes = np.linalg.eigh(covariance[3:, 3:])
    within = np.eye(6)
    within[3:, 3:] = (axes * (ANY_TURN / np.sqrt(np.maximum(variance, ANY_TURN**2)))) @ axes.T
    back = _shift(arm) @ within
    return pose, back @ covariance @ back.T


def _shift(arm: np.ndarray) -> np.ndarray:
    """Return the matrix, shape (6, 6), from the twist of a frame that is `arm` [m] away to that of the body."""
    matrix = np.eye(6)
    matrix[:3, 3:] = [[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]]
    return matrix


@dataclass(frozen=True)
class _Run:
    """Results of the forward pass."""

    pose: list[np.ndarray]
    speed: list[np.ndarray]
    covariance: list[np.ndarray]
    predicted_pose: list[np.ndarray]
    predicted_speed: list[np.ndarray]
    predicted_covariance: list[np.ndarray]
    transition: list[np.ndarray]
    likelihood: np.ndarray
    surprise: np.ndarray
    """Squared Mahalanobis distance of each measurement from its prediction, along what it shows, shape (T,)."""


def _filtered(
    time: np.ndarray, measurements: Sequence[PoseMeasurement | None], radius: float, acceleration: np.ndarray
) -> _Run:
    """Return the forward pass with a standard deviation of the acceleration for each moment [m/s^2], shape (T,)."""
    first = next(m for m in measurements if m is not None)
    run = _Run([], [], [], [], [], [], [], np.zeros(len(time)), np.zeros(len(time)))
    scale = np.array([1.0] * 3 + [1 / radius] * 3)
    pose, speed = first.pose, np.zeros(6)
    covariance = np.diag(np.concatenate([(scale * 0.3) ** 2, (scale * START_SPEED) ** 2]))
    for t, measurement in enumerate(measurements):
        step = 0.0 if t == 0 else float(time[t] - time[t - 1])
        transition = np.eye(12)
        transition[:6, 6:] = step * np.eye(6)
        unit = np.diag((scale * acceleration[t]) ** 2)
        noise = np.block([[step**4 / 4 * unit, step**3 / 2 * unit], [step**3 / 2 * unit, step**2 * unit]])
        pose = moved(pose, step * speed)
        covariance = transition @ covariance @ transition.T + noise + 1e-16 * np.eye(12)
        run.predicted_pose.append(pose)
        run.predicted_speed.append(speed)
        run.predicted_covariance.append(covariance)
        run.transition.append(transition)
        if measurement is not None:
            offset = twist_between(measurement.pose, pose)
            rest = measurement.gradient - measurement.information @ offset
            gain = np.eye(6) + covariance[:6, :6] @ measurement.information
            after = covariance - covariance[:, :6] @ measurement.information @ np.linalg.solve(gain, covariance[:6])
            after = (after + after.T) / 2
            change = after[:, :6] @ rest
            run.surprise[t] = _surprise(measurement.information, rest, covariance[:6, :6])
            run.likelihood[t] = (
                measurement.gradient @ offset
                - 0.5 * offset @ measurement.information @ offset
                + 0.5 * rest @ change[:6]
                - 0.5 * np.linalg.slogdet(gain)[1]
            )
            pose, speed, covariance = moved(pose, change[:6]), speed + change[6:], after
        run.pose.append(pose)
        run.speed.append(speed)
        run.covariance.append(covariance)
    return run


def _surprise(information: np.ndarray, gradient: np.ndarray, covariance: np.ndarray) -> float:
    """Return the squared Mahalanobis distance of a measurement from a prediction, along the directions it shows.

    Args:
        information: Of the measurement, shape (6, 6).
        gradient: Information times offset of measurement and prediction, shape (6,).
        covariance: Of the prediction, shape (6, 6).
    """
    values, directions = np.linalg.eigh(information)
    shown = values > 1e-6 * values[-1]
    offset = directions[:, shown].T @ gradient / values[shown]
    spread = np.diag(1 / values[shown]) + directions[:, shown].T @ covariance @ directions[:, shown]
    return float(offset @ np.linalg.solve(spread, offset))


def _backward(run: _Run) -> tuple[np.ndarray, np.ndarray]:
    """Return smoothed poses (T, 4, 4) and covariances (T, 6, 6)."""
    pose, speed, covariance = run.pose[-1], run.speed[-1], run.covariance[-1]
    poses, covariances = [pose], [covariance[:6, :6]]
    for t in range(len(run.pose) - 2, -1, -1):
        ahead = run.predicted_covariance[t + 1]
        gain = np.linalg.solve(ahead, run.transition[t + 1] @ run.covariance[t]).T
        off = np.concatenate([twist_between(run.predicted_pose[t + 1], pose), speed - run.predicted_speed[t + 1]])
        change = gain @ off
        covariance = run.covariance[t] + gain @ (covariance - ahead) @ gain.T
        pose, speed = moved(run.pose[t], change[:6]), run.speed[t] + change[6:]
        poses.append(pose)
        covariances.append(covariance[:6, :6])
    return np.array(poses[::-1]), np.array(covariances[::-1])
