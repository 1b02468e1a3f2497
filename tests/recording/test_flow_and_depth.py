from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from concent_warp.perception.optical_flow import corners, depth_at, eroded, grayscale, track_pixels
from concent_warp.perception.pinhole import Pinhole, pixel_grid
from concent_warp.perception.visible_region import BodyShape, visible_mask

K = np.array([[300.0, 0, 79.5], [0, 300.0, 59.5], [0, 0, 1]])
HEIGHT, WIDTH = 120, 160


def looking_down(height: float) -> Pinhole:
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[2, 3] = height
    return Pinhole(K, pose)


def texture(seed: int = 0) -> np.ndarray:
    blurred = gaussian_filter(np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH)), 1.5)
    return np.clip(128 + 40 * blurred / blurred.std(), 0, 255).astype(np.uint8)


def test_camera_projects_what_it_lifts():
    rng = np.random.default_rng(0)
    pose = np.eye(4)
    pose[:3, :3], _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    pose[:3, 3] = rng.normal(size=3)
    camera = Pinhole(K, pose)
    pixels, depth = rng.uniform(0, 160, (50, 2)), rng.uniform(0.2, 3, 50)
    back, back_depth = camera.project(camera.lift(pixels, depth))
    np.testing.assert_allclose(back, pixels, atol=1e-9)
    np.testing.assert_allclose(back_depth, depth)


def test_camera_axes_are_right_down_forward():
    camera = Pinhole(K, np.eye(4))
    pixel, depth = camera.project(np.array([[0.1, 0, 1], [0, 0.1, 1], [0, 0, 2.0], [0, 0, -1]]))
    np.testing.assert_allclose(pixel[:3], [[109.5, 59.5], [79.5, 89.5], [79.5, 59.5]])
    np.testing.assert_allclose(depth, [1, 1, 2, -1])


def test_flow_follows_a_shift_of_parts_of_a_pixel():
    before = texture()
    move = np.array([1.3, -2.6])
    after = np.clip(shift(before.astype(float), move[::-1], order=3, mode="nearest"), 0, 255).astype(np.uint8)
    start = corners(before, np.pad(np.ones((90, 130), bool), 15), np.zeros((0, 2)), 40, 5.0)
    assert len(start) > 30
    there, sure = track_pixels(before, after, start, start, window=9, tolerance=0.3)
    assert sure.mean() > 0.9
    assert np.abs(there[sure] - start[sure] - move).max() < 0.15


def test_flow_drops_points_that_are_covered():
    before = texture()
    after = before.copy()
    after[40:80, 60:110] = texture(1)[40:80, 60:110]
    start = corners(before, np.pad(np.ones((90, 130), bool), 15), np.zeros((0, 2)), 60, 5.0)
    _, sure = track_pixels(before, after, start, start, window=9, tolerance=0.3)
    well_inside = ((start > [65, 45]) & (start < [105, 75])).all(axis=1)
    well_outside = ((start < [54, 34]) | (start > [116, 86])).any(axis=1)
    assert sure[well_outside].mean() > 0.95
    assert sure[well_inside].mean() < 0.4


def test_flow_of_no_points_is_no_points():
    there, sure = track_pixels(texture(), texture(), np.zeros((0, 2)), np.zeros((0, 2)), window=7, tolerance=0.5)
    assert there.shape == (0, 2)
    assert sure.shape == (0,)


def test_corners_keep_to_the_region_and_their_distance():
    region = np.zeros((HEIGHT, WIDTH), bool)
    region[30:90, 40:120] = True
    taken = np.array([[80.0, 60.0]])
    found = corners(texture(), region, taken, 30, 6.0)
    assert len(found) > 10
    column, row = np.round(found).astype(int).T
    assert region[row, column].all()
    assert np.linalg.norm(found - taken, axis=1).min() > 5
    assert not len(corners(texture(), np.zeros_like(region), taken, 30, 6.0))
    assert not len(corners(texture(), region, taken, 0, 6.0))


def test_depth_between_pixels_is_exact_on_a_slanted_plane():
    camera = Pinhole(K, np.eye(4))
    ray = camera.rays(pixel_grid(HEIGHT, WIDTH))
    normal = np.array([0.5, 0.6, 1.0])
    depth = 0.8 / (ray @ normal)
    pixels = np.random.default_rng(0).uniform([5, 5], [150, 110], (40, 2))
    expected = 0.8 / (camera.rays(pixels) @ normal)
    np.testing.assert_allclose(depth_at(depth, pixels), expected, rtol=1e-6)


def test_depth_ignores_holes_and_what_lies_behind_an_edge():
    depth = np.full((HEIGHT, WIDTH), 0.5)
    depth[:, 82:] = 1.0
    depth[::3] = 0.0
    np.testing.assert_allclose(depth_at(depth, np.array([[79.3, 60.2]])), 0.5, rtol=1e-6)
    assert np.isnan(depth_at(np.zeros((HEIGHT, WIDTH)), np.array([[50.0, 50.0]])))[0]
    assert np.isnan(depth_at(depth, np.array([[-20.0, 50.0]])))[0]
    assert depth_at(depth, np.zeros((0, 2))).shape == (0,)


def test_depth_noise_averages_out_over_the_window():
    rng = np.random.default_rng(0)
    depth = 0.9 + rng.normal(0, 1e-3, (HEIGHT, WIDTH))
    read = depth_at(depth, rng.uniform([5, 5], [150, 110], (400, 2)))
    assert read.std() < 0.35e-3
    assert read.mean() == pytest.approx(0.9, abs=1e-4)


def test_region_of_a_box_is_where_its_depth_is_and_nothing_covers_it():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <geom type="plane" size="1 1 0.1"/>
      <body name="cube" pos="0 0 0.02"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
      <body name="above" pos="0 0 0.3"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
    </worldbody></mujoco>""")
    shape = BodyShape(model, model.qpos0, "cube")
    camera = looking_down(0.54)
    alone = shape.depth(camera, shape.start, HEIGHT, WIDTH)
    # 40 mm at 0.5 m and 300 px of focal length are 24 px; the body above it does not count.
    assert (alone > 0).sum() == 24 * 24
    np.testing.assert_allclose(alone[alone > 0], 0.5)
    pose = shape.start.copy()
    pose[:3, 3] += [0.05, 0, 0.1]
    moved_depth = shape.depth(camera, pose, HEIGHT, WIDTH)
    np.testing.assert_allclose(moved_depth[moved_depth > 0].min(), 0.4)
    column = np.flatnonzero((moved_depth > 0).any(axis=0)).mean()
    assert column == pytest.approx(79.5 + 300 * 0.05 / 0.4, abs=1.5)
    measured = np.where(alone > 0, alone, 0.54)
    measured[:60] = 0.3
    region = visible_mask(alone, measured, 0.005)
    assert region.sum() == 12 * 24
    assert not region[:60].any()
    assert eroded(region, 2).sum() == 8 * 20
    behind = pose.copy()
    behind[2, 3] = 2.0
    assert not shape.depth(camera, behind, HEIGHT, WIDTH).any()


def test_grey_weighs_colours_as_the_eye_does():
    assert grayscale(np.full((2, 2, 3), 90, np.uint8)).max() == 90
    colours = np.eye(3, dtype=np.uint8)[None] * 200
    red, green, blue = grayscale(colours)[0].astype(int)
    assert green > red > blue
