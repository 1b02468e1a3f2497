"""Reward terms against NumPy, and the action distribution against its definition."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_insertion import CHAIN, SETTINGS, make_task

from concent_warp.train.cfg import EngineeredCfg, RewardCfg
from concent_warp.train.environment.environment import TERMS
from concent_warp.train.environment.quaternions import (
    invert_quaternion,
    multiply_quaternions,
    rotate_vectors,
    rotation_angle,
    rotation_columns,
)
from concent_warp.train.environment.reward import disturbance_penalty, effort_penalties, engineered_reward
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.learning.distribution import SquashedGaussian
from concent_warp.train.resets.sample import sample_reset_states


def quaternions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def matrix(q: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(q, -1, axis=-1)).as_matrix()


def test_rotations_agree_with_matrices():
    rng = np.random.default_rng(0)
    a, b, v = quaternions(rng, 5), quaternions(rng, 5), rng.normal(size=(5, 3))
    ta, tb, tv = (torch.as_tensor(x) for x in (a, b, v))
    np.testing.assert_allclose(rotate_vectors(ta, tv), np.einsum("nij,nj->ni", matrix(a), v), atol=1e-12)
    np.testing.assert_allclose(
        rotate_vectors(multiply_quaternions(ta, tb), tv),
        np.einsum("nij,njk,nk->ni", matrix(a), matrix(b), v),
        atol=1e-12,
    )
    np.testing.assert_allclose(rotate_vectors(invert_quaternion(ta), rotate_vectors(ta, tv)), v, atol=1e-12)
    np.testing.assert_allclose(rotation_columns(ta), matrix(a)[:, :, :2].transpose(0, 2, 1).reshape(5, 6), atol=1e-12)
    turn = torch.tensor([np.cos(0.0001), np.sin(0.0001), 0, 0], dtype=torch.float32)
    assert float(rotation_angle(turn)) == pytest.approx(0.0002, rel=1e-4)
    assert float(rotation_angle(-turn)) == pytest.approx(0.0002, rel=1e-4)


def test_effort_is_the_papers():
    rng = np.random.default_rng(0)
    action, velocity, lead = rng.normal(size=(6, 8)), rng.normal(size=(6, 7)), rng.normal(size=(6, 7))
    found = effort_penalties(
        RewardCfg(press=0.2), torch.as_tensor(action), torch.as_tensor(velocity), torch.as_tensor(lead)
    )
    np.testing.assert_allclose(found[0], -0.01 * (action**2).sum(axis=1))
    np.testing.assert_allclose(found[1], -0.001 * (velocity**2).sum(axis=1))
    np.testing.assert_allclose(found[2], -0.2 * (lead**2).sum(axis=1))


def test_disturbance_counts_shifts_and_turns_of_every_object():
    cfg = RewardCfg(disturb_position=3.0, disturb_rotation=0.5)
    position = torch.zeros(2, 2, 3)
    quaternion = torch.tensor([1.0, 0, 0, 0]).expand(2, 2, 4)
    moved = position.clone()
    moved[1, 0] = torch.tensor([0.0, 0.03, 0.04])
    turned = quaternion.clone()
    turned[1, 1] = torch.tensor([np.cos(0.1), 0, 0, np.sin(0.1)])
    found = disturbance_penalty(cfg, (position, quaternion), (moved, turned))
    np.testing.assert_allclose(found, [0.0, -(3.0 * 0.05 + 0.5 * 0.2)], atol=1e-6)


def test_engineered_reward_is_the_papers():
    cfg = EngineeredCfg(hole=(0.01, -0.02, 0.0))
    rng = np.random.default_rng(1)
    place = rng.uniform(-0.05, 0.05, (200, 3)) + np.array([0.01, -0.02, 0.03])
    aside = np.linalg.norm((place - cfg.hole)[:, :2], axis=1)
    above = np.maximum(place[:, 2] - cfg.seat, 0)
    gate = 1 / (1 + np.exp(-(cfg.gate - aside) / cfg.gate_width))
    expected = np.exp(-aside / 0.1) + np.exp(-aside / 0.01) + gate * (np.exp(-above / 0.1) + np.exp(-above / 0.01))
    seated = (aside < 0.01) & (above == 0)
    assert 0 < seated.sum() < len(seated)
    np.testing.assert_allclose(engineered_reward(cfg, torch.as_tensor(place)), expected + 50 * seated, rtol=1e-6)


def test_reaching_reward_of_an_environment_is_that_of_its_worst_pair(environment, task):
    environment.step(torch.zeros(environment.num_envs, environment.num_actions))
    terms = environment.terms[:, TERMS.index("reach")].clone()
    environment.start_from(list(range(environment.num_envs)))
    environment.step(torch.zeros(environment.num_envs, environment.num_actions))
    terms = environment.terms[:, TERMS.index("reach")]
    table, s = task.table, task.stage
    position, quaternion = environment.physics.position.numpy(), environment.physics.quaternion.numpy()
    for world in np.flatnonzero(~environment.done.numpy())[:5]:
        gaps = []
        for k in np.flatnonzero(table.used[s]):
            a, b = table.body_a[s, k], table.body_b[s, k]
            at = position[world, a] + matrix(quaternion[world, a]) @ table.point_a[s, k]
            goal = position[world, b] + matrix(quaternion[world, b]) @ table.point_b[s, k]
            gaps.append(np.linalg.norm(goal - at))
        expected = np.exp(-max(gaps) / 0.05) + 2 * np.exp(-max(gaps) / 0.008)
        assert float(terms[world]) == pytest.approx(expected, rel=1e-4)


def test_squashed_gaussian_is_the_density_of_its_samples():
    torch.manual_seed(0)
    distribution = SquashedGaussian(1, init_std=0.7, std_type="log")
    distribution.update(torch.full((200_000, 1), 0.4))
    actions = distribution.sample()
    assert (actions.abs() < 1).all()
    edges = torch.linspace(-0.9, 0.9, 19)
    counts = torch.histogram(actions.ravel(), edges)[0] / len(actions)
    middles = torch.linspace(-0.99999, 0.99999, 20001)
    distribution.update(torch.full((20001, 1), 0.4))
    density = distribution.log_prob(middles[:, None]).exp().detach()
    assert float(torch.trapezoid(density, middles)) == pytest.approx(1.0, abs=1e-3)
    for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True):
        inside = (middles >= low) & (middles <= high)
        assert float(torch.trapezoid(density[inside], middles[inside])) == pytest.approx(float(count), abs=4e-3)
    entropy = -float(torch.trapezoid(density * density.clamp(min=1e-30).log(), middles))
    distribution.update(torch.full((200_000, 1), 0.4))
    assert float(distribution.entropy.detach().mean()) == pytest.approx(entropy, abs=1e-2)
    exported = distribution.as_deterministic_output_module()(torch.tensor([0.4]))
    assert float(exported) == float(distribution.deterministic_output(torch.tensor([0.4])))


@pytest.mark.parametrize("far", [20.0, 1e3, 1e6])
def test_an_observation_out_of_the_ordinary_leaves_densities_and_divergence_finite(far):
    torch.manual_seed(0)
    distribution = SquashedGaussian(8, init_std=0.4, std_type="log")
    distribution.update(torch.full((1000, 8), far))
    actions, before = distribution.sample(), distribution.params
    old = distribution.log_prob(actions)
    distribution.update(torch.full((1000, 8), 0.9 * far, requires_grad=True))
    ratio = (distribution.log_prob(actions) - old).exp()
    assert ratio.isfinite().all()
    assert float(ratio.detach().max()) < 10
    assert float(distribution.kl_divergence(before, distribution.params).detach().max()) < 1


def test_the_reward_is_the_scaled_sum_of_its_terms_divided_by_the_chained_stages(task, states):
    chain = make_task(CHAIN)
    drawn = sample_reset_states(chain, CHAIN.reset, 0, count=12)
    assert len(chain.chained) == 3
    cases = ((task, SETTINGS, states, 1), (chain, replace(CHAIN, worlds=12), drawn, 3))
    for of, cfg, pool, stages in cases:
        torch.manual_seed(0)
        made = make_environment(of, cfg, pool, device="cpu")
        for _ in range(3):
            _, reward, _, _ = made.step(2 * torch.rand(made.num_envs, made.num_actions) - 1)
            assert reward.abs().max() > 0
            torch.testing.assert_close(reward, cfg.reward.scale / stages * made.terms.sum(dim=1))


def test_completed_stages_are_rewarded_in_every_step_where_asked_for():
    chain, cfg = make_task(CHAIN), replace(CHAIN, worlds=12, reward=RewardCfg(stage=5.0, completion=0.0))
    drawn = sample_reset_states(chain, CHAIN.reset, 1, count=12)
    made = make_environment(chain, cfg, drawn, device="cpu")
    made.start_from(range(12))
    stage = made.stage.clone()
    assert stage.unique().tolist() == [0, 1, 2]
    made.step(torch.zeros(made.num_envs, made.num_actions))
    torch.testing.assert_close(made.terms[:, TERMS.index("stages")], 5.0 * stage.float())
