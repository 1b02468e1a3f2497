"""A flow policy in its task: evaluated there, and as the policy that hands over to its teacher."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

import concent_warp as cw
from concent_warp.cli.entry import main
from concent_warp.deploy.handover import Handover
from concent_warp.deploy.simulated_images import HybridImages
from concent_warp.recording.logs.readers.lerobot import LeRobotLog
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.trials.evaluate import run_episodes

COMMON = ["render", "--pretrained", "--size", "32", "--cameras", "base", "--device", "cpu", "--worlds", "4"]
FLOW = cw.TrainFlowCfg(
    steps=2, batch=2, policy=cw.FlowPolicyCfg(size=16, width=16, layers=1, heads=2, chunk=4, execute=2)
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a data set of two episodes and a flow policy that has hardly learned from it."""
    place = tmp_path_factory.mktemp("handover")
    assert main([*COMMON, "--episodes", "2", "--keep", "all", "-o", str(place / "plain")]) == 0
    cw.train_flow(place / "plain", FLOW, device="cpu", out=place / "flow")
    return place


def rows(dataset: Path) -> list[int]:
    """Return the lengths of the episodes of a data set."""
    (table,) = (dataset / "meta" / "episodes").rglob("*.parquet")
    return pq.read_table(table)["length"].to_pylist()


def test_teacher_takes_over_from_a_policy_that_sees(folder, capsys):
    command = [*COMMON, "--episodes", "4", "--handover", str(folder / "flow"), "-o", str(folder / "data")]
    assert main([*command, "--handover.time", "0.2", "0.6"]) == 0
    said = capsys.readouterr().out
    lengths = rows(folder / "data")
    assert f"holds {len(lengths)} episode" in said
    assert lengths
    log = LeRobotLog(folder / "data")
    plain = LeRobotLog(folder / "plain")
    for number in log.numbers:
        first = np.array([signal.value[0] for signal in log.episode(number).signals.values()])
        starts = [np.array([s.value[0] for s in plain.episode(k).signals.values()]) for k in plain.numbers]
        assert min(np.abs(first - start).max() for start in starts) > 0.01  # the driver has moved the arm before
    info = json.loads((folder / "data" / "meta" / "info.json").read_text())
    assert info["total_episodes"] == len(lengths)


def test_all_frames_are_kept_on_request_and_the_data_set_is_gone_on_with(folder, capsys):
    command = [*COMMON, "--handover", str(folder / "flow"), "--handover.time", "0.5", "0.5", "--keep", "all"]
    assert main([*command, "--episodes", "2", "-o", str(folder / "teacher")]) == 0
    assert main([*command, "--episodes", "2", "--handover.frames", "all", "-o", str(folder / "all")]) == 0
    assert [a - b for a, b in zip(rows(folder / "all"), rows(folder / "teacher"), strict=True)] == [10, 10]
    capsys.readouterr()
    assert main([*command, "--episodes", "3", "-o", str(folder / "teacher"), "--resume"]) == 0
    assert "holds 3 episodes" in capsys.readouterr().out
    other = [*COMMON, "--episodes", "3", "--keep", "all", "-o", str(folder / "teacher"), "--resume"]
    assert main(other) == 2
    assert "driver" in capsys.readouterr().err


def test_a_policy_of_the_state_drives_too(folder):
    shipped = cw.load_policy("shape_sorter")
    cfg = cw.RenderCfg(episodes=2, size=32, cameras=("base",), keep="all", handover=cw.HandoverCfg(time=(0.25, 0.25)))
    found = cw.render(shipped, folder / "state", cfg, driver=shipped, device="cpu")
    assert found.episodes == 2
    longest = 60 + 5  # episodes last as much longer as the driver drives at most
    assert all(length <= longest - 5 for length in rows(folder / "state"))


def test_wrong_drivers_are_refused(folder, capsys):
    def said(*options: str) -> str:
        assert main([*COMMON, "-o", str(folder / "bad"), *options]) == 2
        assert not (folder / "bad").exists()
        return capsys.readouterr().err.strip().splitlines()[-1]

    assert "no such policy" in said("--handover", str(folder / "nowhere"))
    assert "the folder holds no training" in said("--handover", str(folder / "plain"))
    assert "no camera of the policy; expected base" in said("--handover", str(folder / "flow"), "--cameras", "wrist")
    assert "--handover.time is out of bounds" in said("--handover", str(folder / "flow"), "--handover.time", "2", "1")
    shipped = cw.load_policy("shape_sorter")
    with pytest.raises(cw.RenderError, match="not driven"):
        cw.render(shipped.run.recording, folder / "bad", driver=shipped)


def test_flow_policy_is_evaluated_in_simulation_and_reality(folder, capsys):
    command = ["evaluate", "--checkpoint", str(folder / "flow"), "--episodes", "2", "--device", "cpu"]
    assert main([*command, "--task-of", "shape_sorter"]) == 0
    said = capsys.readouterr().out
    assert "simulation: 0 of 2 succeed" in said  # it has hardly learned anything
    assert "reality: " in said
    shipped = cw.load_policy("shape_sorter")
    policy = cw.TaskFlowPolicy(cw.load_flow_policy(folder / "flow"), shipped, "stand still")
    assert cw.TaskFlowPolicy(policy.policy, shipped).instruction == shipped.run.recording[0].task
    assert cw.evaluate(policy, world="simulation", episodes=1, device="cpu").success.shape == (1,)
    for options, what in (
        ((), "a flow policy needs a task"),
        (("--task-of", "dishwasher"), "no such policy"),
        (("--instruction", "go"), "an instruction is for flow policies"),
    ):
        assert main([*command, *options]) == 2
        assert what in capsys.readouterr().err
    assert main(["evaluate", "--pretrained", "--task-of", "shape_sorter"]) == 2
    assert "--task-of is for flow policies" in capsys.readouterr().err


def test_a_policy_that_knows_the_teachers_commands_succeeds(folder, monkeypatch):
    """What turns commands to actions loses nothing: a flow policy that predicts the teacher's commands inserts."""
    shipped = cw.load_policy("shape_sorter")
    flow = cw.load_flow_policy(folder / "flow")
    task = shipped.run.task()
    states = shipped.run.evaluation_states(task, 4, 3)
    environment = make_environment(task, replace(shipped.run.cfg.environment, worlds=4), states, device="cpu")
    teach = shipped.act_in(environment)
    robot, model = task.robot, task.compiled

    def predict(self, *_, **__):
        action = teach(environment.get_observations()).clamp(-1, 1)
        ctrl = environment.physics.ctrl.clone()
        step = torch.as_tensor(robot.step, dtype=ctrl.dtype)
        ctrl[:, robot.actuator.tolist()] += (action * step)[:, : len(robot.actuator)]
        ctrl[:, robot.gripper.tolist()] += (action * step)[:, len(robot.actuator) :]
        order = [model.actuator(name).id for name in self.features.action]
        return ctrl[:, order].numpy().astype(np.float32)[:, None].repeat(self.cfg.chunk, axis=1)

    monkeypatch.setattr(cw.FlowPolicy, "act", predict)
    once = cw.FlowPolicy(replace(flow.cfg, execute=1), flow.features, flow.network, flow.folder)
    images = HybridImages(environment, cw.ImagesCfg(cameras=("base",), size=32))
    act = cw.TaskFlowPolicy(once, shipped).act_in(environment, images)
    assert run_episodes(environment, act, states).success.all()


class _Worlds:
    """What a hand-over looks at of an environment."""

    num_envs, control_step = 3, 0.05

    def __init__(self) -> None:
        self.episode_length_buf = torch.zeros(3, dtype=torch.long)


def test_driver_acts_until_its_time_and_the_same_in_every_call():
    worlds = _Worlds()
    driver, teacher = (lambda _, k=k: torch.full((3, 2), float(k)) for k in (1, 2))

    def steps(episodes) -> list[int]:
        handover = Handover(worlds, driver, teacher, cw.HandoverCfg(time=(0.1, 0.5)), seed=5)  # pyright: ignore
        handover.begin(episodes)
        found = [0, 0, 0]
        for step in range(20):
            worlds.episode_length_buf[:] = step
            action = handover.act(None)  # pyright: ignore[reportArgumentType]
            for world in range(3):
                assert bool(action[world, 0] == 1) is not handover.has_taken_over(world)
                assert handover.is_recorded(world) is handover.has_taken_over(world)
                found[world] += int(action[world, 0] == 1)
        return found

    first = steps([0, 1, 2])
    assert all(2 <= one <= 10 for one in first)
    assert len(set(first)) > 1
    assert steps([2, 0, 1]) == [first[2], first[0], first[1]]
