import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from small_dataset import LAYOUT, frame, length, read_frames, write

from concent_warp.errors import RenderError
from concent_warp.render.dataset.layout import EpisodeLayout
from concent_warp.render.dataset.lerobot import LeRobotWriter
from concent_warp.render.dataset.robomimic import RobomimicWriter
from concent_warp.render.dataset.statistics import ImageHistogram, merged_statistics, statistics_of_values
from concent_warp.render.dataset.video import VideoWriter
from tests.forks import Forks


def episodes(folder: Path) -> list[dict]:
    files = sorted((folder / "meta" / "episodes").rglob("*.parquet"))
    return [row for path in files for row in pq.read_table(path).to_pylist()]


def check(folder: Path, keys: list[int]) -> None:
    """Check that a data set holds the episodes of `small_dataset` with these numbers, in whatever order."""
    info = json.loads((folder / "meta" / "info.json").read_text())
    rows = episodes(folder)
    assert sorted(row["source_index"] for row in rows) == sorted(keys)
    assert [row["episode_index"] for row in rows] == list(range(len(rows)))
    assert info["total_episodes"] == len(keys)
    assert info["total_frames"] == sum(map(length, keys))
    tasks = pq.read_table(folder / "meta" / "tasks.parquet").to_pydict()
    first = 0
    for row in rows:
        key = row["source_index"]
        where = {name: row[f"data/{name}"] for name in ("chunk_index", "file_index")}
        table = pq.read_table(folder / info["data_path"].format(**where)).to_pydict()
        mine = [i for i, e in enumerate(table["episode_index"]) if e == row["episode_index"]]
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (first, first + length(key))
        assert [table["index"][i] for i in mine] == list(range(first, first + length(key)))
        assert [table["observation.state"][i] for i in mine] == [[key, t] for t in range(length(key))]
        assert [table["frame_index"][i] for i in mine] == list(range(length(key)))
        assert np.allclose([table["timestamp"][i] for i in mine], np.arange(length(key)) / 10)
        assert row["tasks"] == [f"task {key % 2}"] == [tasks["task"][table["task_index"][mine[0]]]]
        for camera in LAYOUT.cameras:
            prefix = f"videos/observation.images.{camera}"
            place = {name: row[f"{prefix}/{name}"] for name in ("chunk_index", "file_index")}
            video = read_frames(folder / info["video_path"].format(video_key=f"observation.images.{camera}", **place))
            start = round(row[f"{prefix}/from_timestamp"] * 10)
            assert round(row[f"{prefix}/to_timestamp"] * 10) == start + length(key)
            for t in range(length(key)):
                assert abs(video[start + t].astype(float) - frame(key, t)[0][camera]).max() < 4
        first += length(key)


def test_lerobot_files_are_as_the_format_has_them(tmp_path):
    writer = LeRobotWriter(tmp_path, LAYOUT)
    write(writer, range(4))
    assert writer.finish() == 4
    check(tmp_path, [0, 1, 2, 3])
    info = json.loads((tmp_path / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == 10
    assert info["features"]["action"] == {"dtype": "float32", "shape": [3], "names": ["x", "y", "z"]}
    assert info["features"]["observation.images.wrist"]["shape"] == [32, 48, 3]
    stats = json.loads((tmp_path / "meta" / "stats.json").read_text())
    states = np.array([frame(key, t)[1] for key in range(4) for t in range(length(key))])
    assert np.allclose(stats["observation.state"]["mean"], states.mean(0))
    assert np.allclose(stats["observation.state"]["std"], states.std(0))
    assert np.shape(stats["observation.images.base"]["mean"]) == (3, 1, 1)
    assert stats["observation.images.base"]["max"][0][0][0] == pytest.approx((20 + 60 + 40) / 255)


def test_lerobot_reads_every_frame(tmp_path):
    reason = (
        "lerobot is not installed: it wants older versions; benchmarks/render/dataset_lerobot.py uses one elsewhere"
    )
    module: Any = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason=reason)
    writer = LeRobotWriter(tmp_path, LAYOUT)
    write(writer, range(3))
    writer.finish()
    data = module.LeRobotDataset("local/small", root=tmp_path, video_backend="pyav")
    assert len(data) == sum(map(length, range(3)))
    assert data[5]["observation.state"].tolist() == [1.0, 2.0]
    assert tuple(data[5]["observation.images.base"].shape) == (3, *LAYOUT.size)


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks("concent_warp.render.dataset.lerobot") as found:
        yield found


@pytest.mark.parametrize("last", [1, 3, 4, 5, 6, 8, 11])
def test_killed_and_gone_on_with_loses_no_episode(tmp_path, forks, last):
    done = forks.run(Path(__file__).with_name("small_dataset.py").read_text(), str(tmp_path), str(last))
    assert done.returncode == 9
    staged = [int(path.name) for path in (tmp_path / ".staging").iterdir() if path.name.isdigit()]
    saved = set(staged) | {row["source_index"] for row in episodes(tmp_path)}
    writer = LeRobotWriter(tmp_path, LAYOUT, video_mb=0.004)
    assert {key for key in range(5) if writer.has(key)} == saved
    write(writer, range(5))
    assert writer.finish() == 5
    check(tmp_path, list(range(5)))


def test_dropped_episode_is_not_rendered_again(tmp_path):
    for Writer in (LeRobotWriter, RobomimicWriter):
        folder = tmp_path / Writer.__name__
        writer = Writer(folder, LAYOUT)
        write(writer, [0])
        episode = writer.begin(1, "task")
        episode.add(*frame(1, 0))
        episode.drop()
        left = writer.begin(2, "task")
        left.add(*frame(2, 0))
        left.discard()
        again = Writer(folder, LAYOUT)
        assert [again.has(key) for key in range(3)] == [True, True, False]
        assert again.finish() == 1


def test_data_set_grows_after_it_was_finished(tmp_path):
    for Writer in (LeRobotWriter, RobomimicWriter):
        folder = tmp_path / Writer.__name__
        writer = Writer(folder, LAYOUT)
        write(writer, [0, 1])
        assert writer.finish() == 2
        writer = Writer(folder, LAYOUT)
        write(writer, range(4))
        assert writer.finish() == 4
    check(tmp_path / "LeRobotWriter", [0, 1, 2, 3])


def test_robomimic_file_has_every_frame_exactly(tmp_path):
    writer = RobomimicWriter(tmp_path, LAYOUT)
    write(writer, range(3))
    writer.finish()
    with h5py.File(tmp_path / "dataset.hdf5") as file:
        data: Any = file["data"]
        assert data.attrs["total"] == sum(map(length, range(3)))
        assert json.loads(data.attrs["env_args"])["env_kwargs"]["rate"] == 10
        for key in range(3):
            demo = data[f"demo_{key}"]
            assert demo.attrs["num_samples"] == length(key)
            for t in range(length(key)):
                images, state, action = frame(key, t)
                assert np.array_equal(demo["obs/wrist_image"][t], images["wrist"])
                assert np.array_equal(demo["obs/state"][t], state)
                assert np.array_equal(demo["actions"][t], action)
            assert demo["dones"][:].tolist() == [0] * (length(key) - 1) + [1]


def test_robomimic_rewards_no_failure(tmp_path):
    writer = RobomimicWriter(tmp_path, LAYOUT)
    for key, success in enumerate((True, False)):
        episode = writer.begin(key, "task")
        for t in range(2):
            episode.add(*frame(key, t))
        episode.save(success=success)
    writer.finish()
    with h5py.File(tmp_path / "dataset.hdf5") as file:
        data: Any = file["data"]
        assert [data[f"demo_{k}"]["rewards"][:].tolist() for k in (0, 1)] == [[0, 1], [0, 0]]
        assert [data[f"demo_{k}"]["dones"][:].tolist() for k in (0, 1)] == [[0, 1], [0, 1]]


@pytest.mark.parametrize("count", [0, 2])
def test_video_without_a_reader_is_closed_without_an_error(tmp_path, count):
    video = VideoWriter(tmp_path / "film.mp4", 10, LAYOUT.size)
    for t in range(count):
        video.add(frame(0, t)[0]["base"])
    video.abandon()
    again = VideoWriter(tmp_path / "film.mp4", 10, LAYOUT.size)  # its place is free
    again.add(frame(0, 0)[0]["base"])
    again.close()
    assert (tmp_path / "film.mp4").stat().st_size > 0


def test_other_settings_are_refused(tmp_path):
    write(LeRobotWriter(tmp_path, LAYOUT), [0])
    other = EpisodeLayout(20, LAYOUT.cameras, LAYOUT.size, LAYOUT.state, LAYOUT.action)
    with pytest.raises(RenderError, match=r"other settings.*rate"):
        LeRobotWriter(tmp_path, other)


def test_frame_that_does_not_fit_is_refused(tmp_path):
    episode = LeRobotWriter(tmp_path, LAYOUT).begin(0, "task")
    images, state, action = frame(0, 0)
    with pytest.raises(RenderError, match="other cameras"):
        episode.add({"base": images["base"]}, state, action)
    with pytest.raises(RenderError, match=r"state is not right.*2 finite"):
        episode.add(images, np.array([np.nan, 0]), action)
    with pytest.raises(RenderError, match="even"):
        EpisodeLayout(10, ("base",), (31, 48), ("a",), ("x",))


def test_statistics_of_parts_make_those_of_the_whole():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(50, 3))
    whole, parts = (
        statistics_of_values(values),
        merged_statistics([statistics_of_values(values[:20]), statistics_of_values(values[20:])]),
    )
    for name in ("min", "max", "mean", "std", "count"):
        assert np.allclose(whole[name], parts[name]), name
    images = rng.integers(0, 256, (5, 16, 16, 3), dtype=np.uint8)
    histogram = ImageHistogram(every=1)
    for image in images:
        histogram.add(image)
    flat = images.reshape(-1, 3) / 255
    found = histogram.statistics()
    assert np.allclose(found["mean"][:, 0, 0], flat.mean(0))
    assert np.allclose(found["std"][:, 0, 0], flat.std(0))
    assert np.allclose(found["q90"][:, 0, 0], np.quantile(flat, 0.9, axis=0), atol=2 / 255)
