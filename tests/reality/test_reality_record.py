from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.reality.hidden.in_task import TaskWorld
from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.sensors.camera import CAMERA
from concent_warp.reality.world import HiddenEffect
from concent_warp.recording.recording import Demonstration
from concent_warp.recording.validation.validate import validate
from concent_warp.scene.scene import Scene

SHIFT = np.array([0.005, 0.0, 0.0])


@pytest.fixture(scope="module")
def filmed(shown):
    """The first demonstration again, with images, and with a pose tracker that reads beside the box."""
    cfg, _, _ = shown
    sensing = replace(cfg.sensing, images=True, image_rate=3.0, image_size=(48, 64))
    shifted = HiddenEffect(
        "shifted tracker",
        measure=lambda name, time, value: (time, value + SHIFT if name == "box_position" else value),
    )
    return record(replace(cfg, sensing=sensing), [0], effects=(shifted,))


def channels(demonstration: Demonstration) -> dict[str, np.ndarray]:
    named = {}
    for kind in ("action", "measured", "points"):
        for name, channel in getattr(demonstration, kind).items():
            named[f"{kind}/{name}"] = np.concatenate([channel.time.ravel(), channel.value.ravel()])
    return named


def test_expert_puts_the_block_into_the_hole_on_every_seed(shown):
    cfg, recording, truths = shown
    assert [truth.success for truth in truths] == [True, True, True]
    assert [d.success for d in recording.demonstrations] == [True, True, True]
    for truth in truths:
        assert np.abs(truth.block_position[-1, :2] - cfg.task.box_position).max() < 1.5e-3
        # It was held by the gripper, then touched the box, and at last rests in it, let go.
        held = truth.contacts["block", "left_finger"] & truth.contacts["block", "right_finger"]
        inside = truth.contacts["block", "box"]
        assert 0 < held.argmax() < inside.argmax()
        assert inside[-1]
        assert not held[-1]


@pytest.mark.parametrize(
    ("effect", "magnitude"), [("backlash", 0.005), ("joint_compliance", 0.003), ("gravity_compensation", -0.2)]
)
def test_expert_succeeds_with_drives_that_are_not_nominal_and_starts_at_rest(shown, effect, magnitude):
    cfg, plain, _ = shown
    world = TaskWorld(cfg.task.build(), cfg.world, "block", cfg.task.robot.gripper_actuators, ((effect, magnitude),))
    recording, truths = record(cfg, [0], effects=tuple(one.effect for one in world.hidden()))
    assert truths[0].success
    # Commands are those of an expert who knows the drives as they are drawn.
    for name, channel in plain.demonstrations[0].action.items():
        np.testing.assert_allclose(recording.demonstrations[0].action[name].value, channel.value, atol=1e-6)
    start, soon = truths[0].qpos[0], truths[0].qpos[np.searchsorted(truths[0].time, 0.05)]
    assert np.abs(soon - start)[:7].max() < 5e-4


def test_seeds_give_different_demonstrations(shown):
    _, recording, _ = shown
    starts = np.array([d.qpos for d in recording.demonstrations])
    assert np.linalg.norm(starts[0] - starts[1]) > 1e-3
    assert np.linalg.norm(starts[1] - starts[2]) > 1e-3


def test_same_seed_gives_the_identical_recording_even_where_images_are_added(shown, filmed):
    _, recording, truths = shown
    again, again_truths = filmed
    first, second = channels(recording[0]), channels(again[0])
    assert first.keys() == second.keys()
    for name in first.keys() - {"measured/box_position"}:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)
    np.testing.assert_array_equal(truths[0].qpos, again_truths[0].qpos)


def test_hidden_measurement_effect_changes_what_is_written_and_nothing_else(shown, filmed):
    honest, shifted = shown[1][0].measured["box_position"], filmed[0][0].measured["box_position"]
    np.testing.assert_allclose(shifted.value - honest.value, np.broadcast_to(SHIFT, honest.value.shape), atol=1e-12)


def test_recordings_pass_validation_with_and_without_images(shown, filmed):
    validate(shown[1])
    validate(filmed[0])
    assert list(filmed[0][0].image) == [CAMERA]
    assert not shown[1][0].image


def test_measured_channels_hold_the_truth_and_the_noise_they_claim(shown):
    cfg, recording, truths = shown
    for demonstration, truth in zip(recording.demonstrations, truths, strict=True):
        measured = demonstration.measured["block_position"]
        actual = np.stack([np.interp(measured.time, truth.time, truth.block_position[:, i]) for i in range(3)], axis=1)
        noise = measured.value - actual
        assert measured.noise_std == cfg.sensing.position_std
        assert np.std(noise) == pytest.approx(cfg.sensing.position_std, rel=0.1)
        assert np.abs(noise.mean(axis=0)).max() < 4 * cfg.sensing.position_std / np.sqrt(len(noise))
        assert np.diff(measured.time) == pytest.approx(1 / cfg.sensing.pose_rate, abs=1.1e-3)


def test_tracked_points_lie_on_the_moving_block_within_their_noise(shown):
    cfg, recording, truths = shown
    model = Scene(recording.scene).model
    data = mujoco.MjData(model)
    track = recording[0].points["block"]
    local = np.full(track.value.shape, np.nan)
    for t, time in enumerate(track.time):
        data.qpos[:] = truths[0].qpos[np.searchsorted(truths[0].time, time - 1e-9)]
        mujoco.mj_kinematics(model, data)
        body = data.body("block")
        local[t] = (track.value[t] - body.xpos) @ body.xmat.reshape(3, 3)
    # A point is a material point: in the frame of the block only the noise is left of its motion.
    seen = track.visible.sum(axis=0) > 20
    spread = np.nanstd(local[:, seen], axis=0)
    assert seen.sum() > 50
    assert np.sqrt((spread**2).mean()) == pytest.approx(cfg.sensing.point_std, rel=0.05)
    surface = np.abs(np.nanmean(local[:, seen], axis=0)).max(axis=1)
    assert np.abs(surface - cfg.task.block_size / 2).max() < 1.5e-3


def test_points_are_missing_exactly_where_they_are_not_visible(shown):
    _, recording, _ = shown
    for demonstration in recording.demonstrations:
        for track in demonstration.points.values():
            np.testing.assert_array_equal(np.isfinite(track.value).all(axis=2), track.visible)


def test_gripper_and_hole_hide_points_of_the_block(shown):
    _, recording, truths = shown
    for demonstration, truth in zip(recording.demonstrations, truths, strict=True):
        track = demonstration.points["block"]
        share = track.visible.mean(axis=1)
        held = np.interp(track.time, truth.time, truth.contacts["block", "left_finger"].astype(float)) > 0.5
        assert share[0] == 1.0
        assert 0.1 < share[held].mean() < 0.9
        assert share[-1] < 0.9


def test_box_pushes_the_block_only_in_contact_and_carries_it_at_the_end(shown):
    _, _, truths = shown
    for truth in truths:
        touching = truth.contacts["block", "box"]
        force = np.linalg.norm(truth.box_force, axis=1)
        assert force[~touching].max() == 0
        # At rest in the hole the box carries the block's weight.
        assert truth.box_force[-50:, 2].mean() == pytest.approx(0.08 * 9.81, rel=0.05)


def test_progress_rises_to_one():
    shares: list[float] = []
    cfg = RealityCfg()
    quick = replace(cfg, expert=replace(cfg.expert, speed=4.0, rate=20.0), world=replace(cfg.world, timestep=0.002))
    record(quick, [0], progress=shares.append)
    assert shares == sorted(shares)
    assert 0.9 < shares[-1] <= 1.0
