"""Data sets that a flow policy learns from: their features, their images, and what is wrong with others."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

import concent_warp as cw
from concent_warp.cli.entry import main
from concent_warp.train.flow import frames as frame_files
from concent_warp.train.flow.dataset import read_dataset
from concent_warp.train.flow.frames import FRAMES, NOTE, decode_episodes
from concent_warp.train.flow.network import prepared
from concent_warp.train.flow.sources import open_dataset
from tests.train.flow_dataset import DOWN, LENGTH, TINY, UP, image, write_dataset

QUICK = [
    "--device", "cpu", "--steps", "2", "--batch", "2", "--policy.size", "16", "--policy.width", "16",
    "--policy.layers", "1", "--policy.heads", "2", "--policy.chunk", "4", "--policy.execute", "2",
]  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("flow") / "data", episodes=5, cameras=("front", "side"))


@pytest.fixture
def copy(data, tmp_path) -> Path:
    return Path(shutil.copytree(data, tmp_path / "copy"))


def test_numbers_and_texts_are_those_of_the_episodes(data):
    found = read_dataset(open_dataset(data), cw.FlowDataCfg())
    assert found.features.cameras == ("front", "side")
    assert found.images == ("observation.images.front", "observation.images.side")
    assert found.features.action == ("goal", "side", "lift")
    assert found.start.tolist() == [LENGTH * k for k in range(6)]
    assert found.action[:, 1].tolist() == [1.0 - 2.0 * (k % 2) for k in range(5) for _ in range(LENGTH)]
    texts = [found.features.tasks[k] for k in found.task[::LENGTH]]
    assert texts == [DOWN, DOWN, UP, UP, DOWN]
    assert found.last()[: LENGTH + 1].tolist() == [LENGTH - 1] * LENGTH + [2 * LENGTH - 1]


def test_validation_takes_whole_episodes(data):
    found = read_dataset(open_dataset(data), cw.FlowDataCfg())
    training, held = found.split(0.4, 0)
    assert len(held) == 2 * LENGTH
    assert not set(training // LENGTH) & set(held // LENGTH)
    assert sorted([*training, *held]) == list(range(5 * LENGTH))
    assert len(found.split(0.01, 0)[1]) == LENGTH  # at least one episode
    assert len(found.split(0.0, 0)[1]) == 0


def test_features_are_chosen_by_name(data):
    cfg = cw.FlowDataCfg(cameras=("side",), state=("action",), action=("observation.state", "action"))
    found = read_dataset(open_dataset(data), cfg)
    assert found.features.cameras == ("side",)
    assert found.features.state == ("goal", "side", "lift")
    assert found.features.action == ("observation.state/slider", "action/goal", "action/side", "action/lift")


def test_images_are_decoded_resized_and_gone_on_with(data, tmp_path, monkeypatch):
    log = open_dataset(data)
    found = read_dataset(log, cw.FlowDataCfg())
    monkeypatch.setattr(frame_files, "NOTE_PERIOD", 0.0)
    monkeypatch.setattr(frame_files, "MAX_THREADS", 1)

    def stop(share):
        if share > 0.7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        decode_episodes(log, found.images, 8, found.lengths, tmp_path, progress=stop)
    assert json.loads((tmp_path / NOTE).read_text())["episodes"] == 2
    shares = []
    files = decode_episodes(log, found.images, 8, found.lengths, tmp_path, progress=shares.append)
    assert shares == pytest.approx([0.6, 0.8, 1.0])  # the first two were kept
    front, side = files.arrays()
    assert front.shape == (5 * LENGTH, 8, 8, 3)
    for number, frames in enumerate(zip(front, side, strict=True)):
        goal = -0.9 + 0.2 * (number // LENGTH // 4)
        expected = prepared(torch.from_numpy(image(goal)[None]), 8).numpy()[0].astype(int)
        for frame in frames:  # each video is encoded by itself: equal images may differ in their last bits
            assert np.abs(frame - expected).mean() < 6  # the codec blurs
    other = decode_episodes(log, found.images[:1], 16, found.lengths, tmp_path, progress=shares.append)
    assert len(shares) == 3 + 5  # other settings: from the beginning
    assert other.bytes == (tmp_path / FRAMES / "camera_0.uint8").stat().st_size


def test_data_set_of_concent_render_is_learned_by_the_command(tmp_path, capsys):
    recording = cw.load_policy("shape_sorter").run.recording
    cw.render(recording, tmp_path / "data", cw.RenderCfg(size=32))
    run = tmp_path / "run"
    assert main(["train-flow", str(tmp_path / "data"), "-o", str(run), *QUICK]) == 0
    said = capsys.readouterr().out
    assert "cameras base, wrist" in said
    assert "flow_policy.pt" in said
    policy = cw.load_flow_policy(run)
    info = json.loads((tmp_path / "data" / "meta" / "info.json").read_text())
    assert list(policy.features.state) == info["features"]["observation.state"]["names"]
    assert list(policy.features.action) == info["features"]["action"]["names"]
    assert policy.features.tasks == (recording[0].task,)
    seen = {name: np.zeros((1, 48, 64, 3), dtype=np.uint8) for name in ("base", "wrist")}
    chunk = policy.act(seen, np.zeros((1, len(policy.features.state))), recording[0].task)
    assert chunk.shape == (1, 4, len(policy.features.action))
    assert main(["train-flow", str(tmp_path / "data"), "-o", str(run), *QUICK]) == 2
    assert "holds a run" in capsys.readouterr().err
    assert main(["train-flow", str(tmp_path / "data"), "-o", str(run), *QUICK, "--resume"]) == 0
    assert "nothing is left to train" in capsys.readouterr().out
    assert main(["train-flow", str(tmp_path / "data"), "-o", str(run), *QUICK, "--overwrite"]) == 0


def test_images_in_tables_are_read(copy):
    import cv2

    shutil.rmtree(copy / "videos" / "observation.images.side")
    path = copy / "meta" / "info.json"
    info = json.loads(path.read_text())
    info["features"]["observation.images.side"]["dtype"] = "image"
    path.write_text(json.dumps(info))
    (table,) = (copy / "data").rglob("*.parquet")
    content = pq.read_table(table)
    png = cv2.imencode(".png", image(0.5))[1].tobytes()
    cells = pa.array([{"bytes": png, "path": None}] * content.num_rows)
    pq.write_table(content.append_column("observation.images.side", cells), table)
    cfg = replace(TINY, steps=1, batch=2)
    assert cw.train_flow(copy, cfg, device="cpu").features.cameras == ("front", "side")


def _described(folder: Path, **changed) -> None:
    """Change the description of a data set."""
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))


def test_what_cannot_be_learned_from_is_said_in_one_sentence(copy, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def said(*options: str, data: Path | str = copy) -> str:
        assert main(["train-flow", str(data), "-o", "run", *QUICK, *options]) == 2
        assert not Path("run").exists()
        return capsys.readouterr().err.strip().splitlines()[-1]

    assert "nowhere: no LeRobot data set; expected its folder, found no such folder" in said(data="nowhere")
    assert "no meta/info.json" in said(data=tmp_path)
    assert "no such feature of images" in said("--cameras", "top")
    assert "named twice" in said("--cameras", "front", "front")
    assert "no such feature of proprioception" in said("--data.state", "joints")
    assert "more actions are executed than predicted" in said("--policy.execute", "5")
    assert "a multiple of 4, twice the heads" in said("--policy.width", "18")
    assert "smaller than one token" in said("--policy.size", "8")
    assert "--steps is out of bounds" in said("--steps", "0")
    _described(copy, codebase_version="v2.1")
    assert "another version" in said()
    _described(copy, codebase_version="v3.0", features={})
    assert "no feature of images" in said()


def test_damaged_data_sets_are_said_in_one_sentence(data, tmp_path):
    def error(break_it) -> str:
        copy = shutil.copytree(data, tmp_path / "broken")
        break_it(copy)
        with pytest.raises(cw.ConcentError) as found:
            cw.train_flow(copy, replace(TINY, steps=1), device="cpu", out=tmp_path / "run")
        assert not (tmp_path / "run").exists()
        shutil.rmtree(copy)
        return str(found.value)

    def lose_video(folder: Path) -> None:
        next((folder / "videos").rglob("*.mp4")).unlink()

    def cut_video(folder: Path) -> None:
        next((folder / "videos").rglob("*.mp4")).write_bytes(b"nothing")

    def spoil_state(folder: Path) -> None:
        (path,) = (folder / "data").rglob("*.parquet")
        table = pq.read_table(path)
        values = np.stack(table["observation.state"].to_pylist())
        values[7] = np.nan
        k = table.column_names.index("observation.state")
        pq.write_table(table.set_column(k, "observation.state", pa.array(values.tolist())), path)

    assert "a video of the data set is missing" in error(lose_video)
    assert "a video cannot be decoded" in error(cut_video)
    assert "slider is not finite" in error(spoil_state)
    assert "no table of episodes" in error(lambda folder: shutil.rmtree(folder / "meta" / "episodes"))


def test_policies_are_not_read_from_other_files(data, tmp_path):
    with pytest.raises(cw.TrainError, match="no such flow policy"):
        cw.load_flow_policy(tmp_path)
    with pytest.raises(cw.TrainError, match="not a checkpoint"):
        cw.load_flow_policy(data / "meta" / "info.json")
    with pytest.raises(cw.TrainError, match="not a checkpoint of this kind"):
        cw.load_flow_policy(cw.load_policy("shape_sorter").folder / "checkpoint.pt")
