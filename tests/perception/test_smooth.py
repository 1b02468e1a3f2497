from __future__ import annotations

import numpy as np

from concent_warp.perception.tracking.cfg import SmoothCfg
from concent_warp.perception.tracking.geometry.pose import moved, twist_between
from concent_warp.perception.tracking.smooth import PoseMeasurement, smooth

TIME = np.arange(60) / 30
STD = np.array([1e-3] * 3 + [0.01] * 3)


def motion(speed: float) -> np.ndarray:
    """Return poses that rest for a second and then move and turn evenly, shape (T, 4, 4)."""
    share = np.clip(TIME - 1, 0, None)
    return np.array([moved(np.eye(4), speed * s * np.array([1, 0, 0.5, 0, 3.0, 0])) for s in share])


def measured(truth: np.ndarray, rng: np.random.Generator) -> list[PoseMeasurement | None]:
    information = np.diag(1 / STD**2)
    return [PoseMeasurement(moved(pose, STD * rng.normal(size=6)), information, np.zeros(6)) for pose in truth]


def errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.array([twist_between(t, p) for t, p in zip(truth, poses, strict=True)])


def test_noise_falls_at_rest_and_intervals_are_right():
    truth, twists, inside = motion(0.0), [], []
    for seed in range(6):
        poses, covariance = smooth(TIME, measured(truth, np.random.default_rng(seed)), 0.03, SmoothCfg())
        twist = errors(poses, truth)
        twists.append(twist)
        inside.append(np.abs(twist) < 1.96 * np.sqrt(np.einsum("tii->ti", covariance)))
    assert np.sqrt(np.mean(np.square(twists), axis=(0, 1)) / STD**2).max() < 0.5
    assert 0.85 < np.mean(inside) <= 1.0


def test_a_jerk_is_followed_without_lag():
    truth = motion(0.3)
    poses, covariance = smooth(TIME, measured(truth, np.random.default_rng(1)), 0.03, SmoothCfg())
    twist = errors(poses, truth)
    assert np.abs(twist[:, 0]).max() < 3.5 * STD[0]
    assert (np.abs(twist) < 1.96 * np.sqrt(np.einsum("tii->ti", covariance))).mean() > 0.85


def test_a_gap_is_bridged_with_a_wider_interval():
    truth = motion(0.3)
    measurements = measured(truth, np.random.default_rng(2))
    measurements[40:44] = [None] * 4
    poses, covariance = smooth(TIME, measurements, 0.03, SmoothCfg())
    std = np.sqrt(covariance[:, 0, 0])
    assert std[41] > 1.2 * std[30]
    assert abs(errors(poses, truth)[42, 0]) < 3 * std[42]


def test_a_direction_that_no_frame_shows_stays_open():
    information = np.diag([*(1 / STD[:5] ** 2), 0.0])
    measurements = [PoseMeasurement(np.eye(4), information, np.zeros(6)) for _ in TIME]
    _, covariance = smooth(TIME, measurements, 0.03, SmoothCfg())
    assert np.sqrt(covariance[:, 5, 5]).min() > 1.0
    assert np.sqrt(covariance[:, 4, 4]).max() < 0.02
