"""LeRobot data sets are read back as they were written; the real lerobot package is in benchmarks/import_logs."""

from __future__ import annotations

import json
from fractions import Fraction

import numpy as np
import pytest
from made_logs import SCENE, SIZE, camera_pose, motion, write_calibration, write_lerobot

import concent_warp as cw
from concent_warp.recording.logs.readers.lerobot import LeRobotLog
from concent_warp.recording.logs.readers.video import CODES, DepthCodes, read_frames

MAP = """
[action.elbow]
source = "action/elbow.pos"
unit = "deg"
[action.grip]
source = "action/grip.pos"
unit = "percent"
[measured.elbow_position]
source = "observation.state/elbow.pos"
unit = "deg"
noise_std = 0.001
[measured.grip_position]
source = "observation.state/grip.pos"
unit = "percent"
[image.front]
color = "observation.images.front"
"""


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lerobot")
    made = write_lerobot(folder / "data")
    write_calibration(folder / "data" / "calibration.json", "front")
    (folder / "robot.xml").write_text(SCENE)
    (folder / "robot.toml").write_text(MAP)
    return folder, made


def import_from(folder, **kwargs):
    return cw.import_log(folder / "data", folder / "robot.xml", cw.ImportCfg(**kwargs), mapping=folder / "robot.toml")


def test_episodes_of_one_file_are_read_back(data_set):
    folder, made = data_set
    recording = import_from(folder)
    assert [d.name for d in recording.demonstrations] == ["demo_0", "demo_1", "demo_2"]
    for number, (one, true) in enumerate(zip(recording.demonstrations, made, strict=True)):
        assert one.task == f"task {number % 2}"
        np.testing.assert_allclose(one.measured["elbow_position"].value[:, 0], true.elbow, atol=1e-6)
        np.testing.assert_allclose(one.measured["grip_position"].value[:, 0], true.grip, atol=1e-7)
        np.testing.assert_allclose(one.action["elbow"].value, true.elbow + np.deg2rad(1), atol=1e-6)
        np.testing.assert_allclose(one.measured["elbow_position"].time, true.time, atol=1e-5)
        assert one.measured["elbow_position"].noise_std == 0.001
        assert one.measured["grip_position"].noise_std is None
        grey = one.image["front"].rgb.mean(axis=(1, 2, 3))
        np.testing.assert_allclose(grey, 20 + 40 * number + np.arange(len(true.time)) // 2, atol=3)
        assert one.image["front"].rgb.shape[1:3] == SIZE
        assert not one.image["front"].depth.any()
        np.testing.assert_array_equal(one.image["front"].pose, camera_pose())


def test_some_episodes_can_be_chosen(data_set):
    recording = import_from(data_set[0], episodes=(2, 0))
    assert [d.name for d in recording.demonstrations] == ["demo_2", "demo_0"]
    assert recording["demo_2"].image["front"].rgb.shape[0] == 120


def write_depths(path, codes, rate=20):
    """Write a video of codes as lerobot 0.6 does: HEVC without loss, 12 bits of grey."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=rate, options={"x265-params": "lossless=1:log-level=none"})
        stream.height, stream.width = codes.shape[1:]
        stream.pix_fmt = "gray12le"
        for k, frame in enumerate(codes):
            image = av.VideoFrame(codes.shape[2], codes.shape[1], "gray12le")
            plane = image.planes[0]
            rows = np.zeros((plane.height, plane.line_size // 2), np.uint16)
            rows[:, : codes.shape[2]] = frame
            plane.update(rows.tobytes())
            image.pts, image.time_base = k, Fraction(1, rate)
            container.mux(stream.encode(image))
        container.mux(stream.encode(None))


def test_depths_are_decoded_as_lerobot_codes_them(tmp_path):
    rng = np.random.default_rng(0)
    metres = rng.uniform(0.1, 4, (6, 64, 96)).astype(np.float32)
    metres[:, :4] = 0
    # quantize_depth of lerobot 0.6: log(depth + 3.5) between its values at 0.01 m and 10 m, rounded to 12 bits.
    low, high = np.log(3.51), np.log(13.5)
    codes = np.rint((np.log(metres + 3.5) - low) / (high - low) * CODES).clip(0, CODES).astype(np.uint16)
    write_depths(tmp_path / "depth.mp4", codes)
    times = np.array([1, 2, 5]) / 20
    found = np.stack(list(read_frames(tmp_path / "depth.mp4", times, rate=20, depth=DepthCodes())))
    true = metres[[1, 2, 5]]
    step = (true + 3.5) * (high - low) / CODES
    assert (np.abs(found - true) <= 0.51 * step)[true > 0].all()
    assert not found[true == 0].any()


def test_codes_of_depths_follow_the_description():
    linear = DepthCodes.of({"video.depth_min": 0.1, "video.depth_max": 2.0, "video.use_log": False}, "here")
    np.testing.assert_allclose(linear.metres(np.array([1, 2048])), 0.1 + np.array([1, 2048]) / CODES * 1.9, rtol=1e-6)
    assert DepthCodes.of({}, "here") == DepthCodes(0.01, 10.0, 3.5, True)
    with pytest.raises(cw.RecordingError, match="codes of the depths make no sense"):
        DepthCodes.of({"video.depth_min": 2.0, "video.depth_max": 1.0}, "here")


def test_depths_in_a_data_set_make_an_rgbd_stream(tmp_path):
    true = motion()
    write_lerobot(tmp_path / "data", 1)
    path = tmp_path / "data" / "videos" / "observation.images.front_depth" / "chunk-000" / "file-000.mp4"
    path.parent.mkdir(parents=True)
    metres = np.repeat(true.depth[:1] / np.float32(1000), 100, axis=0)
    low, high = np.log(3.51), np.log(13.5)
    write_depths(
        path, np.rint((np.log(metres + 3.5) - low) / (high - low) * CODES).clip(0, CODES).astype(np.uint16), 50
    )
    info = json.loads((tmp_path / "data" / "meta" / "info.json").read_text())
    names = ["height", "width", "channels"]
    info["features"]["observation.images.front_depth"] = {
        "dtype": "video", "shape": [*SIZE, 1], "names": names, "info": {"is_depth_map": True}
    }  # fmt: skip
    (tmp_path / "data" / "meta" / "info.json").write_text(json.dumps(info))
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = next((tmp_path / "data" / "meta" / "episodes").glob("*/*.parquet"))
    rows = pq.read_table(table)
    for name in [n for n in rows.column_names if n.startswith("videos/observation.images.front/")]:
        rows = rows.append_column(name.replace("front/", "front_depth/"), rows[name])
    pq.write_table(pa.table(rows), table)
    write_calibration(tmp_path / "data" / "calibration.json", "front")
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "robot.toml").write_text(MAP + 'depth = "observation.images.front_depth"\n')
    found = import_from(tmp_path)[0].image["front"].depth
    np.testing.assert_allclose(found, metres, atol=2e-3)
    assert (found[metres == 0] == 0).all()


def test_names_that_converters_nest_are_found(data_set, tmp_path):
    import shutil

    shutil.copytree(data_set[0] / "data", tmp_path / "data")
    path = tmp_path / "data" / "meta" / "info.json"
    info = json.loads(path.read_text())
    info["features"]["action"]["names"] = {"motors": ["a", "b"]}
    info["features"]["observation.state"]["names"] = None
    path.write_text(json.dumps(info))
    signals = LeRobotLog(tmp_path / "data").episode(0).signals
    assert sorted(signals) == ["action/a", "action/b", "observation.state/0", "observation.state/1"]
    assert signals["action/a"].command
    assert not signals["observation.state/0"].command
