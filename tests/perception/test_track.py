from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.perception.tracking.geometry.pose import moved, twist_between
from concent_warp.recording.recording import Channel

AXIS = np.array([0.6, 0.0, 0.8])


def errors(found: cw.BodyTrack, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of position [m] and of rotation [deg], each of shape (T,)."""
    twist = np.array([twist_between(truth, pose) for truth, pose in zip(poses, found.pose, strict=True)])
    return np.linalg.norm(twist[:, :3], axis=1), np.degrees(np.linalg.norm(twist[:, 3:], axis=1))


def changed(film, frames: slice = slice(None), **changes):
    """Return a video with some frames and with other members of its demonstration."""
    demonstration = film.recording[0]
    stream = demonstration.image["camera"]
    stream = replace(stream, time=stream.time[frames], rgb=stream.rgb[frames], depth=stream.depth[frames])
    return replace(film.recording, demonstrations=(replace(demonstration, **{"image": {"camera": stream}, **changes}),))


@pytest.fixture(scope="module")
def tracked(textured):
    return cw.track(textured.recording, pose={"block": textured.poses[0]})


def test_a_textured_block_is_tracked_to_a_third_of_a_millimetre_through_the_grasp(textured, tracked):
    found = tracked.track("block")
    position, rotation = errors(found, textured.poses)
    assert np.linalg.norm(np.ptp(textured.poses[:, :3, 3], axis=0)) > 0.05
    assert not found.lost.any()
    assert found.textured
    assert position.mean() < 0.3e-3
    assert rotation.mean() < 0.5


def test_an_untextured_block_is_tracked_by_depth_and_edges(plain):
    found = cw.track(plain.recording, pose={"block": plain.poses[0]}).track("block")
    position, rotation = errors(found, plain.poses)
    assert not found.textured
    assert "open: no texture was found" in found.sentence()
    assert "cube" in found.symmetry
    assert position.mean() < 0.6e-3
    assert rotation.mean() < 1.5


def test_intervals_cover_the_errors_and_are_not_idle(plain):
    found = cw.track(plain.recording, pose={"block": plain.poses[0]}).track("block")
    twist = np.array([twist_between(t, p) for t, p in zip(plain.poses, found.pose, strict=True)])
    std = np.sqrt(np.einsum("tii->ti", found.covariance))
    assert (np.abs(twist) < 1.96 * std).mean() > 0.85
    assert std[:, :3].max() < 1.5e-3
    assert np.degrees(std[:, 3:].max()) < 2.5


@pytest.mark.parametrize(("shift", "turn"), [(0.003, 8.0), (0.01, 0.0), (0.008, 6.0)])
def test_a_wrong_first_pose_is_pulled_to_the_shape(plain, shift, turn):
    start = moved(plain.poses[0], np.concatenate([shift * AXIS, np.radians(turn) * AXIS]))
    found = cw.track(changed(plain, slice(2)), pose={"block": start}).track("block")
    position, rotation = errors(found, plain.poses[:2])
    assert position.max() < 1e-3
    assert rotation.max() < 2


def test_a_first_pose_far_off_is_refused_and_not_silently_accepted(plain):
    away = moved(plain.poses[0], np.array([0, 0.06, 0, 0, 0, 0]))
    with pytest.raises(cw.RecordingError, match=r"first pose of 'block' .*first frame|first frame.*first pose"):
        cw.track(changed(plain, slice(2)), pose={"block": away})


def test_the_first_pose_is_found_without_prior_up_to_the_symmetry(plain):
    found = cw.track(changed(plain, slice(2)), pose="none").track("block")
    error = np.linalg.norm(found.pose[:, :3, 3] - plain.poses[:2, :3, 3], axis=1)
    turned = np.abs(found.pose[0, :3, :3].T @ plain.poses[0, :3, :3])
    assert error.max() < 1e-3
    # The axes of a cube are those of its other poses in another order.
    assert turned.max(axis=0) == pytest.approx(1.0, abs=1e-3)


def test_a_lost_body_is_nan_and_is_found_again_elsewhere(textured):
    recording = changed(textured)
    stream = recording[0].image["camera"]
    rgb, depth = stream.rgb.copy(), stream.depth.copy()
    rgb[3:6], depth[3:6] = 40, 0.3
    hidden = {"camera": replace(stream, rgb=rgb, depth=depth)}
    found = cw.track(changed(textured, image=hidden), pose={"block": textured.poses[0]}, images=True)
    track = found.track("block")
    assert track.lost[3:6].all()
    assert not track.lost[[0, 1, 2, 7, 8, 9, 10, 11]].any()
    seen = ~track.lost
    twist = np.array([twist_between(textured.poses[t], track.pose[t]) for t in np.flatnonzero(seen)])
    assert np.linalg.norm(twist[:, :3], axis=1).max() < 1.5e-3
    channel = found.recording[0].measured["block_position"]
    assert channel.covariance is not None
    assert np.isnan(channel.value[3:6]).all()
    assert np.isnan(channel.covariance[3:6]).all()
    assert "camera" in found.recording[0].image


def test_a_body_that_is_nowhere_is_refused_with_a_reason(plain):
    recording = changed(plain, slice(2))
    stream = recording[0].image["camera"]
    wall = {"camera": replace(stream, depth=np.full_like(stream.depth, 0.2))}
    with pytest.raises(cw.RecordingError, match=r"no body was found.*block: "):
        cw.track(changed(plain, image=wall), pose="none")


def test_poses_are_measurements_with_covariances_and_the_truth_is_gone(textured, tracked, tmp_path):
    before, after = textured.recording[0], tracked.recording[0]
    position, orientation = after.measured["block_position"], after.measured["block_orientation"]
    assert len(position.time) == len(textured.poses)
    assert len(before.measured["block_position"].time) != len(position.time)
    assert position.covariance.shape == (len(position.time), 3, 3)
    assert orientation.covariance.shape == (len(position.time), 3, 3)
    rms = np.sqrt(np.einsum("tii->ti", position.covariance).mean())
    assert position.noise_std == pytest.approx(rms)
    np.testing.assert_allclose(after.qpos[9:12], position.value[0], atol=1e-12)
    points = after.points["block"]
    assert points.visible.sum(axis=1).min() >= 5
    np.testing.assert_array_equal(np.isfinite(points.value).all(axis=2), points.visible)
    assert not after.image
    cw.write_hdf5(tracked.recording, tmp_path / "tracked.h5")
    read = cw.load_recording(tmp_path / "tracked.h5")[0].measured["block_position"]
    np.testing.assert_array_equal(read.covariance, position.covariance)


def test_measured_poses_are_not_read_and_stay_if_asked(textured, tracked):
    measured = dict(textured.recording[0].measured)
    channel = measured["block_position"]
    measured["block_position"] = Channel(channel.time, channel.value + np.array([0.1, 0, 0]), channel.noise_std)
    recording = changed(textured, measured=measured)
    found = cw.track(recording, pose={"block": textured.poses[0]}, keep_measured=True)
    np.testing.assert_array_equal(found.track("block").pose, tracked.track("block").pose)
    assert found.recording[0].measured["block_position"] is measured["block_position"]


def test_sensors_are_added_under_names_like_those_of_other_bodies(textured):
    spec = cw.Scene(textured.recording.scene).spec()
    for name in ("block_position", "block_orientation"):
        spec.delete(spec.sensor(name))
    scene = cw.Scene.from_spec(spec).xml
    measured = {n: c for n, c in textured.recording[0].measured.items() if not n.startswith("block")}
    recording = replace(changed(textured, slice(2), measured=measured), scene=scene)
    found = cw.track(recording, pose={"block": textured.poses[0]})
    assert {"block_position", "block_orientation"} <= set(found.recording[0].measured)


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"image": {}}, {}, "no RGB-D video"),
        ({}, {"cameras": ["left"]}, "no such camera"),
        ({}, {"bodies": ["box"]}, "free joint"),
        ({}, {"pose": {"lid": np.eye(4)}}, "not tracked"),
        ({}, {"pose": {"block": np.diag([1.0, 1, -1, 1])}}, "no transform"),
        ({}, {"pose": "nowhere.toml"}, "not a TOML file"),
    ],
)
def test_what_cannot_be_tracked_is_refused_in_one_sentence(textured, changes, options, message):
    with pytest.raises(cw.RecordingError, match=message):
        cw.track(changed(textured, slice(2), **changes), **options)
