"""A flow policy learns what a tiny data set shows, two modes included, and does what it is told."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx.reference import ReferenceEvaluator

import concent_warp as cw
from concent_warp.train.flow.learning import FlowTraining
from concent_warp.train.flow.network import FlowPolicyNetwork
from concent_warp.train.flow.policy import POLICY
from concent_warp.train.flow.receding_horizon import RecedingHorizon
from concent_warp.train.learning.metrics import read_curve
from tests.train.flow_dataset import DOWN, SIZE, TINY, UP, image, write_dataset

GOALS = np.tile(-0.9 + 0.2 * np.arange(10), 7)[:64]
SHOWN = {"front": np.stack([image(goal) for goal in GOALS])}
STATES = np.zeros((len(GOALS), 1))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a data set and the run of a training on it."""
    folder = tmp_path_factory.mktemp("flow")
    write_dataset(folder / "data")
    said = []
    cw.train_flow(folder / "data", TINY, device="cpu", out=folder / "run", progress=said.append)
    assert [one.work for one in said][:1] == ["reading images"]
    assert said[-1].step.done == TINY.steps
    return folder


@pytest.fixture
def policy(trained) -> cw.FlowPolicy:
    torch.manual_seed(0)
    return cw.load_flow_policy(trained / "run")


def test_actions_follow_the_image(policy):
    found = policy.act(SHOWN, STATES, UP)
    assert found.shape == (64, 4, 3)
    assert found.dtype == np.float32
    assert np.abs(found[:, :, 0] - GOALS[:, None]).mean() < 0.12


def test_samples_have_both_modes_of_the_data_and_not_their_mean(policy):
    side = policy.act(SHOWN, STATES, UP)[:, :, 1].mean(axis=1)
    assert (np.abs(side) > 0.5).mean() > 0.7  # a policy that regresses gives their mean, 0, everywhere
    assert 0.2 < (side > 0).mean() < 0.8
    assert side.std() > 0.75


def test_instruction_changes_the_action(policy):
    noise = torch.randn(64, 4, 3)
    up, down = (policy.act(SHOWN, STATES, text, noise=noise)[:, :, 2] for text in (UP, DOWN))
    assert np.abs(up - 1).mean() < 0.2
    assert np.abs(down + 1).mean() < 0.2
    each = policy.act(SHOWN, STATES, [UP, DOWN] * 32, noise=noise)[:, :, 2]
    np.testing.assert_allclose(each[0::2], up[0::2], atol=1e-4)
    np.testing.assert_allclose(each[1::2], down[1::2], atol=1e-4)


def test_loss_reaches_what_two_modes_leave_and_metrics_are_written(trained):
    points = read_curve(trained / "run")
    assert [point["steps"] for point in points] == [70, 140, 210]
    assert points[-1]["loss"] < points[0]["loss"] < 2
    assert points[-1]["validation loss"] < points[0]["validation loss"]
    assert any((trained / "run").glob("events.out.tfevents.*"))
    assert not (trained / "run" / "frames").exists()


def test_policy_knows_names_and_statistics_of_its_data(policy):
    features = policy.features
    assert features.cameras == ("front",)
    assert (features.state, features.action) == (("slider",), ("goal", "side", "lift"))
    assert set(features.tasks) == {UP, DOWN}
    assert features.rate == 10
    assert policy.network.action_std[1:].tolist() == pytest.approx([1, 1], abs=0.05)
    assert abs(float(policy.network.state_mean[0])) < 0.3


def test_images_of_other_sizes_are_resized(policy):
    noise = torch.randn(64, 4, 3)
    large = {"front": SHOWN["front"].repeat(4, axis=1).repeat(4, axis=2)}
    difference = policy.act(large, STATES, UP, noise=noise) - policy.act(SHOWN, STATES, UP, noise=noise)
    assert np.abs(difference).mean() < 0.02


def test_file_of_a_policy_is_read_alone(policy, tmp_path):
    policy.save(tmp_path / "copy.pt")
    noise = torch.randn(64, 4, 3)
    copy = cw.load_flow_policy(tmp_path / "copy.pt")
    np.testing.assert_array_equal(copy.act(SHOWN, STATES, UP, noise=noise), policy.act(SHOWN, STATES, UP, noise=noise))


def test_onnx_samples_as_the_policy_and_tells_how_to_run_it(policy, tmp_path):
    torch.manual_seed(1)
    small = replace(policy.cfg.small, channels=(8, 8), text_layers=0, fusion_layers=1)
    cfg = replace(policy.cfg, layers=1, causal=True, small=small)
    network = FlowPolicyNetwork(cfg, 1, 1, 3).eval()
    for layer in (network.transformer.modulation, network.transformer.out):  # which begin at zero
        torch.nn.init.normal_(layer.weight, std=0.3)
    network.action_mean.fill_(0.5)
    network.action_std.fill_(2.0)
    policy = replace(policy, cfg=cfg, network=network)
    said = policy.export(tmp_path / "policy.onnx")
    text = UP.encode()
    tokens = np.array([[256, *text]] * 3)
    noise = torch.randn(3, 4, 3)
    given = {
        "image_front": SHOWN["front"][:3], "proprioception": STATES[:3].astype(np.float32), "tokens": tokens,
        "mask": np.ones(tokens.shape, dtype=bool), "noise": noise.numpy(),
    }  # fmt: skip
    outputs: Any = ReferenceEvaluator(str(tmp_path / "policy.onnx")).run(None, given)
    found = outputs[0]
    expected = policy.act({"front": SHOWN["front"][:3]}, STATES[:3], UP, noise=noise)
    np.testing.assert_allclose(found, expected, atol=2e-4)
    written = {p.key: p.value for p in onnx.load(tmp_path / "policy.onnx").metadata_props}
    assert json.loads(written["concent"]) == said
    assert said["images"] == {"image_front": [SIZE, SIZE, 3]}
    assert (said["proprioception"], said["chunk"], said["rate"]) == (["slider"], 4, 10)
    with pytest.raises(cw.TrainError, match="export format"):
        policy.export(tmp_path / "policy.pb")


def test_chunks_are_executed_in_part_and_dropped_where_an_episode_begins(policy):
    seen, own = {"front": SHOWN["front"][:2]}, STATES[:2]
    calls = []
    act = type(policy).act

    class Counted(type(policy)):
        def act(self, images, proprioception, text, **given):
            calls.append(len(proprioception))
            return act(self, images, proprioception, text, **given)

    counted = Counted(policy.cfg, policy.features, policy.network, policy.folder)
    controller = RecedingHorizon(counted, UP)
    actions = [controller.act(seen, own) for _ in range(4)]
    assert calls == [2, 2]  # two of four actions are executed
    assert actions[0].shape == (2, 3)
    controller.act(seen, own, started=np.array([False, True]))
    assert calls == [2, 2, 2]
    controller.act(seen, own, started=np.array([False, True]))
    assert calls == [2, 2, 2, 1]
    with pytest.raises(cw.TrainError, match="executed actions"):
        RecedingHorizon(policy, UP, execute=5)


def test_wrong_inputs_are_refused(policy):
    for images, states, text, said in (
        ({"side": SHOWN["front"]}, STATES, UP, "no images of 'front'"),
        ({"front": SHOWN["front"] / 255}, STATES, UP, "uint8"),
        ({"front": SHOWN["front"][:3]}, STATES, UP, "(64, H, W, 3)"),
        (SHOWN, np.zeros((64, 2)), UP, "(N, 1)"),
        (SHOWN, STATES, [UP], "number of instructions"),
        (SHOWN, STATES, "a" * 41, "at most 40 bytes"),
    ):
        with pytest.raises(cw.TrainError) as error:
            policy.act(images, states, text)
        assert said in str(error.value)
    with pytest.raises(cw.TrainError, match="noise"):
        policy.act(SHOWN, STATES, UP, noise=torch.zeros(1, 4, 3))


# A step that is interrupted stands for a validation that is.
@pytest.mark.parametrize("where", ["_step", pytest.param("validated", marks=pytest.mark.slow)])
def test_continued_training_is_the_one_without_interruption(trained, tmp_path, monkeypatch, where):
    cfg = replace(TINY, steps=30, validate=10, checkpoint=1e6)
    whole = cw.train_flow(trained / "data", cfg, device="cpu", out=tmp_path / "whole")
    method = getattr(FlowTraining, where)

    def interrupted(self, *given):
        if self.done == {"_step": 17, "validated": 20}[where]:
            raise KeyboardInterrupt
        return method(self, *given)

    run = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr(FlowTraining, where, interrupted)
        with pytest.raises(KeyboardInterrupt):
            cw.train_flow(trained / "data", cfg, device="cpu", out=run)
    unfinished = cw.load_flow_policy(run)
    assert not (run / POLICY).exists()
    with pytest.raises(cw.ConcentError, match="interrupted"):
        cw.train_flow(trained / "data", cfg, device="cpu", out=run)
    with pytest.raises(cw.ConcentError, match="other settings"):
        cw.train_flow(trained / "data", replace(cfg, batch=8), device="cpu", out=run, resume=True)
    resumed = cw.train_flow(trained / "data", cfg, device="cpu", out=run, resume=True)
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, resumed.network.state_dict()[name]), name
    states = [policy.network.state_dict()["state.0.weight"] for policy in (unfinished, resumed)]
    assert not torch.equal(*states)
    points = [{k: v for k, v in p.items() if k != "seconds"} for p in read_curve(run)]
    assert points == [{k: v for k, v in p.items() if k != "seconds"} for p in read_curve(tmp_path / "whole")]
    assert [point["steps"] for point in points] == [10, 20, 30]
    again = cw.train_flow(trained / "data", cfg, device="cpu", out=run, resume=True)
    assert torch.equal(again.network.no_state, resumed.network.no_state)
