import numpy as np
import pytest

from concent_warp.reality.sensors.photographs import PhotographsCfg, photographs
from concent_warp.reality.world import WorldCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg

CFG = PhotographsCfg(count=6, size=48)
CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * 0.02


@pytest.fixture(scope="module")
def world():
    return WorldCfg(chamfer=0.0).build(ShapeSorterCfg(block_yaw=0.4).build())


@pytest.fixture(scope="module")
def taken(world):
    return photographs(world, "block", CFG)


def test_corners_of_the_object_bound_its_mask(taken):
    for image, pose, matrix in zip(*taken, strict=True):
        seen = (CORNERS - pose[:3, 3]) @ pose[:3, :3] @ np.diag([1, -1, -1])
        pixels = seen[:, :2] / seen[:, 2:] * matrix[0, 0] + matrix[:2, 2]
        rows, columns = np.nonzero(image[..., 3] >= 128)
        # A pixel's centre is half a pixel from its border.
        np.testing.assert_allclose(pixels.min(axis=0), [columns.min() - 0.5, rows.min() - 0.5], atol=0.75)
        np.testing.assert_allclose(pixels.max(axis=0), [columns.max() + 0.5, rows.max() + 0.5], atol=0.75)


def test_photographs_show_one_object_with_its_pattern_from_all_sides(taken):
    sides = taken.poses[:, :3, 2]
    assert np.abs(sides.mean(axis=0)).max() < 0.2
    for image in taken.rgba:
        solid = image[..., 3] == 255
        assert 0.2 < solid.mean() < 0.6
        assert image[solid][:, 0].std() > 5
        assert not image[..., 3][[0, -1]].any()


def test_noise_is_sampled_from_the_seed(world, taken):
    noisy = PhotographsCfg(count=6, size=48, rgb_std=4.0)
    first, again, other = (photographs(world, "block", noisy, seed=seed).rgba for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    solid = taken.rgba[..., 3] == 255
    assert (first[solid].astype(float) - taken.rgba[solid])[:, :3].std() == pytest.approx(4, abs=0.8)


def test_cameras_stay_above_the_least_elevation(world):
    poses = photographs(world, "box", PhotographsCfg(count=5, size=16, lowest=10.0)).poses
    assert np.degrees(np.arcsin(poses[:, 2, 2])).min() > 10
