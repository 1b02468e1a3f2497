# pyright: reportMissingImports=false
"""The plug-ins for lerobot, in an environment that has it: `make lerobot` builds one and runs these tests there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="needs an environment with lerobot: make lerobot")
pytest.importorskip("lerobot_policy_concent", reason="needs the plug-ins: make lerobot")
pytest.importorskip("lerobot_env_concent", reason="needs the plug-ins: make lerobot")

import gymnasium as gym
from gymnasium.utils.env_checker import check_env
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env, preprocess_observation
from lerobot.envs.factory import make_env_config
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from teacher_commands import TeacherCommands  # a package of the environment is called tests too

import concent_warp as cw
from lerobot_env_concent import GYM_ID, ConcentEnv, ConcentTrialEnv
from lerobot_policy_concent import ConcentConfig, ConcentPolicy
from lerobot_policy_concent.convert import convert

BIN = Path(sys.executable).parent
FLOW = cw.TrainFlowCfg(
    steps=2, batch=2, policy=cw.FlowPolicyCfg(size=16, width=16, layers=1, heads=2, chunk=4, execute=3)
)
STUDENT = cw.DistilCfg(
    states=4,
    images=cw.ImagesCfg(size=24, samples=1, frames=2),
    dagger=cw.DaggerCfg(iterations=1, worlds=2, steps=2, updates=1, batch=2),
)


@dataclass(frozen=True)
class Runs:
    """Folders of a data set and of policies that have hardly learned anything."""

    data: Path
    flow: Path
    student: Path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    place = tmp_path_factory.mktemp("lerobot")
    teacher = cw.load_policy("shape_sorter")
    cw.render(teacher, place / "data", cw.RenderCfg(episodes=2, size=32, keep="all"), device="cpu")
    cw.train_flow(place / "data", FLOW, device="cpu", out=place / "flow")
    cw.distil(teacher, STUDENT, device="cpu", out=place / "student")
    return Runs(place / "data", place / "flow", place / "student")


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """Return a batch of two observations as lerobot's evaluation makes it."""
    envs = make_env(make_env_config("concent", size=32, device="cpu"), n_envs=2)["concent"][0]
    observation, _ = envs.reset(seed=[3, 4])
    batch = preprocess_observation(observation)
    batch["task"] = list(envs.call("task_description"))
    envs.close()
    return batch


def shown(batch: dict[str, Any], name: str) -> np.ndarray:
    """Return the images of a camera as cameras give them, shape (N, H, W, 3) uint8."""
    return (255 * batch[f"observation.images.{name}"]).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()


def test_lerobot_finds_both_by_their_names():
    code = (
        "from lerobot.utils.import_utils import register_third_party_plugins as register; register();"
        "from lerobot.configs import PreTrainedConfig as P; from lerobot.envs import EnvConfig as E;"
        "print('concent' in P.get_known_choices(), 'concent' in E.get_known_choices())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200, check=True)
    assert done.stdout.split()[-2:] == ["True", "True"]


def test_flow_policy_acts_in_lerobot_as_it_does_here(runs, seen):
    here = cw.load_flow_policy(runs.flow)
    policy = ConcentPolicy(ConcentConfig(run=str(runs.flow), device="cpu"))
    noise = torch.randn(2, 4, len(here.features.action))
    images = {name: shown(seen, name) for name in here.features.cameras}
    expected = here.act(images, seen["observation.state"], seen["task"], noise=noise)
    found = policy.predict_action_chunk(seen, noise=noise)
    assert found.shape == (2, 4, 8)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)
    first = [policy.select_action(seen, noise=noise) for _ in range(3)]
    np.testing.assert_allclose(torch.stack(first, dim=1).numpy(), expected[:, :3], atol=1e-6)
    other = policy.select_action(seen, noise=-noise)  # the fourth is of a new chunk, since three are executed
    assert (other - found[:, 3]).abs().max() > 1e-3
    policy.reset()
    np.testing.assert_allclose(policy.select_action(seen, noise=noise).numpy(), expected[:, 0], atol=1e-6)


def test_student_acts_in_lerobot_as_it_does_here(runs, seen):
    here = cw.load_student(runs.student)
    policy = ConcentPolicy(ConcentConfig(run=str(runs.student), device="cpu"))
    moved = {**seen, **{f"observation.images.{n}": seen[f"observation.images.{n}"].flip(3) for n in ("base", "wrist")}}
    small = []
    for batch in (seen, moved):
        found = {n: torch.from_numpy(shown(batch, n)).permute(0, 3, 1, 2).float() for n in ("base", "wrist")}
        small.append(
            torch.stack(
                [torch.nn.functional.interpolate(i, (24, 24), mode="bilinear", antialias=True) for i in found.values()],
                dim=1,
            ).round()
        )
    robot, own = here.run.task().robot, seen["observation.proprioception"]
    controller = here.controller()
    # The latest image is first; at the beginning all was as it is.
    for batch, images in ((seen, (small[0], small[0])), (moved, (small[1], small[0]))):
        action = controller.act(torch.cat(images, dim=2).to(torch.uint8), own)
        expected = seen["observation.command"].numpy().copy()
        expected[:, robot.actuator] += action[:, :7] * robot.step[:7]
        expected[:, robot.gripper] += action[:, 7:] * robot.step[7:]
        np.testing.assert_allclose(policy.select_action(batch).numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["flow", "student"])
def test_saved_policy_needs_no_run_folder(runs, seen, kind, tmp_path):
    run = getattr(runs, kind)
    folder = convert(run, tmp_path / "saved")
    assert "run" not in (json.loads((folder / "config.json").read_text())["run"] or "")
    register_third_party_plugins()
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.device = folder, "cpu"
    policy = make_policy(config, env_cfg=make_env_config("concent", size=32, device="cpu"))
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    direct = ConcentPolicy(ConcentConfig(run=str(run), device="cpu"))
    noise = torch.randn(2, 4, 8)
    found = after(policy.predict_action_chunk(before(dict(seen)), noise=noise))
    np.testing.assert_allclose(found.numpy(), direct.predict_action_chunk(seen, noise=noise).numpy(), atol=1e-6)
    with pytest.raises(cw.ConcentError, match="not empty"):
        convert(run, folder)


def test_wrong_policies_are_refused(runs, seen):
    with pytest.raises(ValueError, match="no policy is given"):
        ConcentPolicy(ConcentConfig(device="cpu"))
    with pytest.raises(cw.TrainError, match="no policy that sees"):
        ConcentPolicy(ConcentConfig(run=str(runs.data), device="cpu"))
    with pytest.raises(ValueError, match="expected 1 to 4"):
        ConcentPolicy(ConcentConfig(run=str(runs.flow), n_action_steps=5, device="cpu"))
    policy = ConcentPolicy(ConcentConfig(run=str(runs.flow), device="cpu"))
    with pytest.raises(cw.TrainError, match=r"lacks what the policy needs; expected observation.images.base"):
        policy.select_action({n: v for n, v in seen.items() if "images" not in n})


def test_environment_keeps_the_rules_of_gymnasium():
    env = gym.make(GYM_ID, size=16, device="cpu", disable_env_checker=True)
    check_env(env.unwrapped, skip_render_check=False)


def test_teacher_succeeds_through_the_environment():
    env = ConcentTrialEnv("shape_sorter", size=16, device="cpu")
    _, info = env.reset(seed=1)
    assert info == {"is_success": False}
    driver = TeacherCommands(cw.load_policy("shape_sorter"), env.trials)
    while True:
        observation, reward, terminated, truncated, info = env.step(driver.next())
        assert env.observation_space.contains(observation)
        if terminated or truncated:
            break
        assert reward == 0
    assert (reward, terminated, truncated, info) == (1, True, False, {"is_success": True, "outcome": "success"})
    assert env.render().shape == (16, 32, 3)


def test_cameras_of_a_student_are_the_default_of_its_environment(runs):
    config = ConcentEnv(task_of=str(runs.student), device="cpu")
    assert config.features["observation.images.base"].shape == (24, 24, 3)
    assert config.fps == 20
    assert config.features_map["proprioception"] == "observation.proprioception"


@pytest.mark.parametrize("kind", ["flow", "student"])
def test_lerobots_own_evaluation_runs_an_episode(runs, kind, tmp_path):
    command = [
        BIN / "lerobot-eval", "--policy.type=concent", f"--policy.run={getattr(runs, kind)}", "--policy.device=cpu",
        "--env.type=concent", "--env.size=32", "--env.device=cpu", "--eval.n_episodes=1", "--eval.batch_size=1",
        f"--output_dir={tmp_path}",
    ]  # fmt: skip
    environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    overall = json.loads((tmp_path / "eval_info.json").read_text())["overall"]
    assert overall["n_episodes"] == 1
    assert overall["pc_success"] in (0.0, 100.0)
    assert Path(overall["video_paths"][0]).stat().st_size > 0


def test_lerobot_opens_data_sets_of_render(runs):
    data = LeRobotDataset("concent/test", root=runs.data)
    log = cw.load_policy("shape_sorter").run.recording[0]
    item = data[0]
    assert item["task"] == log.task
    assert item["observation.images.base"].shape == (3, 32, 32)
    assert item["action"].shape == (8,)
    assert data.num_episodes == 2
