"""Chunks of a teacher from a state on: those of a serial roll-out from it, and the worlds go on as if nothing was."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import concent_warp as cw
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.trials.branches import branched_commands
from concent_warp.train.trials.episodes import PolicyFunction

CHUNK, WORLDS = 6, 3


@pytest.fixture(scope="module")
def teacher() -> cw.Policy:
    return cw.load_policy("shape_sorter")


def begun(teacher: cw.Policy, **settings) -> tuple[Environment, PolicyFunction]:
    """Return worlds in which another policy has driven for some steps, and the teacher's function there."""
    task = teacher.run.task()
    states = teacher.run.evaluation_states(task, WORLDS, 0)
    torch.manual_seed(0)
    cfg = replace(teacher.run.cfg.environment, worlds=WORLDS, **settings)
    environment = make_environment(task, cfg, states, device="cpu")
    act = teacher.act_in(environment)
    environment.start_from(range(WORLDS))
    for _ in range(5):
        drive(environment, act)
    return environment, act


def drive(environment: Environment, act: PolicyFunction) -> torch.Tensor:
    """Take a step as a bad student does, and return the commands."""
    wrong = 0.7 * torch.sin(torch.arange(environment.num_actions) + environment.episode_length_buf[:, None].float())
    environment.step(0.3 * act(environment.get_observations()) + wrong)
    return environment.physics.ctrl.clone()


def test_chunk_is_a_serial_roll_out_of_the_teacher_from_the_same_state(teacher):
    environment, act = begun(teacher)
    found = branched_commands(environment, act, CHUNK)
    assert found.shape == (WORLDS, CHUNK, environment.task.compiled.nu)
    # The same worlds made anew, driven to the same states, in which the teacher takes over for good.
    serial, act = begun(teacher)
    for step in range(CHUNK):
        serial.step(act(serial.get_observations()))
        assert torch.equal(found[:, step], serial.physics.ctrl)
    assert (found[:, 1:] - found[:, :-1]).abs().amax(dim=(0, 2)).min() > 1e-4


def test_worlds_go_on_as_if_nothing_was_branched(teacher):
    def going_on(branching: bool) -> tuple[list[torch.Tensor], dict[str, torch.Tensor]]:
        environment, act = begun(teacher)
        assert environment.estimate is not None  # sensor errors are random numbers
        commands = []
        for _ in range(8):
            if branching:
                branched_commands(environment, act, CHUNK)
            commands.append(drive(environment, act))
        return commands, environment.state() | {"observation": environment.observation}

    (commands, state), (expected, plain) = going_on(True), going_on(False)
    assert all(torch.equal(a, b) for a, b in zip(commands, expected, strict=True))
    assert [name for name in plain if not torch.equal(state[name], plain[name])] == []


def test_last_command_is_repeated_after_the_end_of_an_episode(teacher):
    environment, act = begun(teacher, episode=0.4)  # 8 steps, of which 5 are over
    assert environment.max_episode_length == 8
    found = branched_commands(environment, act, CHUNK)
    assert environment.episode_length_buf.tolist() == [5] * WORLDS
    assert (found[:, 1] - found[:, 0]).abs().amax(dim=1).min() > 1e-4
    assert torch.equal(found[:, 2:], found[:, 1:2].expand(-1, CHUNK - 2, -1))


def test_worlds_are_set_back_when_the_teacher_fails(teacher):
    environment, act = begun(teacher)
    before = environment.state()

    def fails(observation):
        if int(environment.episode_length_buf[0]) > 6:
            raise RuntimeError
        return act(observation)

    with pytest.raises(RuntimeError):
        branched_commands(environment, fails, CHUNK)
    after = environment.state()
    assert all(torch.equal(after[name], value) for name, value in before.items())
