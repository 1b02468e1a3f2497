"""A trial of Table 1: which policy and model it takes, and how it counts outcomes and targets, on chosen motions."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from concent_warp.kernels.contact_pairs import PairTable
from concent_warp.train.environment.environment import Environment
from concent_warp.train.task.task import Task
from tests.train.made_up_task import SETTINGS, ChosenPhysics, changed, made_up_states, make_task

EPISODES = 35
CFG = changed(
    SETTINGS, stage="all", worlds=4096, engine="warp", episode=0.9, success=0.0625, lost=0.5, max_position=64.0,
    chain={"rest": 0.48},
)  # fmt: skip
PATHS = ("success", "lost", "diverged", "missed", "late")
"""What happens in the episodes in turn."""


@pytest.fixture
def train_table1(script):
    threads = torch.get_num_threads()
    yield script("benchmarks.train.table1")
    torch.set_num_threads(threads)


def exact_task(last: int = 2) -> Task:
    """Return a task in which every stage brings the origins of block and box together."""
    task = make_task(CFG, target=(0.0, 0.0, 0.0), last=last)
    shape = task.table.used.shape
    block, box = (np.full(shape, task.compiled.body(name).id) for name in ("block", "box"))
    active, points = np.broadcast_to([True, False, False], shape), np.zeros((*shape, 3))
    table = PairTable(block, points, points[..., 0], box, points, points[..., 0], points, active)
    return replace(task, table=table, robot_slots=np.zeros(shape, bool))


def place(path: str, step: int) -> float:
    """Return where the block is after so many steps, as the distance from its place."""
    if path == "success":
        return 0.0
    if path == "lost":
        return 2.0
    if path == "diverged":
        return 0.003 if step <= 2 else 70.0
    return 0.1 if path == "missed" or step <= 11 else 0.0


class ChosenPolicy:
    """A policy whose worlds move as chosen."""

    def __init__(self, task: Task) -> None:
        self.run = SimpleNamespace(task=lambda: task, cfg=SimpleNamespace(environment=CFG))
        self.scales: list[float] = []

    def scaled(self, *, setpoint_lead_scale: float) -> "ChosenPolicy":
        self.scales.append(setpoint_lead_scale)
        return self

    def act_in(self, environment: Environment):
        physics, done = environment.physics, {"batch": -1, "step": 0}
        assert isinstance(physics, ChosenPhysics)

        def act(_):
            # An episode begins with the block 0.3 m above its place.
            if bool((environment.episode_length_buf == 0).all()) and bool((physics.qpos[:, 2] > 0.2).all()):
                done["batch"], done["step"] = done["batch"] + 1, 0
            done["step"] += 1
            qpos = np.tile(environment.task.compiled.qpos0, (environment.num_envs, 1))
            qpos[:, 2] = 0.0
            for world in range(environment.num_envs):
                episode = (done["batch"] * environment.num_envs + world) % EPISODES
                qpos[world, 0] = place(PATHS[episode % len(PATHS)], done["step"])
            physics.chosen = qpos, np.zeros((environment.num_envs, environment.task.compiled.nv))
            return torch.zeros(environment.num_envs, environment.num_actions)

        return act


@pytest.fixture
def trial(train_table1, monkeypatch, tmp_path):
    """Run a trial of a case whose policy is trained on stages up to `last`; return row and what was asked for."""

    def run(case: str, last: int = 2, **options):
        args = train_table1.Args(tmp_path, episodes=EPISODES, stage="all", **options)
        folder = train_table1.policy_folder(args, case, 3)
        folder.mkdir(parents=True)
        result = {
            "settings": {}, "simulation": {"rate": 0.75}, "stage": "all", "steps": 12, "seconds": 61.0, "worlds": 8,
            "machine": {"processor": "x"}, "other": 1,
        }  # fmt: skip
        (folder.parent / train_table1.RESULT).write_text(json.dumps(result))
        asked: dict = {"loaded": []}
        policy, judge = ChosenPolicy(exact_task(last)), exact_task()
        states = made_up_states(judge, EPISODES)
        states.qpos[:], states.qvel[:] = judge.compiled.qpos0, 0.0
        states.mocap[:] = [0, 0, 0, 1, 0, 0, 0]
        states.begins[:], states.stage[:] = True, np.arange(EPISODES) % 3

        def load_policy(where):
            asked["loaded"].append(where)
            return policy

        def load_run(where):
            asked["judge"] = where
            return SimpleNamespace(task=lambda: judge, evaluation_states=evaluation_states)

        def evaluation_states(of, count, seed):
            assert of is judge
            asked["states"] = count, seed
            return states

        def reality_environment(task, cfg, starts, world, seed):
            asked["cfg"], asked["starts"], asked["world"], asked["seed"] = cfg, starts, world, seed
            return Environment(
                task, replace(cfg, collision="full"), ChosenPhysics(task.compiled, cfg.worlds, 3), starts
            )

        monkeypatch.setattr(train_table1.Policy, "load", staticmethod(load_policy))
        monkeypatch.setattr(train_table1.TrainingRun, "load", staticmethod(load_run))
        monkeypatch.setattr(train_table1, "reality_environment", reality_environment)
        asked["args"], asked["policy"] = args, policy
        return train_table1.trial(args, case, 3), asked

    return run


def test_a_trial_counts_outcomes_and_targets_of_every_episode(trial, train_table1):
    row, asked = trial("ours", setpoint_lead_scale=0.5)
    each = EPISODES // 5
    assert row["outcomes"] == {"diverged": each, "dropped": each, "missed": each, "success": 2 * each}
    assert row["successes"] == 2 * each
    assert (row["case"], row["seed"], row["episodes"], row["stages"]) == ("ours", 3, EPISODES, 3)
    # Positions count that a step begins with, and two together within 4 mm meet a target. In place from the first
    # step: 7 of 8. Lost at once: none. 3 mm off after two steps, then diverged: one target. Late: 3 of 15 steps.
    assert row["met"] == [3, 0, 1, 0, 1] * each
    assert row["simulation"] == {"rate": 0.75}
    assert row["trained"] == {"stage": "all", "steps": 12, "seconds": 61.0, "worlds": 8}
    assert row["trained_on"] == {"processor": "x"}
    assert row["hidden"] == []
    assert row["setpoint_lead_scale"] == 0.5
    assert asked["policy"].scales == [0.5]
    folder = train_table1.policy_folder(asked["args"], "ours", 3)
    assert asked["loaded"] == [folder]
    assert asked["judge"] == folder
    assert asked["states"] == (EPISODES, 3)
    assert asked["cfg"] == replace(CFG, worlds=32, engine="mujoco", dropped=0.05)
    assert asked["world"].hide == ()


def test_a_policy_of_fewer_stages_starts_in_its_own_and_is_judged_by_all(trial, train_table1):
    row, asked = trial("surface", last=1)
    assert asked["starts"].stage.tolist() == [min(s % 3, 1) for s in range(EPISODES)]
    assert row["stages"] == 3
    assert row["met"][0] == 3
    assert asked["judge"] == train_table1.policy_folder(asked["args"], "ours", 3)


def test_what_is_hidden_is_hidden_in_the_world_of_the_trial(trial, train_table1):
    row, asked = trial("aware", hidden="actuator_delay=0.2")
    assert row["hidden"] == ["actuator_delay=0.2"]
    assert asked["world"].hide == ("actuator_delay=0.2",)
    assert asked["judge"] == train_table1.policy_folder(asked["args"], "unaware", 3)
    name = train_table1.key(asked["args"], "aware", 3)
    assert name == train_table1.named(row, "all")
    assert name == "aware all 3 60 s hiding actuator_delay=0.2"
