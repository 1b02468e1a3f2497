"""Contact-pair features and reaching reward against plain float64 loops."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from rigid_poses import Poses, on_each_device, outputs, turn

from concent_warp.kernels import contact_pairs
from concent_warp.kernels.contact_pairs import SLOT_COUNT, SLOT_SIZE, ContactPairs, PairTable

AMPLITUDE, SIGMA = (1.0, 2.0), (0.05, 0.008)
NAMES = ("features", "distance", "worst", "worst_distance", "reach", "finite")


def random_table(stages=4, slots=SLOT_COUNT, bodies=6, seed=1):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(stages, slots, 3))
    active = rng.random((stages, slots)) < 0.6
    active[0] = False
    return PairTable(
        body_a=rng.integers(0, bodies, (stages, slots)),
        point_a=rng.uniform(-0.1, 0.1, (stages, slots, 3)),
        radius_a=rng.uniform(0, 0.02, (stages, slots)),
        body_b=rng.integers(0, bodies, (stages, slots)),
        point_b=rng.uniform(-0.1, 0.1, (stages, slots, 3)),
        radius_b=rng.uniform(0, 0.02, (stages, slots)),
        normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        active=active,
    )


def one_pair(point_a=(0, 0, 0), point_b=(0, 0, 0), radius_a=0.0, radius_b=0.0, normal=(0, 0, 1)):
    """One stage with one active slot of two: a point of body 0 and a target on body 1."""
    return PairTable(
        body_a=np.array([[0, 0]]),
        point_a=np.array([[point_a, (np.nan,) * 3]]),
        radius_a=np.array([[radius_a, 0.0]]),
        body_b=np.array([[1, 99]]),
        point_b=np.array([[point_b, (0, 0, 0)]]),
        radius_b=np.array([[radius_b, 0.0]]),
        normal=np.array([[normal, (0, 0, 0)]]),
        active=np.array([[True, False]]),
    )


def reference(table, poses):
    """Features (W, N * 13), distances (W, N), worst slots, their distances and reaching rewards (W, 2), in float64."""
    worlds, slots = len(poses.stage), table.active.shape[1]
    features, distance = np.zeros((worlds, slots, 13)), np.full((worlds, slots), -1.0)
    worst, farthest, reach = np.full(worlds, -1), np.zeros(worlds), np.zeros((worlds, 2))
    for w, s in enumerate(poses.stage):
        if not 0 <= s < len(table.active):
            continue
        for i in np.flatnonzero(table.active[s]):
            a, b = table.body_a[s, i], table.body_b[s, i]
            position, quaternion = poses.position[w], poses.quaternion[w]
            normal = turn(quaternion[b], table.normal[s, i])
            contact = position[a] + turn(quaternion[a], table.point_a[s, i]) - table.radius_a[s, i] * normal
            target = position[b] + turn(quaternion[b], table.point_b[s, i]) + table.radius_b[s, i] * normal
            distance[w, i] = np.linalg.norm(target - contact)
            direction = (target - contact) / distance[w, i]
            features[w, i] = [1, *contact, *(target - contact), *direction, *normal]
        if table.active[s].any():
            worst[w] = np.argmax(distance[w])
            farthest[w] = distance[w].max()
            reach[w] = [A * np.exp(-farthest[w] / sigma) for A, sigma in zip(AMPLITUDE, SIGMA, strict=True)]
    return features.reshape(worlds, -1), distance, worst, farthest, reach


def assert_matches(pairs, table, poses):
    features, distance, worst, farthest, reach = reference(table, poses)
    found = outputs(pairs, NAMES)
    np.testing.assert_allclose(found["features"], features, atol=2e-6)
    np.testing.assert_allclose(found["distance"], distance, atol=1e-6)
    np.testing.assert_array_equal(found["worst"], worst)
    np.testing.assert_allclose(found["worst_distance"], farthest, atol=1e-6)
    np.testing.assert_allclose(found["reach"], reach, rtol=1e-4, atol=1e-7)
    assert (found["finite"] == 1).all()


@on_each_device
def test_features_and_reward_match_float64(device):
    table, poses = random_table(), Poses(200, 6, device, spread=0.1, stages=4)
    poses.stage[:2] = -1, 4
    poses.upload()
    pairs = ContactPairs(table, *poses.arrays, amplitude=AMPLITUDE, sigma=SIGMA)
    pairs.launch()
    assert_matches(pairs, table, poses)


def test_slots_are_the_104_numbers_of_the_observation_table():
    assert SLOT_SIZE * SLOT_COUNT == 104
    assert 14 + 7 + 1 + 1 + 3 + 9 + 9 + SLOT_SIZE * SLOT_COUNT == 148


@on_each_device
def test_world_without_active_slot_has_reached_nothing(device):
    table, poses = random_table(), Poses(3, 6, device)
    poses.stage[:] = 0, -1, 4
    poses.upload()
    pairs = ContactPairs(table, *poses.arrays)
    pairs.launch()
    found = outputs(pairs, NAMES)
    assert not found["features"].any()
    assert not found["reach"].any()
    assert (found["distance"] == -1).all()
    assert (found["worst"] == -1).all()
    assert (found["finite"] == 1).all()


@on_each_device
def test_coincident_points_have_no_direction_and_the_whole_reward(device):
    poses = Poses(1, 2, device)
    poses.position[0, 1] = poses.position[0, 0]
    poses.upload()
    pairs = ContactPairs(one_pair(), *poses.arrays, amplitude=AMPLITUDE, sigma=SIGMA)
    pairs.launch()
    found = outputs(pairs, NAMES)
    assert not found["features"][0, 4:10].any()
    assert found["features"][0, 0] == 1
    np.testing.assert_allclose(found["reach"][0], AMPLITUDE)
    assert found["worst"][0] == 0


def test_direction_has_no_jump_where_points_meet():
    poses = Poses(5, 2, "cpu", spread=0)
    gaps = np.array([1e-3, 1e-6, 5e-7, 1e-8, 0.0])
    poses.position[:, 1, 0] = gaps
    poses.upload()
    pairs = ContactPairs(one_pair(), *poses.arrays)
    pairs.launch()
    length = np.linalg.norm(pairs.features.numpy()[:, 7:10], axis=1)
    np.testing.assert_allclose(length, np.minimum(gaps / 1e-6, 1), atol=1e-5)


def test_spheres_touching_along_the_normal_have_distance_zero():
    poses = Poses(1, 2, "cpu")
    poses.position[0, 0] = poses.position[0, 1] + turn(poses.quaternion[0, 1], np.array([0, 0, 0.035]))
    poses.upload()
    pairs = ContactPairs(one_pair(radius_a=0.01, radius_b=0.025), *poses.arrays)
    pairs.launch()
    assert pairs.distance.numpy()[0, 0] == pytest.approx(0, abs=1e-7)


@on_each_device
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_pose_that_is_not_sane_is_flagged_and_stays_in_its_world(device, value):
    table, poses = random_table(), Poses(30, 6, device, spread=0.1, stages=4)
    poses.stage[:3] = 1, 2, 0
    poses.upload()
    pairs = ContactPairs(table, *poses.arrays)
    pairs.launch()
    before = outputs(pairs, NAMES)
    poses.position[0, table.body_a[1, np.argmax(table.active[1])]] = value
    poses.quaternion[1, table.body_b[2, np.argmax(table.active[2])]] = value
    poses.position[2] = value
    poses.upload()
    pairs.launch()
    after = outputs(pairs, NAMES)
    np.testing.assert_array_equal(after["finite"], [0, 0, *[1] * 28])
    assert np.isnan(after["distance"][:2]).any(axis=1).all()
    assert not after["reach"][:3].any()
    assert (after["worst"][:3] == -1).all()
    assert np.isfinite(after["features"]).all()
    assert np.abs(after["features"]).max() < 10
    for name in NAMES:
        np.testing.assert_array_equal(after[name][3:], before[name][3:])


def test_of_pairs_equally_far_the_first_is_the_worst():
    table = one_pair(point_b=(0.1, 0, 0))
    table = replace(table, point_a=np.zeros((1, 2, 3)), body_b=np.array([[1, 1]]), active=np.array([[True, True]]))
    table.point_b[:] = 0.1, 0, 0
    poses = Poses(1, 2, "cpu")
    pairs = ContactPairs(table, *poses.arrays)
    pairs.launch()
    assert pairs.worst.numpy()[0] == 0


@on_each_device
def test_features_can_be_written_into_an_observation(device):
    import torch

    table, poses = random_table(), Poses(20, 6, device, stages=4)
    observation = torch.full((20, 148), 7.0, device=device)
    pairs = ContactPairs(table, *poses.arrays, features=wp.from_torch(observation[:, 44:]))
    pairs.launch()
    wp.synchronize_device(device)
    assert (observation[:, :44] == 7).all()
    np.testing.assert_allclose(observation[:, 44:].cpu(), reference(table, poses)[0], atol=2e-6)


@on_each_device
def test_captured_graph_follows_poses_and_stages(device):
    table, poses = random_table(), Poses(50, 6, device, stages=4)
    pairs = ContactPairs(table, *poses.arrays, amplitude=AMPLITUDE, sigma=SIGMA)
    with wp.ScopedCapture(device=device) as capture:
        pairs.launch()
    poses.position += 0.01
    poses.stage[:] = (poses.stage + 1) % 4
    poses.upload()
    assert capture.graph is not None
    wp.capture_launch(capture.graph)
    poses.position = poses.position.astype(np.float32).astype(float)
    assert_matches(pairs, table, poses)


def test_what_cannot_be_is_refused():
    table, poses = random_table(), Poses(3, 6, "cpu")
    xpos, xquat, stage = poses.arrays
    few = Poses(3, 2, "cpu")
    for match, make in (
        ("point_a must be of shape", lambda: replace(table, point_a=table.point_a[:2])),
        ("not finite", lambda: replace(table, radius_b=np.full(table.active.shape, np.nan))),
        ("length 1", lambda: replace(table, normal=2 * table.normal)),
        ("active must be", lambda: replace(table, active=np.ones(3, dtype=bool))),
        ("must be in 0..1", lambda: ContactPairs(table, *few.arrays)),
        ("sigma", lambda: ContactPairs(table, *poses.arrays, sigma=(0.05, 0.0))),
        ("xquat must be", lambda: ContactPairs(table, xpos, xpos, stage)),
        ("stage must be", lambda: ContactPairs(table, xpos, xquat, wp.zeros(2, dtype=wp.int32, device="cpu"))),
        (
            "features must be",
            lambda: ContactPairs(table, *poses.arrays, features=wp.zeros((3, 5), dtype=float, device="cpu")),
        ),
    ):
        with pytest.raises(ValueError, match=match):
            make()


def test_cuda_kernels_compile_without_a_gpu(tmp_path):
    kernel = contact_pairs.slot_kernel
    assert isinstance(kernel, wp.Kernel)
    (code,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
    assert "reach_kernel" in code.read_text()
