"""A policy at work in one world: what there is to see."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from small_insertion import SETTINGS

from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.policy.play import Player


@pytest.fixture
def player(task, states) -> Player:
    environment = make_environment(task, replace(SETTINGS, worlds=1), states, device="cpu")
    return Player(environment, lambda seen: torch.zeros(len(seen["policy"]), environment.num_actions), 3)


def put(environment: Environment, time: float) -> None:
    """Put the world where the demonstration is at a time [s]."""
    row = environment.task.replay.row(time)
    environment.physics.qpos[0] = torch.as_tensor(environment.task.replay.qpos[row])
    environment.refresh()


def test_contact_points_are_at_their_targets_when_the_target_event_is_there(player):
    task = player.environment.task
    apart = np.linalg.norm(np.diff(player.state().pairs, axis=1), axis=-1).max()
    put(player.environment, task.events.stages[task.stage].event.time)
    moment = player.state()
    assert moment.stage == "insert"
    assert len(moment.pairs) == task.table.used[task.stage].sum()
    together = np.linalg.norm(np.diff(moment.pairs, axis=1), axis=-1).max()
    assert together < 0.002 < apart


def test_targets_are_those_of_the_stage_that_the_world_is_in(player):
    environment, task = player.environment, player.environment.task
    for number, stage in enumerate(task.events.stages):
        put(environment, stage.event.time)
        environment.stage[0] = number
        moment = player.state()
        assert moment.stage == stage.name
        assert len(moment.pairs) == task.table.used[number].sum()
        assert np.linalg.norm(np.diff(moment.pairs, axis=1), axis=-1).max() < 0.002


def test_spheres_that_touch_are_those_in_contact_and_none_in_the_air(player):
    environment, task = player.environment, player.environment.task
    put(environment, task.events.stages[task.stage].event.time)
    held = player.state().touching
    names = np.array(task.model.geometry.names())
    d = mujoco.MjData(task.compiled)
    d.qpos[:] = environment.physics.qpos[0].numpy()
    mujoco.mj_forward(task.compiled, d)
    met = {task.compiled.geom(g).name for pair in d.contact.geom for g in pair} & set(names)
    assert met
    assert met <= set(names[held])
    environment.physics.qpos[0, 2] += 1.0
    environment.refresh()
    assert not player.state().touching[task.model.geometry.of("block")].any()


def test_bodies_are_where_the_world_has_them(player):
    moment, task = player.state(), player.environment.task
    block = task.compiled.body("block").id
    np.testing.assert_allclose(moment.position[block], player.environment.physics.qpos[0, :3], atol=1e-6)
    assert moment.position.shape == (task.compiled.nbody, 3)


def test_episodes_end_with_an_outcome_and_begin_from_the_next_state(player, states):
    def at() -> int:
        return int(np.abs(states.qpos - player.environment.physics.qpos[0].numpy()).max(axis=1).argmin())

    assert at() == 0
    outcomes = [player.step() for _ in range(player.environment.max_episode_length)]
    assert outcomes[:-1] == [None] * (player.environment.max_episode_length - 1)
    assert player.ended == [outcomes[-1]]
    assert player.ended[0] in ("missed", "success")
    assert at() == 1
    assert player.state().time == 0
    player.step()
    assert player.state().time == pytest.approx(player.environment.control_step)
    player.begin()
    assert (at(), player.state().time) == (2, 0)
    player.begin()
    assert at() == 0


def test_failure_is_named(player):
    player.environment.physics.qvel[0, 0] = 1e9
    assert player.step() == "diverged"
