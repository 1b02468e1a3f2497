from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.perception.point_tracking import TrackingCfg, track_points
from concent_warp.perception.rigid_motion import inverse, transformed
from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.sensors.camera import record_depth_images
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.recording.validation.validate import validate
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.surface import Surface

START, STOP, RATE = 2.0, 4.0, 20.0
"""The window in which the block is lifted, carried and set down on the box [s], and the camera's rate [Hz]."""


@pytest.fixture(scope="module")
def carried() -> tuple[Recording, np.ndarray]:
    """The video of the transfer alone, and the true states in its frames."""
    cfg = RealityCfg()
    sensing = replace(cfg.sensing, image_size=(180, 240), camera_fovy=15.0)
    recording, truths = record(cfg, [0])
    time = np.arange(0, STOP - START + 1e-9, 1 / RATE)
    qpos = truths[0].qpos[np.round((START + time) / cfg.world.timestep).astype(int)]
    scene = Scene(recording.scene)
    stream = record_depth_images(sensing, cfg.world.build(scene), scene.objects(), time, qpos, np.random.default_rng(0))
    return Recording(recording.scene, (Demonstration("demo_0", qpos=qpos[0], image={"camera": stream}),)), qpos


@pytest.fixture(scope="module")
def tracked(carried) -> Demonstration:
    return track_points(carried[0], carried[0][0])


def poses(scene: Scene, qpos: np.ndarray, body: str) -> np.ndarray:
    """Return the true poses of a body, shape (T, 4, 4)."""
    data = mujoco.MjData(scene.model)
    result = np.repeat(np.eye(4)[None], len(qpos), axis=0)
    for t, state in enumerate(qpos):
        data.qpos[:] = state
        mujoco.mj_kinematics(scene.model, data)
        result[t, :3, :3], result[t, :3, 3] = data.body(body).xmat.reshape(3, 3), data.body(body).xpos
    return result


def still(recording: Recording, frames: int) -> Recording:
    """Return a video in which nothing moves: the first frame again and again."""
    stream = recording[0].image["camera"]
    repeated = replace(
        stream,
        time=np.arange(frames) / RATE,
        rgb=np.repeat(stream.rgb[:1], frames, axis=0),
        depth=np.repeat(stream.depth[:1], frames, axis=0),
    )
    return replace(recording, demonstrations=(replace(recording[0], image={"camera": repeated}),))


@pytest.mark.parametrize(("body", "travel"), [("block", 0.15), ("box", 0.0)])
def test_tracked_points_move_with_the_body_within_a_millimetre(carried, tracked, body, travel):
    recording, qpos = carried
    scene = Scene(recording.scene)
    truth, track = poses(scene, qpos, body), tracked.points[body]
    assert np.linalg.norm(np.ptp(truth[:, :3, 3], axis=0)) >= travel
    assert track.visible.sum(axis=1).min() >= 15
    error, surface = [], []
    first = track.visible.argmax(axis=0)
    solid = Surface.of_body(scene, body)
    for t in range(len(track.time)):
        rows = np.flatnonzero(track.visible[t])
        # Where true motion takes each point from where it was first seen.
        local = np.array([transformed(inverse(truth[first[k]]), track.value[first[k], k][None])[0] for k in rows])
        error.append(np.linalg.norm(transformed(truth[t], local) - track.value[t, rows], axis=1))
        surface.append(np.abs(solid.signed_distance(transformed(inverse(truth[t]), track.value[t, rows]))))
    assert np.concatenate(error).mean() < 0.6e-3
    assert np.concatenate(error).max() < 3e-3
    assert np.concatenate(surface).mean() < 0.8e-3


def test_points_stay_for_long_and_pass_validation(carried, tracked):
    validate(replace(carried[0], demonstrations=(tracked,)))
    for track in tracked.points.values():
        np.testing.assert_array_equal(np.isfinite(track.value).all(axis=2), track.visible)
        lives = track.visible.sum(axis=0)
        assert lives.min() >= 1
        assert np.mean(lives) >= 8
        assert lives.max() >= 0.9 * len(track.time)


def test_tracking_is_deterministic_and_bodies_do_not_disturb_each_other(carried, tracked):
    alone = track_points(carried[0], carried[0][0], bodies=["block"])
    assert list(alone.points) == ["block"]
    np.testing.assert_array_equal(alone.points["block"].value, tracked.points["block"].value)


def test_a_body_that_was_hidden_for_a_while_is_found_again_where_it_was(carried):
    recording = still(carried[0], 6)
    stream = recording[0].image["camera"]
    stream.rgb[2:4], stream.depth[2:4] = 40, 0.3
    track = track_points(recording, recording[0]).points["block"]
    assert not track.visible[2:4].any()
    assert track.visible[[0, 1, 4, 5]].sum(axis=1).min() >= 15
    centre = [track.value[t, track.visible[t]].mean(axis=0) for t in (0, 5)]
    assert np.linalg.norm(centre[0] - centre[1]) < 3e-3


def test_a_still_body_does_not_drift(carried):
    recording = still(carried[0], 5)
    track = track_points(recording, recording[0]).points["block"]
    kept = track.visible.all(axis=0)
    assert kept.sum() > 15
    assert np.abs(np.ptp(track.value[:, kept], axis=0)).max() < 1e-5


def test_existing_points_of_other_bodies_are_kept(carried, tracked):
    before = replace(carried[0][0], points={"box": tracked.points["box"]})
    recording = replace(still(carried[0], 2), source="here")
    after = track_points(recording, replace(before, image=recording[0].image), bodies=["block"])
    assert set(after.points) == {"block", "box"}
    assert after.points["box"] is tracked.points["box"]


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"image": {}}, {}, "one RGB-D stream"),
        ({"qpos": None}, {}, "state of the scene"),
        ({"qpos": np.zeros(3)}, {}, "found 3 numbers"),
        ({}, {"camera": "left"}, "no such RGB-D stream"),
        ({}, {"bodies": ["lid"]}, "no such body"),
        ({}, {"bodies": ["link1"]}, "cannot be tracked"),
    ],
)
def test_what_cannot_be_tracked_is_refused_in_one_sentence(carried, change, options, message):
    recording = still(carried[0], 2)
    with pytest.raises(RecordingError, match=message):
        track_points(recording, replace(recording[0], **change), TrackingCfg(), **options)
