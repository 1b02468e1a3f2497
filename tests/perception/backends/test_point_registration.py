from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.perception.pinhole import Pinhole
from concent_warp.perception.tracking.cfg import AlignCfg, RegistrationCfg
from concent_warp.perception.tracking.geometry.pose import moved, pose_of, rotation_angle
from concent_warp.perception.tracking.geometry.view import View
from concent_warp.perception.tracking.points.registration import SeenPoints, measured_depth, registered

CAMERA = Pinhole(np.array([[600.0, 0, 159.5], [0, 600.0, 119.5], [0, 0, 1]]), np.eye(4))
POSE = moved(pose_of(np.array([0.01, -0.02, 0.8]), np.array([1.0, 0, 0, 0])), np.array([0, 0, 0, 0.4, -0.3, 0.2]))


def seen(count: int, outliers: int = 0, noise: float = 0.0, seed: int = 0) -> tuple[View, SeenPoints]:
    """Return a view of points on a bumpy surface and the points, of which some are elsewhere."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.03, 0.03, (count, 3))
    pixels, depth = CAMERA.project(points @ POSE[:3, :3].T + POSE[:3, 3])
    pixels = np.round(pixels)
    image = np.zeros((240, 320), np.float32)
    for (column, row), away in zip(pixels.astype(int), depth, strict=True):
        image[row - 1 : row + 3, column - 1 : column + 3] = away
    # The positions on the body are those that lie on whole pixels, as the image has only those.
    away = image[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].astype(float)
    points = (CAMERA.lift(pixels, away) - POSE[:3, 3]) @ POSE[:3, :3]
    points[:outliers] += rng.uniform(0.02, 0.05, (outliers, 3))
    shown = pixels + noise * rng.normal(size=pixels.shape)
    return View(CAMERA, np.zeros((240, 320, 3), np.uint8), image), SeenPoints(points, shown)


def test_the_pose_is_found_although_a_third_of_the_points_are_wrong():
    view, points = seen(40, outliers=13, noise=0.1)
    found = registered([view], [points], RegistrationCfg(), AlignCfg(), np.random.default_rng(0))
    assert found is not None
    assert 24 <= found.count <= 30
    assert np.linalg.norm(found.pose[:3, 3] - POSE[:3, 3]) < 0.5e-3
    assert np.degrees(rotation_angle(found.pose, POSE)) < 0.5


def test_two_views_count_together():
    view, points = seen(14)
    halves = [SeenPoints(points.points[part], points.pixels[part]) for part in (slice(0, 7), slice(7, 14))]
    cfg = RegistrationCfg(min_points=10)
    found = registered([view, view], halves, cfg, AlignCfg(), np.random.default_rng(0))
    assert found is not None
    assert found.count == 14
    assert registered([view], halves[:1], cfg, AlignCfg(), np.random.default_rng(0)) is None


@pytest.mark.parametrize("count", [0, 3, 7])
def test_too_few_points_give_no_pose(count):
    view, points = seen(count)
    assert registered([view], [points], RegistrationCfg(), AlignCfg(), np.random.default_rng(0)) is None


def test_points_that_agree_with_no_pose_give_none():
    view, points = seen(30)
    mixed = replace(points, points=np.random.default_rng(1).uniform(-0.2, 0.2, (30, 3)))
    assert registered([view], [mixed], RegistrationCfg(), AlignCfg(), np.random.default_rng(0)) is None


def test_points_on_a_line_give_no_pose():
    view, points = seen(12)
    along = np.linspace(-1, 1, 12)
    pixels = np.column_stack([np.round(160 + 20 * along), np.full(12, 120.0)])
    view.depth[:] = 0.8
    local = (CAMERA.lift(pixels, np.full(12, 0.8)) - POSE[:3, 3]) @ POSE[:3, :3]
    line = SeenPoints(local, pixels)
    assert registered([view], [line], RegistrationCfg(), AlignCfg(), np.random.default_rng(0)) is None
    del points


def test_depth_is_interpolated_and_unknown_beside_holes_and_outside():
    depth = np.add.outer(np.zeros(10), np.arange(10)).astype(np.float32) + 1
    depth[2, 2] = 0
    view = View(CAMERA, np.zeros((10, 10, 3), np.uint8), depth)
    pixels = np.array([[4.25, 5.5], [1.5, 1.5], [-0.5, 3.0], [9.5, 3.0]])
    np.testing.assert_allclose(measured_depth(view, pixels), [5.25, 0, 0, 0])
