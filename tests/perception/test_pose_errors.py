"""ADD, ADD-S and their areas against sums by hand and against other ways to compute them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.errors import ConcentError
from concent_warp.perception.evaluation.pose_errors import ModelPoints, area_under_curve


def transform(rotation: np.ndarray, shift: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift
    return pose


HALF_TURN = np.diag([-1.0, -1.0, 1.0])
CROSS = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.2, 0], [0, -0.2, 0]])


def test_a_shift_counts_by_its_length_and_a_half_turn_by_the_chords():
    model = ModelPoints(CROSS)
    shifted = transform(np.eye(3), (0.03, 0.04, 0))
    assert model.add(shifted, np.eye(4)) == pytest.approx(0.05)
    turned = transform(HALF_TURN, (0, 0, 0))
    assert model.add(turned, np.eye(4)) == pytest.approx((0.2 + 0.2 + 0.4 + 0.4) / 4)
    assert model.adds(turned, np.eye(4)) == pytest.approx(0, abs=1e-12)


def test_adds_asks_from_the_true_pose_for_the_nearest_estimated_point():
    # Points at 0 and 1 and 1.1; estimate shifted by 1: at 1, 2, 2.1. From the truth: 1, 0, 0.1; the reverse: 0, 0.9, 1.
    model = ModelPoints(np.array([[0.0, 0, 0], [1, 0, 0], [1.1, 0, 0]]))
    shifted = transform(np.eye(3), (1, 0, 0))
    assert model.adds(shifted, np.eye(4)) == pytest.approx((1 + 0 + 0.1) / 3)
    assert model.adds(np.eye(4), shifted) == pytest.approx((0 + 0.9 + 1.0) / 3)


def test_errors_equal_those_over_all_pairs_of_points():
    rng = np.random.default_rng(0)
    points = rng.normal(0, 0.05, (200, 3))
    model = ModelPoints(points)
    for _ in range(5):
        estimate, truth = (
            transform(Rotation.random(rng=rng).as_matrix(), tuple(rng.normal(0, 0.1, 3))) for _ in range(2)
        )
        there = np.array([estimate[:3, :3] @ p + estimate[:3, 3] for p in points])
        true = np.array([truth[:3, :3] @ p + truth[:3, 3] for p in points])
        apart = np.sqrt(((true[:, None] - there[None]) ** 2).sum(axis=2))
        assert model.add(estimate, truth) == pytest.approx(np.trace(apart) / len(points), rel=1e-9)
        assert model.adds(estimate, truth) == pytest.approx(apart.min(axis=1).mean(), rel=1e-9)


def test_a_missing_pose_is_infinitely_far():
    missing = np.full((4, 4), np.nan)
    assert ModelPoints(CROSS).add(missing, np.eye(4)) == np.inf
    assert ModelPoints(CROSS).adds(missing, np.eye(4)) == np.inf


def test_area_by_hand():
    # Shares: 0 below 2 cm, 1/2 to 6 cm, 2/3 from there on; the third error is beyond 10 cm.
    assert area_under_curve(np.array([0.02, 0.06, 0.3])) == pytest.approx((1 / 3 * 4 + 2 / 3 * 4) / 10)
    assert area_under_curve(np.array([0.0])) == 1
    assert area_under_curve(np.array([np.inf])) == 0
    assert area_under_curve(np.array([0.01]), max_threshold=0.02) == pytest.approx(0.5)


def test_area_is_the_integral_of_the_share_below_the_threshold():
    errors = np.random.default_rng(1).exponential(0.03, 400)
    thresholds = np.linspace(0, 0.1, 200_001)
    share = np.searchsorted(np.sort(errors), thresholds, side="right") / len(errors)
    assert area_under_curve(errors) == pytest.approx(np.trapezoid(share, thresholds) / 0.1, abs=1e-6)
    # PoseCNN's script sums rectangles as high as the share at their right end: at most 1 / n more.
    known = np.sort(errors[errors <= 0.1])
    heights = np.concatenate([np.arange(1, len(known) + 1), [len(known)]]) / len(errors)
    rectangles = 10 * (np.diff(np.concatenate([[0], known, [0.1]])) * heights).sum()
    assert 0 <= rectangles - area_under_curve(errors) <= 1 / len(errors)


@pytest.mark.parametrize("errors", [[], [np.nan], [-0.1]])
def test_a_curve_of_no_errors_is_refused(errors):
    with pytest.raises(ConcentError, match="no curve of these errors"):
        area_under_curve(np.array(errors))
