"""Spheres left out of the physics count no farther than the surface of their object."""

import numpy as np
import pytest
from concent_warp.train.virtual import within

from concent_warp.scene.solid import Box
from concent_warp.scene.surface import Surface

HALF, RADIUS, SLACK = 0.02, 0.004, 0.0005
CUBE = Surface.of_solids([Box(np.full(3, HALF))])


def test_spheres_within_an_object_shrink_by_the_slack():
    centre = np.array([[HALF - RADIUS, 0, 0], [0.0, 0.0, 0.0]])
    moved, radius = within(CUBE, centre, np.full(2, RADIUS), SLACK)
    np.testing.assert_allclose(moved, centre)
    np.testing.assert_allclose(radius, RADIUS - SLACK)


@pytest.mark.parametrize("out", [-0.001, 0.0, 0.002])
def test_spheres_that_stand_out_end_the_slack_below_the_surface(out):
    centre = np.array([[HALF + out, 0.005, -0.003], [0.001, -HALF - out, 0.004]])
    moved, radius = within(CUBE, centre, np.full(2, RADIUS), SLACK)
    np.testing.assert_allclose(CUBE.signed_distance(moved) + radius, -SLACK, atol=1e-12)
    np.testing.assert_allclose(radius, max(-out - SLACK, 0.0), atol=1e-12)
    aside = [[1, 2], [0, 2]]
    for row in range(2):
        np.testing.assert_array_equal(moved[row, aside[row]], centre[row, aside[row]])
