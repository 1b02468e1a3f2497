"""Chunk labels of a data set: a training takes them in place of what happened next, and bad ones are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import concent_warp as cw
from concent_warp.render.dataset.layout import EpisodeLayout
from concent_warp.render.dataset.lerobot import LeRobotWriter
from concent_warp.train.flow.dataset import LABELS, label_names, read_dataset
from concent_warp.train.flow.learning import FlowTraining
from concent_warp.train.flow.sources import open_dataset
from tests.train.flow_dataset import RATE, SIZE, TINY, image

LENGTH, CHUNK, ACTIONS = 6, 5, ("goal", "side")


def label(frame: int) -> np.ndarray:
    """Return the label of a frame, shape (CHUNK, 2)."""
    return 100 * frame + np.arange(2 * CHUNK, dtype=np.float32).reshape(CHUNK, 2)


def write(folder: Path, *, half_known: bool = False) -> Path:
    """Write two episodes, of which the first three frames have labels."""
    layout = EpisodeLayout(
        RATE, ("front",), (SIZE, SIZE), ("slider",), ACTIONS, more=((LABELS, label_names(ACTIONS, CHUNK)),)
    )
    writer = LeRobotWriter(folder, layout)
    for key in range(2):
        episode = writer.begin(key, "push")
        for k in range(LENGTH):
            known = label(k).ravel() if k < 3 else np.full(2 * CHUNK, np.nan)
            if half_known and k == 4:
                known[0] = 1.0
            episode.add({"front": image(0.0)}, np.zeros(1), np.array([k, -k]), more={LABELS: known})
        episode.save()
    writer.finish()
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("labels") / "data")


def test_chunks_are_the_labels_where_there_are_any_and_the_next_actions_elsewhere(data):
    cfg = replace(TINY, data=cw.FlowDataCfg(validation=0))
    training = FlowTraining(read_dataset(open_dataset(data), cfg.data), cfg)
    found = training._chunks(torch.tensor([0, 2, 3, LENGTH + 1, 2 * LENGTH - 1])).numpy()
    assert found.shape == (5, 4, 2)  # as long as the policy's chunks
    np.testing.assert_array_equal(found[0], label(0)[:4])
    np.testing.assert_array_equal(found[1], label(2)[:4])
    np.testing.assert_array_equal(found[2][:, 0], [3, 4, 5, 5])
    np.testing.assert_array_equal(found[3], label(1)[:4])
    np.testing.assert_array_equal(found[4][:, 0], [5, 5, 5, 5])


def test_labels_are_left_aside_on_request(data):
    cfg = replace(TINY, data=cw.FlowDataCfg(validation=0, labels=False))
    found = read_dataset(open_dataset(data), cfg.data)
    assert found.labels is None
    chunk = FlowTraining(found, cfg)._chunks(torch.tensor([1])).numpy()
    np.testing.assert_array_equal(chunk[0, :, 0], [1, 2, 3, 4])


def test_labels_that_do_not_fit_are_refused_in_one_sentence(data, tmp_path):
    def said(folder: Path, cfg: cw.FlowDataCfg) -> str:
        with pytest.raises(cw.TrainError) as error:
            read_dataset(open_dataset(folder), cfg)
        return str(error.value)

    assert "frame 4: teacher_chunk is not finite in part" in said(
        write(tmp_path / "half", half_known=True), cw.FlowDataCfg()
    )
    assert "teacher_chunk labels other actions" in said(data, cw.FlowDataCfg(action=("observation.state",)))
    other = write(tmp_path / "other")
    info = json.loads((other / "meta" / "info.json").read_text())
    info["features"][LABELS]["names"] = [f"{k}" for k in range(2 * CHUNK)]
    (other / "meta" / "info.json").write_text(json.dumps(info))
    assert "teacher_chunk is of other actions" in said(other, cw.FlowDataCfg())
    cfg = replace(TINY, policy=replace(TINY.policy, chunk=CHUNK + 1))
    with pytest.raises(cw.TrainError, match="shorter than the policy's chunks; expected at least 6 commands, found 5"):
        FlowTraining(read_dataset(open_dataset(data), cfg.data), cfg)
