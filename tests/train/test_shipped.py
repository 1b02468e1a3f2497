"""A policy that comes with the package runs at once, and any run can be made into one."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from data_parallel_training import make_run

from concent_warp.cli import main
from concent_warp.errors import TrainError
from concent_warp.train.environment.observation import ObservationLayout
from concent_warp.train.learning.ppo import CHECKPOINT
from concent_warp.train.policy.load import Policy
from concent_warp.train.policy.pretrained import FOLDER, ORIGIN, pretrained_checkpoint, pretrained_names
from concent_warp.train.policy.write_pretrained import write_pretrained
from concent_warp.train.run import TrainingRun, train_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a short training."""
    out = tmp_path_factory.mktemp("shipped") / "run"
    train_run(make_run(), out, device="cpu")
    (out / "settings.toml").write_text('command = "concent train some/where/demo.h5 --seed 0"\n')
    return out


def test_policy_that_comes_with_the_package_succeeds_on_a_cpu(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ["--episodes", "6", "--world", "simulation", "--device", "cpu"]
    assert main(["evaluate", "--pretrained", *options]) == 0
    first = capsys.readouterr().out
    assert "6 of 6 succeed" in first
    assert main(["evaluate", "--pretrained", "shape_sorter", *options]) == 0
    assert capsys.readouterr().out == first
    assert not list(tmp_path.iterdir())


def test_whole_task_comes_with_the_package_too(capsys):
    options = ["--episodes", "4", "--world", "simulation", "--device", "cpu", "--json"]
    assert main(["evaluate", "--pretrained", "pick_align_insert", *options]) == 0
    found = json.loads(capsys.readouterr().out)["worlds"]["simulation"]
    assert found["successes"] == 4
    assert found["stages met"] == [{"stage": stage, "episodes": 4} for stage in ("pick", "align", "insert")]


def test_scaled_policy_takes_smaller_the_steps_and_leads_of_the_commands(capsys):
    options = ["evaluate", "--pretrained", "--episodes", "4", "--world", "simulation", "--device", "cpu", "--json"]
    assert main([*options, "--action-scale", "0.5", "--setpoint-lead-scale", "0.5"]) == 0
    slow = json.loads(capsys.readouterr().out)
    assert (slow["action_scale"], slow["setpoint_lead_scale"]) == (0.5, 0.5)
    assert slow["worlds"]["simulation"]["successes"] == 4
    policy = Policy.load("shape_sorter")
    robot, trained = policy.scaled(0.5, 0.4).run.task().robot, policy.run.task().robot
    np.testing.assert_allclose(robot.step, 0.5 * trained.step)
    np.testing.assert_allclose(robot.lead, 0.4 * trained.lead)
    for option in ("--action-scale", "--setpoint-lead-scale"):
        assert main([*options, option, "1.5"]) != 0
        assert f"{option} is out of bounds" in capsys.readouterr().err


def test_policies_that_come_with_the_package_say_where_they_are_from_and_are_small():
    assert set(pretrained_names()) == {"shape_sorter", "pick_align_insert"}
    for name in pretrained_names():
        origin = tomllib.loads((FOLDER / name / ORIGIN).read_text())
        assert origin["command"].startswith(("concent train ", "torchrun "))
        assert "/" not in origin["command"]
        assert origin["steps"] > 0
        assert sum(file.stat().st_size for file in (FOLDER / name).iterdir()) < 1.5e6
        run = TrainingRun.load(FOLDER / name)
        weights = torch.load(pretrained_checkpoint(name), weights_only=True)["actor_state_dict"]
        layout = ObservationLayout.of(run.task(), run.cfg.environment.observation)
        assert weights["obs_normalizer._mean"].shape[1] == layout.size


def test_policy_made_for_shipping_is_the_runs_own_in_the_same_task(folder, tmp_path):
    assert main(["export", "--checkpoint", str(folder), "--as-pretrained", "--out", f"{tmp_path}/small"]) == 0
    small = tmp_path / "small"
    whole = [torch.load(path / CHECKPOINT, weights_only=True) for path in (folder, small)]
    for name, value in whole[0]["actor_state_dict"].items():
        assert torch.equal(value, whole[1]["actor_state_dict"][name])
    assert (small / CHECKPOINT).stat().st_size < 0.6 * (folder / CHECKPOINT).stat().st_size
    tasks = [TrainingRun.load(path).task() for path in (folder, small)]
    np.testing.assert_array_equal(tasks[0].replay.qpos, tasks[1].replay.qpos)
    for name in ("body_a", "point_a", "body_b", "point_b", "used"):
        np.testing.assert_array_equal(getattr(tasks[0].table, name), getattr(tasks[1].table, name))
    origin = tomllib.loads((small / ORIGIN).read_text())
    assert origin["command"] == "concent train demo.h5 --seed 0"
    assert origin["iterations"] == 4


def test_training_cannot_go_on_from_a_policy_alone(folder, tmp_path):
    write_pretrained(Policy.load(folder), tmp_path / "small")
    with pytest.raises(TrainError, match="no training to resume"):
        train_run(make_run(), tmp_path / "small", device="cpu", resume=True)


def test_folders_are_replaced_only_on_demand_and_only_such(folder, tmp_path, capsys):
    command = ["export", "--checkpoint", str(folder), "--as-pretrained", "--out", str(tmp_path / "small")]
    assert main(command) == 0
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    assert main([*command[:-1], str(tmp_path / "mine"), "--overwrite"]) == 2
    assert (tmp_path / "mine" / "thesis.tex").is_file()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ([], "either --checkpoint with a run folder or --pretrained, found neither"),
        (["--pretrained", "--checkpoint", "runs"], "found both"),
        (["--pretrained", "dishwasher"], "no such policy comes with the package; expected one of ['pick_align_insert'"),
    ],
)
def test_policy_that_is_not_distinguished_is_refused(options, sentence, capsys):
    assert main(["evaluate", *options]) == 2
    assert sentence in capsys.readouterr().err
