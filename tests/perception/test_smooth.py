from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from concent_warp.perception.tracking.alignment.align import Fit
from concent_warp.perception.tracking.alignment.rows import Normal
from concent_warp.perception.tracking.cfg import SmoothCfg, TrackCfg
from concent_warp.perception.tracking.demonstration_tracker import _smoothed
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


def bounced() -> tuple[np.ndarray, list[PoseMeasurement | None]]:
    """Return heights [m] of a body that bounces between two frames, (T,), and measurements but for three around it."""
    height = np.abs(6.0 * (TIME - 1.05))
    truth = np.array([moved(np.eye(4), np.array([0, 0, z, 0, 0, 0])) for z in height])
    measurements = measured(truth, np.random.default_rng(3))
    measurements[30:33] = [None] * 3
    return height, measurements


def test_an_impact_in_a_gap_may_be_anywhere_in_it():
    height, measurements = bounced()
    poses, covariance = smooth(TIME, measurements, 0.03, SmoothCfg())
    error = np.abs(poses[:, 2, 3] - height)
    assert (error < 3 * np.sqrt(covariance[:, 2, 2])).all()
    assert np.sqrt(covariance[[30, 31, 32], 2, 2]).min() > 0.01
    assert error[[29, 33]].max() < 4 * STD[2]


def test_a_pose_in_a_gap_with_an_impact_is_not_reported():
    _, measurements = bounced()
    fits = [
        None if m is None else Fit(m.pose, Normal(m.information, m.gradient), [], 1e-3, 1.0, np.nan, 0.3, np.nan)
        for m in measurements
    ]
    shape = SimpleNamespace(name="ball", radius=0.03)
    symmetry = SimpleNamespace(name="none", chosen_turns=lambda: np.zeros((3, 3)))
    tracker: Any = SimpleNamespace(fits=fits, shape=shape, symmetry=symmetry, reason="")
    tracker.numbered_fits, tracker.keyframe_turns = lambda: (fits, 0), list
    tracker.reasons = ["" if fit else "hidden" for fit in fits]
    video: Any = SimpleNamespace(time=TIME, cameras=("camera",))
    found = _smoothed(tracker, video, TrackCfg(), "demo_0")
    assert np.flatnonzero(found.lost).tolist() == [30, 31, 32]
    assert found.quality is not None
    assert found.quality.state[31] == "lost"


def test_an_unknown_turn_does_not_take_the_position_with_it():
    # Of a ball without texture, whose middle is 0.02 mm from the body's origin, nothing ever shows the turn.
    across = np.array([[1, 0, 0, 0, 2e-5, 0], [0, 1, 0, -2e-5, 0, 0], [0, 0, 1, 0, 0, 0]])
    information = across.T @ across / STD[0] ** 2
    measurements = [PoseMeasurement(np.eye(4), information, np.zeros(6)) for _ in TIME]
    cfg = SmoothCfg(acceleration=(20.0,))
    _, covariance = smooth(TIME, measurements, 0.03, cfg, np.array([0.0, 0.0, 2e-5]))
    std = np.sqrt(np.einsum("tii->ti", covariance))
    assert std[-1, :2].max() < 1.2 * std[-1, 2]
    assert (std[:, 3:] < 2.0).all()


def test_smoothing_about_another_point_gives_the_poses_of_the_body():
    truth = motion(0.3)
    measurements = measured(truth, np.random.default_rng(4))
    usual, about = (smooth(TIME, measurements, 0.03, SmoothCfg(), centre) for centre in (None, np.full(3, 1e-6)))
    np.testing.assert_allclose(about[0], usual[0], atol=2e-5)
    np.testing.assert_allclose(about[1], usual[1], rtol=0.02, atol=1e-9)
