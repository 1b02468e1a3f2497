import time

import numpy as np
import pytest

from concent_warp.errors import ModelError
from concent_warp.scene.spheres.sampling import farthest_point_sampling


def test_each_choice_is_the_farthest_from_those_before():
    points = np.random.default_rng(0).random((300, 3))
    chosen = farthest_point_sampling(points, 40, start=7)
    assert chosen[0] == 7
    for k in range(1, 40):
        gap = np.linalg.norm(points[:, None] - points[chosen[:k]], axis=2).min(axis=1)
        assert gap[chosen[k]] == pytest.approx(gap.max())


def test_smaller_sample_is_a_prefix_and_choices_differ():
    points = np.random.default_rng(1).random((500, 3))
    many = farthest_point_sampling(points, 100)
    assert len(set(many)) == 100
    np.testing.assert_array_equal(farthest_point_sampling(points, 30), many[:30])


def test_512_of_20000_points_take_less_than_two_seconds():
    points = np.random.default_rng(2).random((20_000, 3))
    begin = time.process_time()
    farthest_point_sampling(points, 512)
    assert time.process_time() - begin < 2


def test_more_than_all_points_are_refused():
    with pytest.raises(ModelError, match="at least 4, found 3"):
        farthest_point_sampling(np.zeros((3, 3)), 4)
