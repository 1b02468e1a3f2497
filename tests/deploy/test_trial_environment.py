"""A trial that is stepped from outside: as good as in an evaluation, the same for the same seed, and alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import concent_warp as cw
from tests.plugins.teacher_commands import TeacherCommands

IMAGES = cw.ImagesCfg(size=16)


@pytest.fixture(scope="module")
def policy() -> cw.Policy:
    return cw.load_policy("shape_sorter")


@pytest.fixture(scope="module")
def trials(policy: cw.Policy) -> cw.TrialEnvironment:
    return cw.TrialEnvironment(policy, IMAGES, device="cpu")


def run(trials: cw.TrialEnvironment, policy: cw.Policy, seed: int) -> tuple[list[cw.TrialStep], list[np.ndarray]]:
    """Return the steps of a trial that a policy of the state drives, and its commands."""
    trials.reset(seed=seed)
    driver, steps, commands = TeacherCommands(policy, trials), [], []
    while not steps or steps[-1].outcome is None:
        commands.append(driver.next())
        steps.append(trials.step(commands[-1]))
    return steps, commands


@pytest.mark.parametrize("world", ["reality", "simulation"])
def test_commands_of_a_good_policy_succeed(policy, world):
    trials = cw.TrialEnvironment(policy, IMAGES, world=world, device="cpu")
    steps, commands = run(trials, policy, seed=1)
    assert steps[-1].outcome == "success"
    assert steps[-1].success
    assert not steps[-1].out_of_time
    assert all(step.outcome is None for step in steps[:-1])
    assert len(steps) <= trials.steps
    before = steps[-2].observation
    assert steps[-1].observation is before  # the world has begun anew
    np.testing.assert_allclose(before.command[:-1], commands[-2][:-1], atol=1e-6)  # the gripper is shut already
    assert np.abs(before.state - steps[0].observation.state).max() > 0.02


def test_holding_still_runs_out_of_time(policy):
    trials = cw.TrialEnvironment(policy, IMAGES, world="simulation", device="cpu")
    command = trials.reset(seed=3).command
    step = trials.step(command)
    for _ in range(trials.steps - 1):
        step = trials.step(command)
    assert step.outcome == "missed"
    assert step.out_of_time
    with pytest.raises(cw.TrainError, match="no trial runs"):
        trials.step(command)


def test_a_seed_gives_the_same_trial_whatever_ran_before(trials):
    def beginning(seed: int) -> list[np.ndarray]:
        first = trials.reset(seed=seed)
        found = [*first.images.values(), first.state, first.proprioception]
        for _ in range(3):
            now = trials.step(first.command).observation
            found += [*now.images.values(), now.state, now.proprioception]
        return found

    first = beginning(5)
    other = beginning(6)
    torch.manual_seed(1234)
    again = beginning(5)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])
    assert not np.array_equal(first[2], other[2])


def test_random_numbers_of_the_caller_are_left_alone(trials):
    torch.manual_seed(0)
    before = torch.get_rng_state()
    trials.step(trials.reset(seed=2).command)
    assert torch.equal(torch.get_rng_state(), before)


def test_shapes_and_names_are_those_of_data_sets(policy, trials, tmp_path):
    from concent_warp.recording.logs.readers.lerobot import LeRobotLog

    cfg = cw.RenderCfg(episodes=1, size=16, keep="all")
    cw.render(policy, tmp_path / "data", cfg, device="cpu")
    signals = LeRobotLog(tmp_path / "data").episode(0).signals
    assert [f"observation.state/{name}" for name in trials.state] == [n for n in signals if "state/" in n]
    assert [f"action/{name}" for name in trials.action] == [n for n in signals if n.startswith("action/")]
    now = trials.reset(seed=0)
    assert {name: image.shape for name, image in now.images.items()} == dict.fromkeys(("base", "wrist"), (16, 16, 3))
    assert now.state.shape == (len(trials.state),)
    assert now.command.shape == (len(trials.action),)
    assert now.proprioception.shape == (trials.proprioception,)
    assert trials.instruction == policy.run.recording[0].task
    assert trials.latest is now


def test_wrong_input_is_one_sentence(policy, trials):
    def said(**options) -> str:
        with pytest.raises(cw.ConcentError) as error:
            cw.TrialEnvironment(options.pop("task_of", policy), device="cpu", **options)
        return str(error.value)

    assert "no such policy" in said(task_of="dishwasher")
    assert "no such world" in said(world="moon")
    assert "hidden effects exist only in Reality" in said(
        world="simulation", cfg=cw.EvaluateCfg(hide=("joint_friction=1",))
    )
    with pytest.raises(cw.ConcentError, match="seed"):
        trials.reset(seed=-1)
    with pytest.raises(cw.RenderError, match="no such camera"):
        cw.TrialEnvironment(policy, cw.ImagesCfg(cameras=("ceiling",)), device="cpu").reset()
    trials.reset(seed=0)
    for wrong in (np.zeros(3), np.full(len(trials.action), np.nan)):
        with pytest.raises(cw.TrainError, match="the command is not right"):
            trials.step(wrong)
