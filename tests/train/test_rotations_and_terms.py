"""Rotations of many worlds and terms of the reward against SciPy and values by hand, in several batch shapes."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from concent_warp.train.cfg import EngineeredCfg, RewardCfg
from concent_warp.train.environment.quaternions import (
    invert_quaternion,
    multiply_quaternions,
    rotate_vectors,
    rotation_angle,
    rotation_columns,
)
from concent_warp.train.environment.reward import (
    _two_scales,
    disturbance_penalty,
    effort_penalties,
    engineered_reward,
    relative_pose,
)

BATCHES = [(), (5,), (3, 2), (2, 3, 5)]


def sampled(seed: int, batch: tuple[int, ...]) -> torch.Tensor:
    q = np.random.default_rng(seed).normal(size=(*batch, 4))
    return torch.as_tensor(q / np.linalg.norm(q, axis=-1, keepdims=True))


def of(q: torch.Tensor) -> Rotation:
    """Return rotations, one for each quaternion."""
    return Rotation.from_quat(q.numpy().reshape(-1, 4)[:, [1, 2, 3, 0]])


@pytest.mark.parametrize("batch", BATCHES)
def test_rotations_of_any_batch_are_those_of_scipy(batch):
    a, b = sampled(0, batch), sampled(1, batch)
    v = torch.as_tensor(np.random.default_rng(2).normal(size=(*batch, 3)))
    np.testing.assert_allclose(rotate_vectors(a, v).reshape(-1, 3), of(a).apply(v.reshape(-1, 3)), atol=1e-12)
    product = multiply_quaternions(a, b)
    assert product.shape == (*batch, 4)
    np.testing.assert_allclose(of(product).as_matrix(), (of(a) * of(b)).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(product, axis=-1), 1.0)
    inverse = invert_quaternion(a)
    assert inverse.shape == (*batch, 4)
    np.testing.assert_allclose(of(inverse).as_matrix(), of(a).inv().as_matrix(), atol=1e-12)
    angle = rotation_angle(a)
    assert angle.shape == batch
    np.testing.assert_allclose(angle.reshape(-1), of(a).magnitude(), atol=1e-12)
    np.testing.assert_allclose(rotation_angle(-a).reshape(-1), of(a).magnitude(), atol=1e-12)
    columns = rotation_columns(a)
    assert columns.shape == (*batch, 6)
    matrix = of(a).as_matrix()
    np.testing.assert_allclose(columns.reshape(-1, 6), np.hstack([matrix[..., 0], matrix[..., 1]]), atol=1e-12)


def test_products_and_inverses_are_hamiltons():
    i, j, k = torch.eye(4)[1:]
    torch.testing.assert_close(multiply_quaternions(i, j), k)
    torch.testing.assert_close(multiply_quaternions(j, i), -k)
    torch.testing.assert_close(multiply_quaternions(k, k), -torch.eye(4)[0])
    torch.testing.assert_close(
        invert_quaternion(torch.tensor([0.5, 0.5, -0.5, 0.5])), torch.tensor([0.5, -0.5, 0.5, -0.5])
    )
    torch.testing.assert_close(
        rotation_angle(torch.stack([torch.eye(4)[0], -torch.eye(4)[0], i])), torch.tensor([0, 0, torch.pi])
    )


def test_one_rotation_acts_on_many_vectors():
    q, v = sampled(3, (4, 1)), torch.as_tensor(np.random.default_rng(4).normal(size=(4, 6, 3)))
    found = rotate_vectors(q, v)
    for world in range(4):
        np.testing.assert_allclose(found[world], of(q)[world].apply(v[world]), atol=1e-12)


def test_relative_poses_are_seen_from_their_frames():
    rng = np.random.default_rng(5)
    position, origin = (torch.as_tensor(rng.normal(size=(3, 2, 3))) for _ in range(2))
    quaternion, turn = sampled(6, (3, 2)), sampled(7, (3, 2))
    place, rotation = relative_pose(position, quaternion, origin, turn)
    back = of(turn).inv()
    np.testing.assert_allclose(place.reshape(-1, 3), back.apply((position - origin).reshape(-1, 3)), atol=1e-12)
    np.testing.assert_allclose(of(rotation).as_matrix(), (back * of(quaternion)).as_matrix(), atol=1e-12)


def test_effort_is_weighed_and_summed_for_each_world():
    cfg = RewardCfg(action=0.5, velocity=0.25, press=2.0)
    action = torch.tensor([[1.0, -2.0, 0.0], [0.5, 0.0, 0.0]])
    velocity, lead = torch.tensor([[3.0, 1.0], [0.0, -2.0]]), torch.tensor([[1.0, 1.0], [0.5, 0.0]])
    found = effort_penalties(cfg, action, velocity, lead)
    assert [term.tolist() for term in found] == [[-2.5, -0.125], [-2.5, -1.0], [-4.0, -0.5]]


def test_disturbance_sums_the_motion_of_all_objects_of_a_world():
    cfg = RewardCfg(disturb_position=2.0, disturb_rotation=3.0)
    rng = np.random.default_rng(8)
    places = [torch.as_tensor(rng.normal(size=(4, 2, 3))) for _ in range(2)]
    turns = [sampled(seed, (4, 2)) for seed in (9, 10)]
    found = disturbance_penalty(cfg, (places[0], turns[0]), (places[1], turns[1]))
    moved = np.linalg.norm(places[1] - places[0], axis=-1)
    turned = (of(turns[0]).inv() * of(turns[1])).magnitude().reshape(4, 2)
    np.testing.assert_allclose(found, -(2 * moved + 3 * turned).sum(axis=1), atol=1e-12)
    assert (found < 0).all()
    still = disturbance_penalty(cfg, (places[0], turns[0]), (places[0], turns[0]))
    np.testing.assert_allclose(still, 0.0, atol=1e-6)


def test_two_scales_are_a_sum_of_exponentials():
    distance = torch.tensor([0.0, 0.5, 2.0], dtype=torch.float64)
    found = _two_scales(distance, (3.0, 0.5), (7.0, 0.25))
    np.testing.assert_allclose(found, [10.0, 3 * np.exp(-1) + 7 * np.exp(-2), 3 * np.exp(-4) + 7 * np.exp(-8)])


def test_engineered_reward_is_that_of_alignment_gate_depth_and_bonus():
    cfg = EngineeredCfg(
        hole=(0.25, -0.5, 9.0), seat=0.5, far=(2.0, 0.5), near=(3.0, 0.25), gate=0.5, gate_width=0.25, reached=0.25,
        bonus=100.0,
    )  # fmt: skip

    def reward(x: float, y: float, z: float) -> float:
        return float(engineered_reward(cfg, torch.tensor([[x, y, z]], dtype=torch.float64)))

    def scales(d: float) -> float:
        return 2 * np.exp(-d / 0.5) + 3 * np.exp(-d / 0.25)

    def gate(aside: float) -> float:
        return 1 / (1 + np.exp(-(0.5 - aside) / 0.25))

    # Above the hole, on its edge, just inside it and at the bottom; below the seat counts as seated.
    assert reward(0.25, -0.5, 1.0) == pytest.approx(5 + gate(0) * scales(0.5))
    assert reward(0.25, -0.5, 0.5) == reward(0.25, -0.5, 0.25) == pytest.approx(5 + gate(0) * 5 + 100)
    assert reward(0.5, -0.5, 0.5) == pytest.approx(scales(0.25) + gate(0.25) * 5)
    assert reward(0.25, -0.25, 0.0) == pytest.approx(scales(0.25) + gate(0.25) * 5)
    assert reward(0.25, -0.74, 0.0) == pytest.approx(scales(0.24) + gate(0.24) * 5 + 100)
    assert reward(0.25, -0.5, 0.5001) < 20
    assert reward(0.25, 0.0, 1.5) == pytest.approx(scales(0.5) + 0.5 * scales(1.0))
    assert reward(0.55, -0.1, 0.0) == pytest.approx(scales(0.5) + 0.5 * 5)
    assert reward(2.25, -0.5, 0.6) == pytest.approx(scales(2.0) + gate(2.0) * scales(0.1))
