"""Bags and MCAP files of ROS, written by rosbags and mcap, are read back identical."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from made_logs import (
    EPOCH,
    INTRINSICS,
    ROS_MAP,
    SCENE,
    SIZE,
    camera_pose,
    messages,
    motion,
    write_bag,
)

import concent_warp as cw


@pytest.fixture(scope="module")
def made():
    return motion()


def write_map(folder, text=ROS_MAP):
    (folder / "robot.xml").write_text(SCENE)
    (folder / "robot.toml").write_text(text)
    return {"model": folder / "robot.xml", "mapping": folder / "robot.toml"}


def check(demonstration, made):
    measured = demonstration.measured
    np.testing.assert_allclose(measured["elbow_position"].time, made.time, atol=1e-6)
    np.testing.assert_array_equal(measured["elbow_position"].value[:, 0], made.elbow)
    np.testing.assert_array_equal(measured["elbow_velocity"].value[:, 0], made.speed)
    np.testing.assert_array_equal(measured["grip_position"].value[:, 0], made.grip)
    np.testing.assert_array_equal(measured["block_position"].value, made.block)
    np.testing.assert_array_equal(measured["block_orientation"].value, np.tile([1.0, 0, 0, 0], (len(made.time), 1)))
    # Float64MultiArray has no header: its times are those of reception, 4 ms later.
    np.testing.assert_allclose(demonstration.action["elbow"].time, made.time[::2] + 0.004, atol=1e-6)
    np.testing.assert_array_equal(demonstration.action["elbow"].value, made.elbow[::2])
    np.testing.assert_array_equal(demonstration.action["grip"].value, made.grip[::2])
    stream = demonstration.image["front"]
    np.testing.assert_allclose(stream.time, made.frames, atol=1e-6)
    np.testing.assert_array_equal(stream.rgb, made.rgb)
    np.testing.assert_array_equal(stream.depth, made.depth.astype(np.float32) * np.float32(1e-3))
    np.testing.assert_array_equal(stream.intrinsics, INTRINSICS)
    np.testing.assert_allclose(stream.pose, camera_pose(), atol=1e-12)


@pytest.mark.parametrize("kind", ["mcap", "sqlite", "ros1"])
def test_bags_of_rosbags_are_read_back_identical(tmp_path, made, kind):
    bag = write_bag(tmp_path / "bag", messages(made), kind)
    recording = cw.import_log(bag, **write_map(tmp_path), out=tmp_path / "demo.h5")
    check(recording[0], made)
    check(cw.load_recording(tmp_path / "demo.h5")[0], made)


def test_an_mcap_file_alone_is_a_log(tmp_path, made):
    bag = write_bag(tmp_path / "bag", messages(made), "mcap")
    check(cw.import_log(next(bag.glob("*.mcap")), **write_map(tmp_path))[0], made)


def test_mcap_of_its_own_writer_is_read_back_identical(tmp_path, made):
    from mcap_ros2.writer import Writer

    header = "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    rule = "=" * 80
    definitions = f"{header}{rule}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    definitions += f"{rule}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    path = tmp_path / "joints.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", definitions)
        for topic in ("/joint_states", "/leader/command"):
            for time, elbow, grip in zip(made.time, made.elbow, made.grip, strict=True):
                at = round((EPOCH + time) * 1e9)
                stamp = {"sec": at // 10**9, "nanosec": at % 10**9}
                message = {
                    "header": {"stamp": stamp, "frame_id": ""}, "name": ["elbow", "grip"], "position": [elbow, grip],
                    "velocity": [], "effort": [],
                }  # fmt: skip
                writer.write_message(topic, schema, message, log_time=at + 10**6, publish_time=at)
        writer.finish()
    mapping = """
    [action."*"]
    source = "/leader/command/position/*"
    [measured."*_position"]
    source = "/joint_states/position/*"
    """
    found = cw.import_log(path, **write_map(tmp_path, mapping))[0]
    np.testing.assert_array_equal(found.measured["elbow_position"].value[:, 0], made.elbow)
    np.testing.assert_array_equal(found.action["grip"].value, made.grip)
    np.testing.assert_allclose(found.action["grip"].time, made.time, atol=1e-6)


def test_trajectories_replace_what_is_left_of_those_before():
    from types import SimpleNamespace as Of

    from concent_warp.recording.logs.readers.ros import _Contents

    def message(start, *points):
        stamp = Of(sec=start, nanosec=0)
        listed = [
            Of(positions=[value], velocities=[], time_from_start=Of(sec=after, nanosec=0)) for after, value in points
        ]
        return Of(header=Of(stamp=stamp), joint_names=["elbow"], points=listed)

    found = _Contents()
    found.add("/goal", "JointTrajectory", message(10, (1, 0.1), (2, 0.2), (9, 0.9)), 10.0)
    found.add("/goal", "JointTrajectory", message(11, (1, 0.5)), 11.0)
    signal = found.episode(0, Path("log")).signals["/goal/position/elbow"]
    assert signal.command
    assert signal.time.tolist() == [11, 12]
    assert signal.value.tolist() == [0.1, 0.5]


def test_compressed_images_are_decoded(made):
    from types import SimpleNamespace as Of

    import cv2

    from concent_warp.recording.logs.readers.ros_messages import decoded, is_depth

    png = cv2.imencode(".png", made.rgb[0][..., ::-1])[1].ravel()
    color = Of(format="rgb8; png compressed bgr8", data=png)
    assert not is_depth("CompressedImage", color)
    np.testing.assert_array_equal(decoded("CompressedImage", color), made.rgb[0])
    coded = cv2.imencode(".png", made.depth[0])[1].ravel()
    depth = Of(format="16UC1; compressedDepth png", data=np.concatenate([np.zeros(12, np.uint8), coded]))
    assert is_depth("CompressedImage", depth)
    np.testing.assert_array_equal(decoded("CompressedImage", depth), made.depth[0])
    # compressed_depth_image_transport codes floats as a / depth + b.
    metres = made.depth[0].astype(np.float32) / 1000
    a, b = np.float32(1000), np.float32(1 - 1000 / 10)
    codes = np.where(metres > 0, np.rint(a / np.maximum(metres, 1e-3) + b), 0).astype(np.uint16)
    head = np.frombuffer(np.array([0, a, b], np.float32).tobytes(), np.uint8)
    coded = cv2.imencode(".png", codes)[1].ravel()
    found = decoded("CompressedImage", Of(format="32FC1; compressedDepth png", data=np.concatenate([head, coded])))
    seen = metres > 0
    np.testing.assert_allclose(found[seen], metres[seen], rtol=2e-3)
    assert not found[~seen].any()


def test_camera_on_a_body_has_its_pose_in_the_frame_of_the_body(tmp_path, made):
    sent = messages(made)
    hand = np.eye(4)
    hand[:3, 3] = [0, 0, 0.1]
    for k, (topic, kind, time, _) in enumerate(sent):
        if topic == "/tf_static":
            sent[k] = topic, kind, time, {"transforms": [("hand", "camera_optical", hand)]}
    text = ROS_MAP.replace('reference = "world"', 'reference = "hand"\nbody = "finger"')
    found = cw.import_log(write_bag(tmp_path / "bag", sent, "mcap"), **write_map(tmp_path, text))[0].image["front"]
    assert found.body == "finger"
    np.testing.assert_allclose(found.pose, hand, atol=1e-12)


def test_lens_distortion_is_taken_out(tmp_path, made):
    import cv2

    lens = np.array([-0.2, 0.05, 0.001, -0.001, 0.0])
    sent = [
        (topic, kind, time, fields | {"d": lens} if kind.endswith("CameraInfo") else fields)
        for topic, kind, time, fields in messages(made)
    ]
    found = cw.import_log(write_bag(tmp_path / "bag", sent, "mcap"), **write_map(tmp_path))[0].image["front"]
    expected = cv2.undistort(np.ascontiguousarray(made.rgb[0]), INTRINSICS, lens)
    assert np.abs(found.rgb[0].astype(int) - expected).max() <= 1
    assert not np.array_equal(found.rgb[0], made.rgb[0])
    # Depths are taken from the nearest pixel, never mixed over an edge.
    assert set(np.unique(found.depth)) <= {0, *np.unique(made.depth.astype(np.float32) * np.float32(1e-3))}
    assert found.rgb.shape[1:3] == SIZE


def test_without_rosbags_the_sentence_names_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.mcap").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(cw.RecordingError, match=r"need the package rosbags; pip install 'concent-warp\[logs\]'"):
        cw.import_log(tmp_path / "a.mcap", **write_map(tmp_path))
