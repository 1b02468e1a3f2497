"""Exported policies do what ours do, and say all that one needs to run them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx.reference import ReferenceEvaluator
from small_insertion import SETTINGS, make_demonstration, make_model
from tensordict import TensorDict

from concent_warp.cli import main
from concent_warp.errors import TrainError
from concent_warp.events.extract import extract
from concent_warp.recording.recording import Recording
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.train.cfg import PpoCfg, TrainCfg
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import TrainingRun, train_run

Trained = tuple[Path, torch.Tensor, torch.Tensor]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Trained:
    """Return a run folder, observations, and what its policy does there."""
    model = make_model()
    recording = Recording(model.scene.xml, (make_demonstration(model),))
    events = extract(model, recording[0], MujocoEngine(model, threads=1))
    ppo = PpoCfg(iterations=2, steps=4, hidden=(32, 16), epochs=2, batches=2)
    environment = replace(SETTINGS, worlds=4, reset=replace(SETTINGS.reset, states=8))
    folder = tmp_path_factory.mktemp("run")
    trainer, _ = train_run(
        TrainingRun(model, recording, events, TrainCfg(environment=environment, ppo=ppo)), folder, device="cpu"
    )
    seen = trainer.environment.get_observations()["policy"]
    seen = seen[[0, 1, 2, 3, 0]] + 0.3 * torch.randn(5, seen.shape[1], generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        actions = trainer.policy()(TensorDict({"policy": seen}, batch_size=[5]))
    return folder, seen, actions.clone()


def test_onnx_policy_acts_as_ours(trained, tmp_path):
    folder, seen, actions = trained
    assert main(["export", "--checkpoint", str(folder), "--out", f"{tmp_path}/policy.onnx"]) == 0
    (found,) = list(ReferenceEvaluator(f"{tmp_path}/policy.onnx").run(None, {"observation": seen.numpy()}))
    assert actions.abs().max() > 1e-2
    np.testing.assert_allclose(np.asarray(found), actions.numpy(), rtol=0, atol=1e-5)


def test_torchscript_policy_acts_as_ours(trained, tmp_path):
    folder, seen, actions = trained
    described = Policy.load(folder).export(tmp_path / "policy.pt")
    extra: dict[str, Any] = {"concent.json": ""}
    policy = torch.jit.load(str(tmp_path / "policy.pt"), _extra_files=extra)
    torch.testing.assert_close(policy(seen), actions, rtol=0, atol=1e-5)
    assert json.loads(extra["concent.json"]) == described


def test_metadata_says_what_the_numbers_are(trained, tmp_path):
    folder, seen, _ = trained
    Policy.load(folder).export(tmp_path / "policy.onnx")
    model = onnx.load(tmp_path / "policy.onnx")
    said = json.loads({p.key: p.value for p in model.metadata_props}["concent"])
    parts = said["observation"]["parts"]
    assert [p["start"] for p in parts] == np.cumsum([0, *(p["size"] for p in parts[:-1])]).tolist()
    assert said["observation"]["size"] == sum(p["size"] for p in parts) == seen.shape[1]
    assert {p["name"]: p["of"] for p in parts}["object 1"] == ["block"]
    assert len(said["observation"]["slots"]["pairs"]) == 8
    assert said["control period"] == pytest.approx(0.05)
    assert [p["name"] for p in said["action"]["parts"]] == ["x", "y", "z", "gripper"]
    assert [p["scale"] for p in said["action"]["parts"]] == [0.004, 0.004, 0.004, 0.0005]
    assert [p["lead"] for p in said["action"]["parts"]] == [0.015, 0.015, 0.015, None]
    assert said["action"]["parts"][-1]["limits"] == [-0.01, 0.03]
    assert said["gripper"]["weights"] == {"left": 1.0}
    assert said["versions"]["torch"] == torch.__version__


def test_commands_follow_from_metadata_alone(trained, tmp_path):
    """What the metadata says of an action is what the environment does with it."""
    from concent_warp.train.environment.worlds import make_environment

    folder, _, _ = trained
    said = Policy.load(folder).export(tmp_path / "policy.onnx")
    run = TrainingRun.load(folder)
    task = run.task()
    environment = make_environment(task, run.cfg.environment, run.evaluation_states(task, 4, 0), device="cpu")
    environment.start_from(range(4))
    m, ctrl = task.compiled, environment.physics.ctrl.numpy().copy()
    qpos = environment.physics.qpos.numpy().copy()
    action = np.random.default_rng(0).uniform(-1, 1, (4, 4)).astype(np.float32)
    environment.step(torch.as_tensor(action))
    for i, part in enumerate(said["action"]["parts"]):
        names = part.get("actuators", [part["name"]])
        column = m.actuator(names[0]).id
        command = ctrl[:, column] + part["scale"] * action[:, i]
        if part["lead"] is not None:
            at = qpos[:, m.joint(part["joint"]).qposadr[0]]
            command = np.clip(command, at + part["hold"] - part["lead"], at + part["hold"] + part["lead"])
        if part["limits"] is not None:
            command = np.clip(command, *part["limits"])
        np.testing.assert_allclose(environment.physics.ctrl[:, column], command, atol=1e-6)


def test_other_formats_and_files_in_the_way_are_refused(trained, tmp_path, capsys):
    folder, _, _ = trained
    with pytest.raises(TrainError, match="onnx"):
        Policy.load(folder).export(tmp_path / "policy.bin")
    (tmp_path / "policy.pt").write_text("mine")
    assert main(["export", "--checkpoint", str(folder), "--out", f"{tmp_path}/policy.pt"]) == 2
    assert "overwrite" in capsys.readouterr().err
    assert (tmp_path / "policy.pt").read_text() == "mine"
    assert main(["export", "--checkpoint", str(tmp_path), "--out", f"{tmp_path}/policy.onnx"]) == 2
    assert "holds no training" in capsys.readouterr().err
