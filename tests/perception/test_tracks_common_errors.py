"""What the frames of a track have in common is written beside its covariances."""

from __future__ import annotations

import numpy as np

from concent_warp.perception.tracking.geometry.pose import moved
from concent_warp.perception.tracking.output import main_errors, pose_channels
from concent_warp.perception.tracking.result import BodyTrack

COUNT = 12


def track() -> tuple[BodyTrack, np.ndarray]:
    """Return a track of a body that turns, with one lost frame, and what each frame has for itself, (T, 6, 6)."""
    rng = np.random.default_rng(0)
    pose = np.array([moved(np.eye(4), 0.2 * t * np.array([0.1, 0, 0, 0.3, 1, 0.5])) for t in range(COUNT)])
    own = np.repeat(np.diag([1e-8] * 3 + [1e-6] * 3)[None], COUNT, axis=0)
    common = np.repeat(np.diag([1e-3] * 3 + [1e-2] * 3)[None], COUNT, axis=0)
    small = 1e-6 * rng.normal(size=(COUNT, 6, 40))
    common = np.concatenate([common, small], axis=2)
    covariance = own + common @ np.swapaxes(common, 1, 2)
    for array in (pose, covariance, common):
        array[5] = np.nan
    found = BodyTrack("demo_0", "block", np.arange(COUNT) / 30, pose, covariance, "none", True, common=common)
    return found, own


def test_few_errors_in_common_stand_for_those_of_the_tracker_and_the_rest_is_each_frames_own():
    found, own = track()
    channels = pose_channels(found)
    for name, rows in (("framepos", slice(0, 3)), ("framequat", slice(3, 6))):
        channel = channels[name]
        assert channel.common is not None
        assert channel.covariance is not None
        assert channel.common.shape == (COUNT, 3, 3)
        np.testing.assert_array_equal(np.isnan(channel.common).any(axis=(1, 2)), found.lost)
        left = (channel.covariance - channel.common @ np.swapaxes(channel.common, 1, 2))[~found.lost]
        size = own[0, rows, rows][0, 0]
        np.testing.assert_allclose(left, np.repeat(size * np.eye(3)[None], COUNT - 1, axis=0), atol=0.1 * size)


def test_small_errors_in_common_are_not_written():
    found, _ = track()
    assert found.common is not None
    assert main_errors(1e-3 * found.common[:, :3], found.covariance[:, :3, :3]) is None
