"""Effects of a model differ between worlds as their fitted intervals have it."""

import warnings
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from small_insertion import NOTHING_VARIES, SETTINGS, make_demonstration, make_events, make_model

from concent_warp.effects.effect import AddedEffect
from concent_warp.effects.library.joints import JointDamping, Stribeck
from concent_warp.effects.library.measurement import Latency
from concent_warp.effects.library.objects import Mass, Size
from concent_warp.effects.posterior import JointPosterior
from concent_warp.train.environment.randomisation import sample_model_fields
from concent_warp.train.environment.world_effects import _sample_parameters, sample_world_effects
from concent_warp.train.environment.worlds import _make_physics
from concent_warp.train.task.task import Task

DAMPING = AddedEffect(JointDamping("x", "y"), (30.0, 20.0), ((20.0, 40.0), (20.0, 20.0)))
STRIBECK = AddedEffect(
    Stribeck("x", "y", "z"), (6.0, 5.0, 4.0, 0.05), ((2.0, 10.0), (5.0, 5.0), (4.0, 4.0), (0.05, 0.05))
)
MASS = AddedEffect(Mass("block"), (1.2,), ((1.0, 1.4),))
WORLDS = 6


def task_of(*effects: AddedEffect) -> Task:
    plain = make_model()
    demonstration = make_demonstration(plain)
    events = make_events(plain, demonstration)
    return Task.build(replace(plain, effects=effects), demonstration, SETTINGS, events)


@pytest.fixture(scope="module")
def varied() -> Task:
    return task_of(DAMPING, STRIBECK, MASS)


def test_parameters_have_the_interval_of_the_fit(varied):
    rng = np.random.default_rng(0)
    added = (DAMPING, STRIBECK, MASS)
    damping, stribeck, mass = (_sample_parameters(a.effect.parameters(varied.compiled), a, 4000, rng) for a in added)
    for values, (low, high) in ((damping[:, 0], (20, 40)), (stribeck[:, 0], (2, 10)), (mass[:, 0], (1.0, 1.4))):
        assert ((values > low) & (values < high)).mean() == pytest.approx(0.95, abs=0.012)
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.02 * (low + high))
    assert (damping[:, 1] == 20).all()
    assert (stribeck[:, 1:] == STRIBECK.array[1:]).all()
    assert abs(np.corrcoef(damping[:, 0], mass[:, 0])[0, 1]) < 0.05


def test_values_follow_from_the_seed(varied):
    first, again, other = (sample_world_effects(varied, 5, seed, sample=True).values[0] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1


def test_parameters_stay_within_their_bounds():
    wide = replace(DAMPING, intervals=((-40.0, 100.0), (0.0, 40.0)))
    values = sample_world_effects(task_of(wide), 500, 0, sample=True).values[0]
    assert values.min() >= 0
    assert values[:, 0].max() > 90
    assert len(np.unique(values[:, 0])) == 500


def test_worlds_sample_what_was_fitted_together_from_its_joint_distribution():
    scale, low, high = (10.0, 10.0, 0.1), (0.0, 0.0, 0.5), (np.inf, np.inf, 2.0)
    covariance = ((1.0, 0.0, -0.95), (0.0, 0.0, 0.0), (-0.95, 0.0, 1.0))
    posterior = JointPosterior(scale, covariance, low, high)
    together = replace(DAMPING, posterior=posterior, first=0), replace(MASS, posterior=posterior, first=2)
    damping, stribeck, mass = sample_world_effects(
        task_of(together[0], STRIBECK, together[1]), 3000, 0, sample=True
    ).values
    assert np.corrcoef(damping[:, 0], mass[:, 0])[0, 1] == pytest.approx(-0.95, abs=0.02)
    assert (damping[:, 0].std(), mass[:, 0].std()) == pytest.approx((10.0, 0.1), rel=0.06)
    assert damping.min() >= 0
    assert (damping[:, 1] == 20).all()
    assert abs(np.corrcoef(stribeck[:, 0], mass[:, 0])[0, 1]) < 0.06
    alone = sample_world_effects(task_of(together[1]), 3000, 0, sample=True).values[0]
    assert (alone.mean(), alone.std()) == pytest.approx((1.2, 0.1), rel=0.06)


def test_nothing_is_drawn_where_it_is_not_wanted_or_not_known(varied):
    found = sample_world_effects(varied, 3, 0, sample=False)
    assert not found.fields
    for values, added in zip(found.values, varied.model.effects, strict=True):
        np.testing.assert_array_equal(values, np.tile(added.array, (3, 1)))
    unknown = sample_world_effects(task_of(replace(DAMPING, intervals=())), 3, 0, sample=True)
    assert not unknown.fields


def test_fields_are_those_of_models_with_the_sampled_values(varied):
    found = sample_world_effects(varied, WORLDS, 0, sample=True)
    assert set(found.fields) >= {"dof_damping", "body_mass"}
    for world in range(WORLDS):
        effects = [replace(a, values=tuple(v[world])) for a, v in zip(varied.model.effects, found.values, strict=True)]
        m = replace(varied.model, effects=tuple(effects)).compile(varied.collidable)
        for name, values in found.fields.items():
            np.testing.assert_allclose(values[world], getattr(m, name), rtol=1e-12)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_each_world_moves_as_a_model_with_its_values(varied, engine):
    settings = replace(SETTINGS, worlds=WORLDS, engine=engine, decimation=5)
    physics = _make_physics(varied, settings, device="cpu")
    found = sample_world_effects(varied, WORLDS, 0, sample=True)
    start = torch.as_tensor(varied.replay.qpos[0])
    physics.qpos[:] = start.to(physics.qpos.dtype)
    ctrl = varied.replay.ctrl[0].copy()
    ctrl[:2] += 0.03
    physics.ctrl[:] = torch.as_tensor(ctrl, dtype=torch.float32)
    for _ in range(6):
        physics.advance()
    expected = []
    for world in range(WORLDS):
        effects = [replace(a, values=tuple(v[world])) for a, v in zip(varied.model.effects, found.values, strict=True)]
        model = replace(varied.model, effects=tuple(effects))
        expected.append(one_by_one(model, varied, ctrl, 30))
    expected = np.array(expected)
    assert np.ptp(expected[:, varied.robot.qpos[0]]) > 1e-4
    np.testing.assert_allclose(physics.qpos.numpy(), expected, rtol=0, atol=1e-9 if engine == "mujoco" else 2e-4)


def one_by_one(model, task: Task, ctrl: np.ndarray, steps: int) -> np.ndarray:
    """Return where C MuJoCo brings a single model, its force models written out here, shape (nq,)."""
    m = model.compile(task.collidable)
    d = mujoco.MjData(m)
    d.qpos[:] = task.replay.qpos[0]
    d.ctrl[:] = ctrl.astype(np.float32)
    force_models = [
        (force_model, added.array)
        for added in model.effects
        if (force_model := added.effect.force_model(m)) is not None
    ]
    loss = m.dof_frictionloss.copy()
    for _ in range(steps):
        m.dof_frictionloss[:] = loss
        for force_model, values in force_models:
            force_model.apply(m, d, values)
        mujoco.mj_step(m, d)
    return d.qpos.copy()


def test_what_is_compiled_in_is_kept_and_said_so():
    size = AddedEffect(Size("block"), (1.01,), ((0.99, 1.03),))
    late = AddedEffect(Latency(), (0.01,), ((0.005, 0.015),))
    task = task_of(size, DAMPING, late)
    with pytest.warns(UserWarning, match="cannot vary size between worlds") as said:
        found = sample_world_effects(task, 3, 0, sample=True)
    assert len(said) == 1
    assert found.fixed == ("size",)
    assert (found.values[0] == 1.01).all()
    assert len(np.unique(found.values[1][:, 0])) == 3
    with pytest.warns(UserWarning, match="joint_damping"):
        found = sample_world_effects(task, 3, 0, sample=True, variable=lambda name: name != "dof_damping")
    assert found.fixed == ("size", "joint_damping")
    assert not found.fields


def test_factors_are_on_top_of_effects(varied):
    cfg = replace(NOTHING_VARIES, damping=(2.0, 2.0000001))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fields = sample_world_effects(varied, WORLDS, 0, sample=True).fields
    both = sample_model_fields(varied, WORLDS, cfg, 0, fields)
    np.testing.assert_allclose(both["dof_damping"], 2 * fields["dof_damping"], rtol=1e-6)
    np.testing.assert_array_equal(both["body_mass"], fields["body_mass"])
