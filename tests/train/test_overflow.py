"""Contacts that do not fit the buffers are said at once, and training and evaluation go on with larger ones."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest
import torch
from data_parallel_training import make_run
from small_insertion import SETTINGS

from concent_warp.deploy.evaluate import evaluate
from concent_warp.errors import TrainError
from concent_warp.train.environment import worlds as worlds_module
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.learning.metrics import read_curve
from concent_warp.train.learning.ppo import CHECKPOINT, load_checkpoint
from concent_warp.train.observation_cfg import ObservationCfg
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import TrainingRun, train_run

WORLDS = 3


def made(contacts: int, constraints: int, iterations: int = 4) -> TrainingRun:
    run = make_run()
    environment = replace(
        SETTINGS,
        worlds=WORLDS,
        engine="warp",
        decimation=2,
        observation=ObservationCfg(),
        reset=replace(SETTINGS.reset, states=8),
        nconmax=contacts,
        njmax=constraints,
    )
    ppo = replace(run.cfg.ppo, iterations=iterations, steps=3)
    return replace(run, cfg=replace(run.cfg, environment=environment, ppo=ppo))


def trained(run: TrainingRun, folder: Path | None, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        trainer, _ = train_run(run, folder, device="cpu", **options)
    return trainer, [str(one.message) for one in caught if "dropped" in str(one.message)]


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory):
    """Return the folder of a training that began with room for one contact, its trainer and what it said."""
    folder = tmp_path_factory.mktemp("grown")
    return folder, *trained(made(1, 200, 8), folder)


@pytest.mark.parametrize(("contacts", "constraints"), [(1, 200), pytest.param(60, 4, marks=pytest.mark.slow)])
def test_training_goes_on_with_larger_buffers_and_says_so(grown, tmp_path, contacts, constraints):
    folder, trainer, said = grown
    if (contacts, constraints) != (1, 200):
        folder, (trainer, said) = tmp_path, trained(made(contacts, constraints, 8), tmp_path)
    shares = [point["overflow"] for point in read_curve(folder)]
    assert len(shares) == 8
    assert shares[0] > 0
    assert shares[-1] == 0
    assert len(said) == sum(share > 0 for share in shares)
    assert said[0].startswith(f"contacts were dropped in {shares[0]:.2%} of the steps: the training goes on with room")
    factor = 2 ** len(said)
    assert trainer.environment.buffers == (factor * contacts, factor * constraints)
    assert f"for {2 * contacts} contacts and {2 * constraints} constraints a world" in said[0]


def test_enough_room_is_not_changed(tmp_path):
    trainer, said = trained(made(60, 200), tmp_path)
    assert not said
    assert trainer.environment.buffers == (60, 200)
    assert {point["overflow"] for point in read_curve(tmp_path)} == {0.0}


def test_larger_buffers_change_nothing_else():
    """An environment made anew with other buffers continues as the one before."""
    weights = []
    for rebuilt in (False, True):
        trainer, _ = trained(made(60, 200, 1), None)
        if rebuilt:
            trainer._rebuild((120, 400), finishing=False)
        trainer.cfg = replace(trainer.cfg, ppo=replace(trainer.cfg.ppo, iterations=3))
        trainer.learn()
        weights.append(trainer.algorithm.actor.state_dict())
    for name, value in weights[0].items():
        assert torch.equal(value, weights[1][name])


def test_resumed_training_has_the_larger_buffers(grown, tmp_path):
    folder, trainer, said = grown
    assert said
    shutil.copytree(folder, tmp_path / "run")
    resumed, said = trained(made(1, 200, 9), tmp_path / "run", resume=True)
    assert not said
    assert resumed.environment.buffers == trainer.environment.buffers
    assert load_checkpoint(tmp_path / "run" / CHECKPOINT)["buffers"] == trainer.environment.buffers


def test_buffers_that_do_not_fit_the_memory_are_said(tmp_path, monkeypatch):
    run = made(1, 200)
    whole = worlds_module.check_worlds

    def check(task, cfg, device=None):
        if cfg.nconmax > 1:
            raise TrainError("so many worlds do not fit the memory")
        whole(task, cfg, device)

    monkeypatch.setattr(worlds_module, "check_worlds", check)
    with pytest.raises(TrainError, match=r"dropped in .* larger buffers do not fit the memory; .*lower --worlds"):
        trained(run, tmp_path)


def test_evaluation_is_repeated_with_larger_buffers(tmp_path):
    run = made(60, 200, 1)
    train_run(run, tmp_path, device="cpu")
    policy = Policy.load(tmp_path)
    whole = evaluate(policy, world="simulation", episodes=3, device="cpu")
    small = replace(policy, run=replace(run, cfg=replace(run.cfg, environment=made(1, 200).cfg.environment)))
    with pytest.warns(UserWarning, match="contacts were dropped"):
        repeated = evaluate(small, world="simulation", episodes=3, device="cpu")
    assert repeated.outcome == whole.outcome
    assert repeated.length.tolist() == whole.length.tolist()


def test_contacts_that_c_mujoco_drops_are_counted(task, states, monkeypatch):
    environment = make_environment(task, replace(SETTINGS, worlds=2), states, device="cpu")
    step, calls = mujoco.mj_step, 0

    def full(model, data, nstep=1):
        nonlocal calls
        step(model, data, nstep)
        calls += 1
        if calls == 1:
            data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL].number += 1

    monkeypatch.setattr(mujoco, "mj_step", full)
    environment.read_log()
    for _ in range(2):
        environment.step(torch.zeros(2, environment.num_actions))
    assert environment.read_log()["overflow"] == 0.25
