"""Frames in which another policy drives, with what the teacher would do from there on: what a flow policy learns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.cli.entry import main
from concent_warp.recording.logs.readers.lerobot import LeRobotLog
from concent_warp.train.flow.dataset import FlowDataset, read_dataset
from concent_warp.train.flow.sources import open_dataset

CHUNK, DRIVEN = 4, 8
HANDOVER = cw.HandoverCfg(time=(0.4, 0.4), frames="labelled", chunk=CHUNK)
RENDER = cw.RenderCfg(episodes=2, worlds=2, size=16, cameras=("base",), keep="all", handover=HANDOVER)
FLOW = cw.TrainFlowCfg(
    steps=2, batch=2, policy=cw.FlowPolicyCfg(size=16, width=16, layers=1, heads=2, chunk=CHUNK, execute=2)
)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with data sets: driven by a flow policy that has hardly learned anything, and by the teacher."""
    folder, teacher = tmp_path_factory.mktemp("labels"), cw.load_policy("shape_sorter")
    cfg = cw.RenderCfg(episodes=2, worlds=2, size=16, cameras=("base",), keep="all")
    cw.render(teacher, folder / "plain", cfg, device="cpu")
    flow = cw.train_flow(folder / "plain", FLOW, device="cpu", out=folder / "flow")
    cw.render(teacher, folder / "by_flow", RENDER, driver=flow, device="cpu")
    cw.render(teacher, folder / "by_teacher", RENDER, driver=teacher, device="cpu")
    return folder


def read(folder: Path) -> FlowDataset:
    """Return the numbers of a data set."""
    return read_dataset(open_dataset(folder), cw.FlowDataCfg())


def test_labels_are_what_the_teacher_does_next_where_it_is_the_driver(place):
    data = read(place / "by_teacher")
    assert data.labels is not None
    for first in data.start[:-1]:
        for row in range(first, first + DRIVEN):
            np.testing.assert_array_equal(data.labels[row], data.action[row : row + CHUNK])
        assert np.isnan(data.labels[first + DRIVEN]).all()


def test_frames_of_a_bad_driver_have_the_teachers_labels_and_those_after_it_none(place):
    data, plain = read(place / "by_flow"), read(place / "plain")
    assert data.labels is not None
    assert data.labels.shape == (len(data.action), CHUNK, len(data.features.action))
    assert plain.labels is None
    known = np.isfinite(data.labels[:, 0, 0])
    np.testing.assert_array_equal(np.isfinite(data.labels), np.broadcast_to(known[:, None, None], data.labels.shape))
    for k, first in enumerate(data.start[:-1]):
        assert known[first : data.start[k + 1]].tolist() == [step < DRIVEN for step in range(data.start[k + 1] - first)]
    np.testing.assert_array_equal(data.action[known], data.labels[known][:, 0])
    # The state went where the driver led: what came next is not what the label says.
    inner = np.flatnonzero(known)[: DRIVEN - CHUNK]
    ahead = np.stack([data.state[row + CHUNK, :7] for row in inner])
    assert np.abs(ahead - data.labels[inner, -1, :7]).max() > 0.01


def test_branching_changes_nothing_of_the_episodes(place, tmp_path):
    cfg = cw.RenderCfg(
        episodes=2, worlds=2, size=16, cameras=("base",), keep="all",
        handover=cw.HandoverCfg(time=HANDOVER.time, frames="all"),
    )  # fmt: skip
    teacher = cw.load_policy("shape_sorter")
    cw.render(teacher, tmp_path / "all", cfg, driver=teacher, device="cpu")
    expected, found = read(tmp_path / "all"), read(place / "by_teacher")
    np.testing.assert_array_equal(found.state, expected.state)
    np.testing.assert_array_equal(found.action, expected.action)


def test_command_writes_labels_and_a_training_learns_from_them(place, capsys):
    command = [
        "render", "--pretrained", "--handover", str(place / "flow"), "--handover.frames", "labelled", "--size", "16",
        "--cameras", "base", "--device", "cpu", "--episodes", "1", "--keep", "all",
    ]  # fmt: skip
    assert main([*command, "-o", str(place / "command"), "--handover.time", "0.2", "0.2"]) == 0
    features = LeRobotLog(place / "command").features
    assert features["teacher_chunk"]["shape"] == [16 * len(features["action"]["names"])]
    train = ["train-flow", str(place / "command"), "--device", "cpu", "--steps", "1", "--batch", "2"]
    sizes = ["--policy.size", "16", "--policy.width", "16", "--policy.layers", "1", "--policy.heads", "2"]
    assert main([*train, *sizes, "-o", str(place / "learned")]) == 0
    capsys.readouterr()
    assert main([*train, *sizes, "--policy.chunk", "17", "-o", str(place / "long")]) == 2
    assert (
        "labels of the data set are shorter than the policy's chunks; expected at least 17" in capsys.readouterr().err
    )
    assert main([*train, *sizes, "--policy.chunk", "17", "--data.no-labels", "-o", str(place / "long")]) == 0
    capsys.readouterr()
    assert main([*command, "--format", "robomimic", "-o", str(place / "robomimic")]) == 2
    assert "this format has no place for labels" in capsys.readouterr().err
    assert not (place / "robomimic").exists()
