"""Late and sluggish commands act in training as the effects have them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from small_insertion import NOTHING_VARIES, SETTINGS, make_demonstration, make_events, make_model

from concent_warp.effects.effect import AddedEffect, Parameter
from concent_warp.effects.library.drives import ActuatorDelay, ActuatorLag, DriveEffect
from concent_warp.errors import TrainError
from concent_warp.train.environment.command_dynamics import CommandDynamics, CommandFilter
from concent_warp.train.environment.world_effects import sample_world_effects
from concent_warp.train.environment.worlds import _make_physics, make_environment
from concent_warp.train.task.task import Task

DELAY = AddedEffect(ActuatorDelay("x", "y"), (0.031,), ((0.0, 0.062),))
LAG = AddedEffect(ActuatorLag("x", "z"), (0.04,), ((0.02, 0.06),))
DECIMATION = 4
WORLDS = 5


def task_of(*effects: AddedEffect) -> Task:
    plain = make_model()
    demonstration = make_demonstration(plain)
    return Task.build(replace(plain, effects=effects), demonstration, SETTINGS, make_events(plain, demonstration))


@pytest.fixture(scope="module")
def delayed_task() -> Task:
    return task_of(DELAY, LAG)


def offline(task: Task, values: tuple[np.ndarray, ...], world: int, ctrl: np.ndarray) -> np.ndarray:
    """Return what acts in each step by the effects' own account, where commands of shape (actions, nu) were given."""
    held = np.repeat(ctrl, DECIMATION, axis=0)
    for added, rows in zip(task.model.effects, values, strict=True):
        held = added.effect.command(task.compiled, held, rows[world])
    return held


def test_commands_are_followed_as_the_effects_have_it(delayed_task):
    rng = np.random.default_rng(0)
    values = sample_world_effects(delayed_task, WORLDS, 0, sample=True)
    rows = (np.array([[0.0], [0.005], [0.0123], [0.062], [0.29]]), np.array([[0.0], [0.03], [0.001], [0.2], [0.05]]))
    parts = []
    for added, row in zip(delayed_task.model.effects, rows, strict=True):
        found = [added.effect.delay_and_lag(delayed_task.compiled, value) for value in row]
        parts.append(CommandDynamics(np.array([f[0] for f in found]), (np.array([f[1] for f in found]),)))
    following = CommandDynamics.combined(parts)
    assert following is not None
    assert len(values.command_dynamics) == 2
    follower = CommandFilter(following, delayed_task.compiled.opt.timestep, DECIMATION, "cpu")
    ctrl = rng.normal(size=(30, WORLDS, delayed_task.compiled.nu)).astype(np.float32)
    follower.reset(torch.ones(WORLDS, dtype=torch.bool), torch.from_numpy(ctrl[0]))
    acted = []
    for command in ctrl:
        follower.apply(torch.from_numpy(command))
        acted.append(follower.acting.clone())
    for world in range(WORLDS):
        expected = offline(delayed_task, rows, world, ctrl[:, world])
        # The last step is interpolated with what is not yet commanded.
        np.testing.assert_allclose(torch.cat(acted)[:-1, world], expected[:-1], atol=2e-6)


def test_worlds_that_begin_anew_clear_what_was_commanded(delayed_task):
    lag = np.full((2, delayed_task.compiled.nu), 0.1)
    follower = CommandFilter(CommandDynamics(lag, (lag,)), 0.005, DECIMATION, "cpu")
    old, new = torch.zeros(2, delayed_task.compiled.nu), torch.ones(2, delayed_task.compiled.nu)
    follower.reset(torch.tensor([True, True]), old)
    follower.apply(new)
    assert not follower.acting.any()
    follower.reset(torch.tensor([False, True]), new)
    follower.apply(new)
    assert (follower.acting[:, 1] == 1).all()
    assert not follower.acting[:, 0].any()


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_each_world_moves_by_its_own_delay_and_lag(delayed_task, engine):
    settings = replace(SETTINGS, worlds=WORLDS, engine=engine, decimation=DECIMATION)
    physics = _make_physics(delayed_task, settings, device="cpu")
    values = sample_world_effects(delayed_task, WORLDS, 0, sample=True).values
    assert len(np.unique(values[0])) == WORLDS
    physics.qpos[:] = torch.as_tensor(delayed_task.replay.qpos[0]).to(physics.qpos.dtype)
    ctrl = np.tile(delayed_task.replay.ctrl[0], (8, 1))
    ctrl[1:4, :3] += 0.02
    ctrl[4:, :3] -= 0.01
    for k, command in enumerate(ctrl):
        physics.ctrl[:] = torch.as_tensor(command, dtype=torch.float32)
        if k == 0:
            physics.reset_commands(torch.ones(WORLDS, dtype=torch.bool))
        physics.advance()
    expected = np.empty((WORLDS, delayed_task.compiled.nq))
    for world in range(WORLDS):
        d = mujoco.MjData(delayed_task.compiled)
        d.qpos[:] = delayed_task.replay.qpos[0]
        for acting in offline(delayed_task, values, world, ctrl):
            d.ctrl[:] = acting
            mujoco.mj_step(delayed_task.compiled, d)
        expected[world] = d.qpos
    assert np.ptp(expected[:, delayed_task.robot.qpos[0]]) > 1e-4
    np.testing.assert_allclose(physics.qpos.numpy(), expected, rtol=0, atol=2e-6 if engine == "mujoco" else 2e-4)


def test_saved_state_has_what_was_commanded(delayed_task, states):
    cfg = replace(SETTINGS, worlds=3, randomisation=replace(NOTHING_VARIES, delay=(0.05, 0.1), lag=(0.0, 0.05)))
    environment = make_environment(delayed_task, cfg, states, device="cpu")
    act = torch.ones(3, environment.num_actions)
    environment.start_from([0, 1, 2])
    environment.step(act)
    environment.step(-act)
    state = environment.state()
    first = environment.step(act)[0]["policy"]
    environment.step(-act)
    environment.restore(state)
    torch.testing.assert_close(environment.step(act)[0]["policy"], first, rtol=0, atol=0)
    environment.start_from([0, 1, 2])
    again = environment.step(0 * act)[0]["policy"]
    environment.start_from([0, 1, 2])
    torch.testing.assert_close(environment.step(0 * act)[0]["policy"], again, rtol=0, atol=0)


def test_sampled_delay_is_of_the_arm_alone(task):
    cfg = replace(SETTINGS, worlds=4, randomisation=replace(NOTHING_VARIES, delay=(0.05, 0.05)), decimation=2)
    physics = _make_physics(task, cfg, device="cpu")
    physics.qpos[:] = torch.as_tensor(task.replay.qpos[0])
    physics.ctrl[:] = torch.as_tensor(task.replay.ctrl[0], dtype=torch.float32)
    physics.reset_commands(torch.ones(4, dtype=torch.bool))
    before = physics.qpos.clone()
    physics.ctrl[:] -= 0.01
    physics.advance()
    moved = (physics.qpos - before).abs()[0]
    assert moved[task.robot.qpos[[0, 2]]].max() < 1e-8  # the finger's reaction moves the other one
    assert (physics.qpos - before)[0, task.compiled.joint("left").qposadr[0]] < -1e-5


def test_other_effects_on_commands_are_refused():
    class Rounded(DriveEffect):
        name = "rounded"

        def parameters(self, m):  # noqa: ARG002
            return (Parameter("step", "m", 0.0, 0.0, 0.1, 0.01),)

        def command(self, m, ctrl, values):  # noqa: ARG002
            return np.round(ctrl / values[0]) * values[0]

    with pytest.raises(TrainError, match="delays and lags"):
        task_of(AddedEffect(Rounded("x"), (0.01,)))
