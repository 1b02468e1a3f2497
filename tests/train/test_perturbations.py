"""Random force perturbations of a grasped object."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_insertion import SETTINGS

from concent_warp.effects.registry import effect_class
from concent_warp.errors import TrainError
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.physics import MujocoPhysics, WarpPhysics
from concent_warp.train.environment.worlds import make_environment

PERTURBED = replace(
    SETTINGS, randomisation=replace(SETTINGS.randomisation, perturbation=(2.0, 0.05), perturbation_share=0.5)
)


def acted(environment: Environment) -> torch.Tensor:
    """Return what acted on each body in an action, shape (N, nbody, 6)."""
    environment.step(torch.zeros(environment.num_envs, environment.num_actions))
    return environment.physics.wrench.clone()


@pytest.mark.parametrize("force_model", [False, True])
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_wrench_moves_the_body_that_it_acts_on_as_newton_predicts(task, engine, force_model):
    m, body, steps = task.compiled, task.objects[0], 5
    effect = effect_class("stribeck_friction")(m.joint(int(task.robot.joint[0])).name)
    acting = effect.force_model(m)
    assert acting is not None
    force_models = [(acting, np.zeros((2, len(effect.parameters(m)))))] if force_model else []
    if engine == "warp":
        physics = WarpPhysics(m, 2, steps, force_models, device="cpu", nconmax=200, njmax=800)
    else:
        physics = MujocoPhysics(m, 2, steps, force_models)
    physics.qpos[:] = torch.as_tensor(task.replay.qpos[0]).to(physics.qpos.dtype)
    joint = m.body_jntadr[body]
    physics.qpos[:, m.jnt_qposadr[joint] + 2] += 1.0  # in the air
    physics.wrench[1, body] = torch.tensor([0.3, 0.0, 0.6, 0.0, 0.0, 1e-4])
    for _ in range(2):
        physics.advance()
    dof = m.jnt_dofadr[joint]
    gained = (physics.qvel[1] - physics.qvel[0])[dof : dof + 6].double().numpy()
    time = 2 * steps * m.opt.timestep
    expected = [0.3 * time / m.body_mass[body], 0.0, 0.6 * time / m.body_mass[body]]
    np.testing.assert_allclose(gained[:3], expected, rtol=1e-3, atol=1e-4)
    assert gained[5] == pytest.approx(1e-4 * time / m.body_inertia[body, 2], rel=1e-3)


def test_perturbations_come_in_training_and_not_in_an_evaluation(task, states):
    torch.manual_seed(0)
    environment = make_environment(task, PERTURBED, states, device="cpu")
    body = task.objects[0]
    perturbations = torch.stack([acted(environment)[:, body] for _ in range(20)])
    hit = perturbations.abs().sum(dim=2) > 0
    assert float(hit.float().mean()) == pytest.approx(0.5, abs=0.1)
    assert float(perturbations[hit][:, :3].std()) == pytest.approx(2.0, rel=0.15)
    assert float(perturbations[hit][:, 3:].std()) == pytest.approx(0.05, rel=0.15)
    environment.start_from(list(range(environment.num_envs)))
    assert not acted(environment).any()
    environment.reset()
    others = acted(environment)
    assert others[:, body].any()
    others[:, body] = 0
    assert not others.any()


@pytest.mark.parametrize("wrong", [{"perturbation": (-1.0, 0.1)}, {"perturbation_share": 1.5}])
def test_negative_deviations_and_shares_above_one_are_refused(wrong):
    with pytest.raises(TrainError, match=r"perturbation(_share)? is out of bounds"):
        TrainCfg(environment=replace(PERTURBED, randomisation=replace(PERTURBED.randomisation, **wrong)))


def test_objects_that_are_not_grasped_are_not_perturbed(task, states):
    environment = make_environment(task, PERTURBED, states, device="cpu")
    environment._frames.zero_()
    assert not acted(environment).any()


def test_resumed_environment_samples_the_same_perturbations(task, states):
    """Perturbations are sampled from the generator that a checkpoint keeps."""
    found = []
    for stop in (False, True):
        torch.manual_seed(3)
        environment = make_environment(task, PERTURBED, states, device="cpu")
        for _ in range(3):
            acted(environment)
        if stop:
            kept, generator = environment.state(), torch.get_rng_state()
            environment = make_environment(task, PERTURBED, states, device="cpu")
            environment.restore(kept)
            torch.set_rng_state(generator)
        found.append((acted(environment), environment.observation.clone()))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
