"""Folders of colour and depth images in the layouts of RealSense, Orbbec and Open3D."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_logs import EPOCH, INTRINSICS, SCENE, camera_pose, motion, write_calibration, write_images

import concent_warp as cw
from concent_warp.recording.logs.readers.image_folder import ImageFolder

MAP = f"""
[action."*"]
source = "command/*"
[measured."*_position"]
source = "joints/*"
[image.front]
color = "color"
depth = "depth"
pose = {camera_pose().tolist()}
"""


@pytest.fixture
def place(tmp_path):
    write_images(tmp_path / "log", motion())
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "robot.toml").write_text(MAP)
    return tmp_path


def import_from(place):
    return cw.import_log(place / "log", place / "robot.xml", mapping=place / "robot.toml")[0]


def test_a_folder_is_read_back_identical(place):
    made, found = motion(), import_from(place)
    np.testing.assert_allclose(found.measured["elbow_position"].time, made.time, atol=1e-6)
    np.testing.assert_array_equal(found.measured["elbow_position"].value[:, 0], made.elbow)
    np.testing.assert_array_equal(found.action["grip"].value, made.grip)
    stream = found.image["front"]
    np.testing.assert_allclose(stream.time, made.frames, atol=1e-6)
    np.testing.assert_array_equal(stream.rgb, made.rgb)
    np.testing.assert_array_equal(stream.depth, made.depth.astype(np.float32) * np.float32(1e-3))
    np.testing.assert_array_equal(stream.intrinsics, INTRINSICS)


@pytest.mark.parametrize(
    "document",
    [
        {"fx": 40, "fy": 40, "ppx": 23.5, "ppy": 15.5, "model": "distortion.inverse_brown_conrady", "coeffs": [0] * 5},
        {"color": {"fx": 40, "fy": 40, "cx": 23.5, "cy": 15.5}, "depth": {"fx": 1, "fy": 1, "cx": 1, "cy": 1}},
        {"intrinsic_matrix": [40, 0, 0, 0, 40, 0, 23.5, 15.5, 1], "depth_scale": 1000},
        {"rgb_intrinsic": {"fx": 40, "fy": 40, "cx": 23.5, "cy": 15.5}, "distortion": {"k1": 0, "p1": 0}},
        {"K": INTRINSICS.tolist(), "depth_scale": 0.001},
    ],
    ids=["realsense", "orbbec", "open3d", "orbbec nested", "matrix"],
)
def test_intrinsics_of_several_makers(place, document):
    (place / "log" / "intrinsics.json").write_text(json.dumps(document))
    stream = import_from(place).image["front"]
    np.testing.assert_allclose(stream.intrinsics, INTRINSICS)
    np.testing.assert_allclose(stream.depth, motion().depth / 1000, atol=1e-6)


def test_distortion_that_orbbec_names_is_in_opencvs_order(place):
    document = {"fx": 40, "fy": 40, "cx": 23.5, "cy": 15.5, "distortion": {"k1": 1, "k2": 2, "k3": 3, "p1": 4, "p2": 5}}
    (place / "log" / "intrinsics.json").write_text(json.dumps(document))
    camera = ImageFolder(place / "log").episode(0).calibration["camera"]
    assert camera.distortion.tolist() == [1, 2, 4, 5, 3]


def test_times_may_be_in_a_table(place):
    made = motion()
    rows = []
    for name in ("color", "depth"):
        for k, path in enumerate(sorted((place / "log" / name).iterdir())):
            path.rename(path.with_name(f"{k:06d}.png"))
            if name == "color":
                rows.append(f"{k:06d}.png,{EPOCH + made.frames[k]:.6f}")
    (place / "log" / "timestamps.csv").write_text("\n".join(["file,time", *rows]))
    np.testing.assert_allclose(import_from(place).image["front"].time, made.frames, atol=1e-6)


def test_numbers_of_frames_become_times_by_a_rate(place):
    for name in ("color", "depth"):
        for k, path in enumerate(sorted((place / "log" / name).iterdir())):
            path.rename(path.with_name(f"{k:06d}.png"))
    with pytest.raises(cw.RecordingError, match="the stamps look like numbers of frames"):
        import_from(place)
    clock = f'[clock]\n"*o*" = {{ offset = {-EPOCH} }}\n"color" = {{ rate = 4 }}\n"depth" = {{ rate = 4 }}\n'
    (place / "robot.toml").write_text(clock + MAP)
    np.testing.assert_allclose(import_from(place).image["front"].time, motion().frames, atol=1e-6)


def test_poses_may_be_in_a_calibration_file(place):
    write_calibration(place / "log" / "calibration.json", "front")
    (place / "robot.toml").write_text("\n".join(line for line in MAP.splitlines() if not line.startswith("pose")))
    np.testing.assert_array_equal(import_from(place).image["front"].pose, camera_pose())


def test_depths_in_other_units_are_converted(place):
    made = motion()
    import cv2

    for path, frame in zip(sorted((place / "log" / "depth").iterdir()), made.depth, strict=True):
        cv2.imwrite(str(path), frame * 10)
    (place / "robot.toml").write_text(MAP + 'depth_unit = "100um"\n')
    np.testing.assert_allclose(import_from(place).image["front"].depth, made.depth / 1000, atol=1e-6)
