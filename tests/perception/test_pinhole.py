from __future__ import annotations

import numpy as np

from concent_warp.perception.pinhole import Pinhole

K = np.array([[300.0, 0, 79.5], [0, 300.0, 59.5], [0, 0, 1]])


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
