"""Several data sets as one: episodes one after another, instructions of all, labels where there are any."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.cli.entry import main
from concent_warp.render.dataset.layout import EpisodeLayout
from concent_warp.render.dataset.lerobot import LeRobotWriter
from concent_warp.train.flow.dataset import LABELS, label_names, read_dataset
from concent_warp.train.flow.frames import decode_episodes
from concent_warp.train.flow.sources import open_dataset
from tests.train.flow_dataset import DOWN, SIZE, TINY, UP, image

ACTIONS, LENGTH = ("goal", "side"), 4
QUICK = [
    "--device", "cpu", "--steps", "1", "--batch", "2", "--policy.size", "16", "--policy.width", "16",
    "--policy.layers", "1", "--policy.heads", "2", "--policy.chunk", "2", "--policy.execute", "2",
]  # fmt: skip


def write(folder: Path, task: str, goal: float, *, chunk: int = 0, camera: str = "front", rate: int = 10) -> Path:
    """Write two episodes, all frames labelled with a chunk if it is above 0."""
    more = ((LABELS, label_names(ACTIONS, chunk)),) if chunk else ()
    writer = LeRobotWriter(folder, EpisodeLayout(rate, (camera,), (SIZE, SIZE), ("slider",), ACTIONS, more=more))
    for key in range(2):
        episode = writer.begin(key, task)
        for _ in range(LENGTH):
            label = {LABELS: np.full(2 * chunk, 7.0)} if chunk else None
            episode.add({camera: image(goal)}, np.zeros(1), np.array([goal, 0.0]), more=label)
        episode.save()
    writer.finish()
    return folder


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sources")
    write(folder / "up", UP, 0.5)
    write(folder / "down", DOWN, -0.5, chunk=3)
    return folder


def test_episodes_of_both_follow_one_another(place, tmp_path):
    log = open_dataset(place / "up", place / "down")
    found = read_dataset(log, cw.FlowDataCfg())
    assert found.lengths == [LENGTH] * 4
    assert found.features.tasks == (UP, DOWN)
    assert found.task.tolist() == [0] * 2 * LENGTH + [1] * 2 * LENGTH
    assert found.action[:, 0].tolist() == [0.5] * 2 * LENGTH + [-0.5] * 2 * LENGTH
    assert found.labels is not None
    assert found.labels.shape == (4 * LENGTH, 3, 2)
    assert np.isnan(found.labels[: 2 * LENGTH]).all()
    assert (found.labels[2 * LENGTH :] == 7).all()
    (images,) = decode_episodes(log, found.images, SIZE, found.lengths, tmp_path).arrays()
    for row, goal in ((0, 0.5), (2 * LENGTH, -0.5), (4 * LENGTH - 1, -0.5)):
        assert np.abs(images[row].astype(int) - image(goal)).mean() < 12  # the codec blurs


def test_labels_are_as_long_as_the_shortest(place, tmp_path):
    other = write(tmp_path / "short", UP, 0.0, chunk=2)
    labels = read_dataset(open_dataset(place / "down", other), cw.FlowDataCfg()).labels
    assert labels is not None
    assert labels.shape == (4 * LENGTH, 2, 2)


def test_command_learns_from_both_and_goes_on(place, capsys):
    both = [str(place / name) for name in ("up", "down")]
    assert main(["train-flow", *both, "-o", str(place / "run"), *QUICK]) == 0
    assert "instructions: 2" in capsys.readouterr().out
    assert set(cw.load_flow_policy(place / "run").features.tasks) == {UP, DOWN}
    assert main(["train-flow", *both, "-o", str(place / "run"), *QUICK, "--resume"]) == 0
    assert "nothing is left to train" in capsys.readouterr().out


def test_data_sets_that_do_not_fit_are_refused_in_one_sentence(place, tmp_path, capsys):
    def said(*data: Path | str) -> str:
        assert main(["train-flow", *map(str, data), "-o", str(tmp_path / "run"), *QUICK]) == 2
        assert not (tmp_path / "run").exists()
        return capsys.readouterr().err.strip().splitlines()[-1]

    up = place / "up"
    assert "no data set is given" in said()
    assert "a data set is given twice" in said(up, place / "down", place / "down" / ".." / "up")
    assert "nowhere: no LeRobot data set" in said(up, "nowhere")
    found = said(up, write(tmp_path / "side", UP, 0.0, camera="side"))
    assert "side/meta/info.json: the data set has no such feature of images" in found
    assert "different rates; expected 10 frames/s" in said(up, write(tmp_path / "fast", UP, 0.0, rate=20))


def test_an_interrupted_training_is_of_both_data_sets(place, tmp_path):
    cfg = replace(TINY, steps=2, batch=2, policy=replace(TINY.policy, chunk=2))
    cw.train_flow([place / "up", place / "down"], cfg, device="cpu", out=tmp_path / "run")
    (tmp_path / "run" / "flow_policy.pt").unlink()
    with pytest.raises(cw.TrainError, match="begun with another data set"):
        cw.train_flow(place / "up", cfg, device="cpu", out=tmp_path / "run", resume=True)
