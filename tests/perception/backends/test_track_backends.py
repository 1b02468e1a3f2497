"""Tracking with masks and with tracked points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.perception.pinhole import Pinhole
from concent_warp.perception.tracking.cfg import RegistrationCfg, SmoothCfg
from concent_warp.perception.tracking.geometry.pose import twist_between


def shortened(film, count: int, rgb: np.ndarray | None = None, depth: np.ndarray | None = None) -> cw.Recording:
    """Return the first frames of a film, with other images where they are given."""
    stream = film.recording[0].image["camera"]
    rgb, depth = stream.rgb if rgb is None else rgb, stream.depth if depth is None else depth
    stream = replace(stream, time=stream.time[:count], rgb=rgb[:count], depth=depth[:count])
    return replace(film.recording, demonstrations=(replace(film.recording[0], image={"camera": stream}),))


def errors(found: cw.BodyTrack, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of position [m] and of rotation [deg] of the frames that are not lost."""
    twist = np.array([twist_between(poses[t], found.pose[t]) for t in np.flatnonzero(~found.lost)])
    return np.linalg.norm(twist[:, :3], axis=1), np.degrees(np.linalg.norm(twist[:, 3:], axis=1))


@pytest.fixture(scope="module")
def gripped(plain) -> cw.Recording:
    """Return the film with something unknown in front of a half of the block, in all frames but the first two."""
    stream = plain.recording[0].image["camera"]
    rgb, depth, camera = stream.rgb.copy(), stream.depth.copy(), Pinhole.of(stream)
    for frame in range(2, 5):
        (column, row), away = camera.project(plain.poses[frame][:3, 3])
        hand = np.s_[max(round(row) - 60, 0) : round(row) + 60, round(column) : round(column) + 45]
        rgb[frame][hand], depth[frame][hand] = (200, 160, 140), away - 0.06
    return shortened(plain, 6, rgb, depth)


def test_a_body_behind_an_unknown_hand_is_lost_without_masks_and_tracked_with_them(plain, gripped):
    first = {"block": plain.poses[0]}
    lost = cw.track(gripped, pose=first).track("block").lost
    found = cw.track(gripped, pose=first, masker=cw.DepthMasker()).track("block")
    assert lost[2:5].all()
    assert not found.lost.any()
    position, rotation = errors(found, plain.poses)
    assert position.max() < 2e-3
    assert rotation.max() < 3


def test_a_mask_elsewhere_loses_the_body_and_an_empty_one_changes_nothing(plain):
    class Corner:
        """Finds every object in a square at the image's corner."""

        edge = 30

        def masks(self, frames, prompts):
            result = {name: np.zeros((frames.count, *frames.size), dtype=bool) for name in prompts}
            for mask in result.values():
                mask[:, : self.edge, : self.edge] = True
            return result

    class Nowhere(Corner):
        edge = 0

    first, recording = {"block": plain.poses[0]}, shortened(plain, 2)
    assert isinstance(Corner(), cw.Masker)
    with pytest.raises(cw.RecordingError, match="first pose of 'block'"):
        cw.track(recording, pose=first, masker=Corner())
    without = cw.track(recording, pose=first).track("block")
    np.testing.assert_array_equal(cw.track(recording, pose=first, masker=Nowhere()).track("block").pose, without.pose)


@pytest.mark.parametrize(
    "cfg",
    [cw.TrackCfg(), cw.TrackCfg(registration=RegistrationCfg(shape=False, fallback=False, window=4))],
    ids=["with the shape", "points alone, short windows"],
)
def test_points_give_the_poses_of_a_textured_block(textured, cfg):
    found = cw.track(shortened(textured, 9), cfg, pose={"block": textured.poses[0]}, points=cw.FlowTracker())
    position, rotation = errors(found.track("block"), textured.poses)
    assert len(position) == 9
    assert position.mean() < 0.6e-3
    assert rotation.mean() < 1.0
    channel = found.recording[0].measured["block_position"]
    assert channel.covariance is not None


def test_without_texture_the_shape_takes_over_unless_that_is_forbidden(plain):
    first, recording = {"block": plain.poses[0]}, shortened(plain, 4)
    found = cw.track(recording, pose=first, points=cw.FlowTracker()).track("block")
    assert not found.lost.any()
    assert errors(found, plain.poses)[0].max() < 2e-3

    class NoPoints(cw.FlowTracker):
        def choose(self, frames, frame, mask, count):  # noqa: ARG002
            return np.zeros((0, 2))

    # Between the searches, nothing but points may follow the body, and gaps are not bridged.
    alone = cw.TrackCfg(registration=RegistrationCfg(fallback=False), smooth=SmoothCfg(max_gap=0.0))
    lost = cw.track(recording, alone, pose=first, points=NoPoints()).track("block").lost
    assert lost[[1, 3]].all()


def test_points_that_are_tracked_wrongly_are_not_believed(textured):
    class Drifting(cw.FlowTracker):
        def track(self, frames, queries):
            tracks = super().track(frames, queries)
            drift = 4.0 * np.arange(frames.count)[None, :, None] * np.array([1.0, 0.5])
            return cw.PixelTracks(tracks.pixels + drift, tracks.visible)

    first = {"block": textured.poses[0]}
    found = cw.track(shortened(textured, 5), pose=first, points=Drifting()).track("block")
    assert not found.lost.any()
    assert errors(found, textured.poses)[0].max() < 1e-3


def test_a_tracker_of_poses_may_be_replaced(plain):
    class Still:
        def track(self, given: cw.TrackingInput, progress=None):  # noqa: ARG002
            time = given.video.time
            poses = np.repeat(given.first["block"][None], len(time), axis=0)
            covariance = np.repeat(1e-6 * np.eye(6)[None], len(time), axis=0)
            return [cw.BodyTrack(given.name, "block", time, poses, covariance, "none", False)]

    first, recording = {"block": plain.poses[0]}, shortened(plain, 2)
    assert isinstance(Still(), cw.PoseTracker)
    found = cw.track(recording, pose=first, tracker=Still()).track("block")
    np.testing.assert_array_equal(found.pose[1], plain.poses[0])
    with pytest.raises(cw.ConcentError, match="its own masks and points"):
        cw.track(recording, pose=first, tracker=Still(), points=cw.FlowTracker())
