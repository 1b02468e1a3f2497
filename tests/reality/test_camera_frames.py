from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.perception.pinhole import Pinhole, pixel_grid
from concent_warp.reality.sensors.camera import _edges, record_depth_images
from concent_warp.reality.sensors.sensing import SensingCfg, are_visible
from concent_warp.scene.shape_sorter import ShapeSorterCfg, home

SCENE = ShapeSorterCfg().build()
SENSING = SensingCfg(image_size=(120, 160))


@pytest.fixture(scope="module")
def scenes(shown):
    """The world, and frames of it at rest, in the grasp and with the block in the hole."""
    cfg, _, truths = shown
    world = cfg.world.build(SCENE)
    held = int(truths[0].contacts["block", "left_finger"].argmax()) + 800
    qpos = truths[0].qpos[[0, held, -1]]
    stream = record_depth_images(SENSING, world, SCENE.objects(), np.arange(3) / 10, qpos, np.random.default_rng(0))
    return world.compile(), qpos, stream


def cast(model: mujoco.MjModel, qpos: np.ndarray, camera: Pinhole, height: int, width: int):
    """Return the geom id and the planar depth [m] that C MuJoCo's rays meet at every pixel, shapes (H, W)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    pixels = pixel_grid(height, width).reshape(-1, 2)
    ray = camera.lift(pixels, np.ones(len(pixels))) - camera.position
    length = np.linalg.norm(ray, axis=1)
    geom, hit = np.zeros(len(ray), dtype=np.int32), np.zeros(len(ray))
    found = np.zeros(1, dtype=np.int32)
    for i, direction in enumerate(ray / length[:, None]):
        hit[i] = mujoco.mj_ray(model, data, camera.position, direction, None, 1, -1, found, None)
        geom[i] = found[0]
    depth = np.where(geom >= 0, hit / length, 0.0)
    return geom.reshape(height, width), depth.reshape(height, width)


def test_depth_is_that_of_the_physical_surfaces_within_the_noise_of_the_camera(scenes):
    model, qpos, stream = scenes
    for t in range(3):
        _, expected = cast(model, qpos[t], Pinhole.of(stream), *SENSING.image_size)
        measured = stream.depth[t]
        sure = (expected > 0) & (measured > 0) & ~_edges(expected, 0.008)
        assert sure.mean() > 0.85
        scaled = (measured - expected)[sure] / (SENSING.depth_noise * expected[sure] ** 2)
        assert abs(scaled.mean()) < 0.03
        assert scaled.std() == pytest.approx(1.0, abs=0.05)
        assert (np.abs(scaled) < 5).mean() > 0.999


def test_depth_lifted_with_intrinsics_and_pose_lands_on_table_and_block(scenes):
    model, qpos, stream = scenes
    camera = Pinhole.of(stream)
    geom, expected = cast(model, qpos[0], camera, *SENSING.image_size)
    sure = (stream.depth[0] > 0) & ~_edges(expected, 0.008)
    points = camera.lift(pixel_grid(*SENSING.image_size), stream.depth[0])
    table = points[sure & (geom == model.geom("table").id)]
    assert len(table) > 5000
    assert abs(table[:, 2].mean()) < 1e-4
    assert table[:, 2].std() < 1.5e-3
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[0]
    mujoco.mj_kinematics(model, data)
    body = data.body("block")
    local = (points[sure & (geom == model.geom("block").id)] - body.xpos) @ body.xmat.reshape(3, 3)
    assert len(local) > 100
    off = np.abs(np.abs(local).max(axis=1) - ShapeSorterCfg().block_size / 2)
    assert off.mean() < 1.5e-3
    assert np.quantile(off, 0.99) < 5e-3


def test_depth_is_lost_only_at_edges_and_reported_in_steps(scenes):
    model, qpos, stream = scenes
    _, expected = cast(model, qpos[1], Pinhole.of(stream), *SENSING.image_size)
    edge = _edges(expected, SENSING.depth_jump)
    lost = (stream.depth[1] == 0) & (expected > 0)
    assert lost.sum() > 50
    assert (lost & edge).sum() > 0.97 * lost.sum()
    assert lost[edge].mean() == pytest.approx(SENSING.depth_dropout, abs=0.1)
    steps = stream.depth[1] / SENSING.depth_step
    np.testing.assert_array_equal(steps, np.round(steps))


def test_colours_show_the_objects_where_the_geometry_is(scenes):
    model, qpos, stream = scenes
    geom, _ = cast(model, qpos[0], Pinhole.of(stream), *SENSING.image_size)
    block = stream.rgb[0][geom == model.geom("block").id].astype(float)
    box = stream.rgb[0][np.isin(geom, np.flatnonzero(model.geom_bodyid == model.body("box").id))].astype(float)
    table = stream.rgb[0][geom == model.geom("table").id].astype(float)
    assert block[:, 0].mean() > 1.5 * block[:, 2].mean()
    assert box[:, 2].mean() > 1.5 * box[:, 0].mean()
    # The objects carry a pattern; what is left on the table is shading and noise.
    assert block[:, 0].std() > 15
    assert box[:, 2].std() > 15
    assert table[:, 0].std() > 0


def test_pattern_is_fixed_to_the_body():
    """Where the body goes, its pattern goes: brightness at the same points of the body is alike before and after."""
    world = SCENE.spec()
    model = SCENE.model
    sensing = replace(SENSING, image_size=(240, 320), rgb_std=0.0)
    start, end = home(model), home(model)
    address = model.joint("block_joint").qposadr[0]
    end[address : address + 3] += [0.03, -0.02, 0.01]
    end[address + 3 : address + 7] = [np.cos(0.1), 0, 0, np.sin(0.1)]
    stream = record_depth_images(
        sensing, world, SCENE.objects(), np.arange(2.0), np.array([start, end]), np.random.default_rng(0)
    )
    u, v = np.meshgrid(np.linspace(-0.016, 0.016, 40), np.linspace(-0.016, 0.016, 40))
    top = np.stack([u.ravel(), v.ravel(), np.full(u.size, 0.02)], axis=1)
    sampled = []
    for t, qpos in enumerate((start, end)):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        body = data.body("block")
        pixel, _ = Pinhole.of(stream).project(body.xpos + top @ body.xmat.reshape(3, 3).T)
        column, row = np.round(pixel).astype(int).T
        sampled.append(stream.rgb[t, row, column].sum(axis=1).astype(float))
    assert np.corrcoef(*sampled)[0, 1] > 0.8
    assert np.corrcoef(sampled[0], np.roll(sampled[1], 400))[0, 1] < 0.4


def test_filming_leaves_the_world_as_it_is():
    world = SCENE.spec()
    before = world.to_xml()
    record_depth_images(SENSING, world, SCENE.objects(), np.zeros(1), home(SCENE.model)[None], np.random.default_rng(0))
    assert world.to_xml() == before


def test_worlds_that_only_c_mujoco_can_move_are_filmed_all_the_same():
    world = SCENE.spec()
    world.option.noslip_iterations = 3
    for actuator in world.actuators:
        actuator.delay, actuator.nsample = 0.01, 4
    world.compile()
    stream = record_depth_images(
        SENSING, world, SCENE.objects(), np.zeros(1), home(SCENE.model)[None], np.random.default_rng(0)
    )
    plain = record_depth_images(
        SENSING, SCENE.spec(), SCENE.objects(), np.zeros(1), home(SCENE.model)[None], np.random.default_rng(0)
    )
    np.testing.assert_array_equal(stream.depth, plain.depth)
    assert stream.depth.max() > 0.5


def test_points_outside_the_image_are_not_seen():
    model = SCENE.model
    data = mujoco.MjData(model)
    data.qpos[:] = home(model)
    mujoco.mj_forward(model, data)
    camera = SENSING.pinhole()
    height, width = SENSING.image_size
    corners = np.array([[0.0, height - 1], [width - 1, height - 1], [width / 2, height / 2]])
    _, depth = cast(model, data.qpos, camera, height, width)
    inside = camera.lift(corners, np.array([depth[-1, 0], depth[-1, -1], depth[height // 2, width // 2]]))
    np.testing.assert_array_equal(are_visible(SENSING, model, data, inside, SENSING.visibility_slack), True)
    pixels = np.array([[width + 2.0, 60], [80, height + 2.0], [-3, 60], [80, 60]])
    outside = camera.lift(pixels, np.array([0.5, 0.5, 0.5, -0.5]))
    np.testing.assert_array_equal(are_visible(SENSING, model, data, outside, SENSING.visibility_slack), False)
    # Nearer and in view, a point in the air is seen; under the table it is not.
    between = camera.lift(corners[2:], np.array([0.5]))
    assert are_visible(SENSING, model, data, between, SENSING.visibility_slack)[0]
    assert not are_visible(SENSING, model, data, np.array([[0.48, -0.02, -0.1]]), SENSING.visibility_slack)[0]


def test_camera_looks_at_its_target_upright():
    camera = SENSING.pinhole()
    pixel, depth = camera.project(np.array(SENSING.camera_target))
    height, width = SENSING.image_size
    np.testing.assert_allclose(pixel, [(width - 1) / 2, (height - 1) / 2], atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm(np.subtract(SENSING.camera_target, SENSING.camera_position)))
    above, _ = camera.project(np.add(SENSING.camera_target, [0, 0, 0.05]))
    assert above[0] == pytest.approx(pixel[0])
    assert above[1] < pixel[1]
