"""What is wrong with a log, its map or its calibration is refused in one clear sentence."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_logs import (
    ROS_MAP,
    SCENE,
    SIZE,
    camera_pose,
    messages,
    motion,
    write_bag,
    write_calibration,
    write_images,
    write_lerobot,
)
from test_import_images import MAP as IMAGES_MAP
from test_import_lerobot import MAP as LEROBOT_MAP

import concent_warp as cw


def refused(place: Path, source: str, text: str, scene: str = SCENE, **cfg) -> str:
    """Return the sentence with which an import is refused."""
    (place / "robot.xml").write_text(scene)
    (place / "robot.toml").write_text(text)
    (place / "demo.h5").unlink(missing_ok=True)
    with pytest.raises(cw.ConcentError) as caught:
        cw.import_log(
            place / source,
            place / "robot.xml",
            cw.ImportCfg(**cfg),
            mapping=place / "robot.toml",
            out=place / "demo.h5",
        )
    assert not (place / "demo.h5").exists()
    sentence = str(caught.value)
    assert "\n" not in sentence
    return sentence


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory):
    place = tmp_path_factory.mktemp("lerobot")
    write_lerobot(place / "data", 1)
    write_calibration(place / "data" / "calibration.json", "front")
    return place


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    place = tmp_path_factory.mktemp("bag")
    write_bag(place / "bag", messages(motion()), "mcap")
    return place


@pytest.fixture
def images(tmp_path):
    write_images(tmp_path / "log", motion())
    return tmp_path


SMALL = SCENE.replace('range="-170 170"', 'range="-60 60"')
UNLIMITED = SCENE.replace('axis="0 1 0" range="-170 170"', 'axis="0 1 0"')
LEROBOT_CASES = {
    "degrees for radians": (("unit", "", 'unit = "deg"\n', ""), "its values look like degrees; expected -2.97 to 2.97"),
    "unknown channel": (("elbow.pos", "elbow"), "the log has no such channel; expected one of ['action/elbow.pos'"),
    "unknown actuator": (("[action.elbow]", "[action.shoulder]"), "the scene has no such actuator; expected one of"),
    "unit of another kind": (('"deg"', '"mm"'), "'elbow' has no unit mm; expected a unit of angle"),
    "unknown unit": (('"deg"', '"degrees"'), "unknown unit; expected one of rad, deg"),
    "unknown setting": (("noise_std", "noise"), "unknown settings; expected some of source"),
    "negative noise": (("0.001", "-0.001"), "noise_std is not right; expected a number above 0"),
    "no TOML": (("[action.elbow]", "[action.elbow"), "not a TOML file"),
    "no such images": (("images.front", "images.wrist"), "the log has no such colours; expected one of"),
    "wildcard without counterpart": (("[action.elbow]", '[action."*"]'), "a wildcard has no counterpart"),
}


@pytest.mark.parametrize("case", LEROBOT_CASES)
def test_a_wrong_map_is_refused(lerobot, case):
    (old, new, *more), sentence = LEROBOT_CASES[case]
    text = LEROBOT_MAP.replace(more[0], more[1]) if more else LEROBOT_MAP.replace(old, new)
    assert sentence in refused(lerobot, "data", text)


def test_speeds_tell_degrees_where_a_joint_has_no_range(lerobot):
    text = LEROBOT_MAP.replace('unit = "deg"\n', "")
    assert "its speeds look like degrees; expected at most 30 rad/s" in refused(lerobot, "data", text, UNLIMITED)


def test_degrees_beside_radians_of_one_joint_are_found(lerobot):
    text = LEROBOT_MAP.replace('unit = "deg"\nnoise', 'unit = "deg"\nscale = 0.0174533\nnoise')
    said = refused(lerobot, "data", text)
    assert "[action.elbow]: it moves as much as degrees beside radians" in said
    assert "57.3 times as much" in said


def test_a_wrong_sign_is_found(lerobot):
    text = LEROBOT_MAP.replace('unit = "deg"\nnoise', 'unit = "deg"\nsign = -1\nnoise')
    said = refused(lerobot, "data", text)
    assert "the joint moves against its command" in said
    assert "write sign = -1 for one of them" in said


def test_values_outside_of_the_range_are_found(lerobot):
    text = LEROBOT_MAP.replace('unit = "deg"\n', 'unit = "deg"\noffset = 1.57\n')
    assert "its values are outside the range of the joint; expected -1.05 to 1.05" in refused(
        lerobot, "data", text, SMALL
    )


def test_missing_commands_are_named(lerobot):
    text = LEROBOT_MAP.replace('[action.grip]\nsource = "action/grip.pos"\nunit = "percent"\n', "")
    said = refused(lerobot, "data", text)
    assert (
        "commands are missing; expected an [action.*] for every actuator of the scene, found none for ['grip']" in said
    )
    assert "constant = VALUE" in said


def test_a_constant_command_stands_for_one_that_is_not_logged(lerobot):
    text = LEROBOT_MAP.replace('source = "action/grip.pos"\nunit = "percent"', "constant = 0.03")
    (lerobot / "robot.xml").write_text(SCENE)
    (lerobot / "robot.toml").write_text(text)
    found = cw.import_log(lerobot / "data", lerobot / "robot.xml", mapping=lerobot / "robot.toml")[0].action["grip"]
    assert (found.time.tolist(), found.value.tolist()) == ([0], [0.03])


def test_missing_intrinsics_are_named(lerobot, tmp_path):
    write_calibration(tmp_path / "calibration.json", "wrist")
    said = refused(lerobot, "data", LEROBOT_MAP, calibration=str(tmp_path / "calibration.json"))
    assert "the intrinsics of the camera are missing; expected camera 'front' in calibration.json" in said


CALIBRATIONS = {
    "fisheye": ({"distortion": [0.1] * 4, "distortion_model": "equidistant"}, "fisheye lenses are not supported"),
    "unknown lens": ({"distortion": [0.1] * 4, "distortion_model": "poly3"}, "unknown model of the lens distortion"),
    "coefficients": ({"distortion": [0.1] * 3}, "wrong number of distortion coefficients; expected 4, 5 or 8"),
    "another size": ({"width": 1280, "height": 720}, "the intrinsics are of images of another size; expected 32 x 48"),
    "transposed intrinsics": (
        {"intrinsics": [[40, 0, 0], [0, 40, 0], [23.5, 15.5, 1]]},
        "the intrinsics are transposed",
    ),
    "text": ({"intrinsics": "a.yaml"}, "intrinsics is not right"),
    "unknown entry": ({"extrinsics": []}, "unknown entries; expected some of intrinsics"),
    "unknown body": ({"body": "hand"}, "the scene has no such body; expected one of ['arm', 'finger', 'block']"),
    "mirrored": ({"pose": (camera_pose() @ np.diag([-1, 1, 1, 1])).tolist()}, "the camera pose is mirrored"),
    "transposed": ({"pose": camera_pose().T.tolist()}, "the camera pose is transposed: its translation is in the last"),
    "no pose": ({"pose": None}, "the pose of the camera is not known"),
}


@pytest.mark.parametrize("case", CALIBRATIONS)
def test_a_wrong_calibration_is_refused(lerobot, tmp_path, case):
    more, sentence = CALIBRATIONS[case]
    write_calibration(tmp_path / "calibration.json", "front", **more)
    assert sentence in refused(lerobot, "data", LEROBOT_MAP, calibration=str(tmp_path / "calibration.json"))


def spoilt(place: Path, change) -> str:
    """Write the messages that a function makes of each message, and return what the import says."""
    sent = [one for message in messages(motion()) for one in change(*message)]
    write_bag(place / "bag", sorted(sent, key=lambda one: one[2]), "mcap")
    return refused(place, "bag", ROS_MAP)


POSES = {
    "inverted": (np.linalg.inv(camera_pose()), "the camera pose looks inverted (world-to-camera)"),
    "OpenGL": (camera_pose() @ np.diag([1.0, -1, -1, 1]), "the camera pose looks to have the axes of OpenGL"),
    "rotation by columns": (
        np.block([[camera_pose()[:3, :3].T, camera_pose()[:3, 3:]], [np.array([[0, 0, 0, 1.0]])]]),
        "the camera pose looks to have its rotation transposed",
    ),
}


@pytest.mark.parametrize("case", POSES)
def test_depths_tell_a_wrong_pose(bag, case):
    pose, sentence = POSES[case]
    text = ROS_MAP.replace('reference = "world"', f"pose = {pose.tolist()}")
    assert sentence in refused(bag, "bag", text)


@pytest.mark.parametrize("unit", ["m", "100um"])
def test_depths_tell_a_wrong_unit(bag, unit):
    said = refused(bag, "bag", f'{ROS_MAP}depth_unit = "{unit}"\n')
    assert f"[image.front]: the depths look like mm and not {unit}; expected about" in said
    assert "set depth_unit in the map" in said


def test_depths_that_are_all_missing_are_refused(bag):
    said = refused(bag, "bag", f'{ROS_MAP}depth_unit = "um"\n')
    assert "every depth is missing; expected depths above 0.05 m, found none in 5 frames, taken to be in um" in said


def test_stamps_of_two_clocks_are_found(tmp_path):
    def change(topic, kind, time, fields):
        if topic == "/joint_states":
            fields = fields | {"header": (fields["header"][0] - 1.2, "")}
        return [(topic, kind, time, fields)]

    said = spoilt(tmp_path, change)
    assert "the stamps are of two clocks that are not synchronised" in said
    assert 'use = "received"' in said


def test_clocks_that_do_not_overlap_are_found(tmp_path):
    def change(topic, kind, time, fields):
        if topic == "/joint_states":
            time, fields = time + 900, fields | {"header": (fields["header"][0] + 900, "")}
        return [(topic, kind, time, fields)]

    assert "its clock does not overlap with those of the other channels" in spoilt(tmp_path, change)


def test_clocks_that_stand_still_are_found(tmp_path):
    def change(topic, kind, time, fields):
        if topic == "/joint_states":
            fields = fields | {"header": (1.0, "")}
        return [(topic, kind, time, fields)]

    assert "149 of 150 stamps are repeated or missing" in spoilt(tmp_path, change)


def test_depths_of_another_size_are_refused(tmp_path):
    def change(topic, kind, time, fields):
        if "aligned" in topic:
            fields = fields | {"image": fields["image"][::2, ::2]}
        return [(topic, kind, time, fields)]

    said = spoilt(tmp_path, change)
    assert "the depths are not registered to the colours; expected the size of /camera/color/image_raw, 32 x 48" in said
    assert "aligned_depth_to_color" in said


def test_depths_of_other_times_are_refused(tmp_path):
    def change(topic, kind, time, fields):
        if "aligned" in topic:
            fields = fields | {"header": (fields["header"][0] + 0.12, "")}
        return [(topic, kind, time, fields)]

    assert "colours and depths are not of the same times" in spoilt(tmp_path, change)


def test_a_calibration_of_zeros_is_refused(tmp_path):
    def change(topic, kind, time, fields):
        return [(topic, kind, time, fields | {"k": np.zeros(9)} if kind.endswith("CameraInfo") else fields)]

    assert "the intrinsics are missing: all are 0" in spoilt(tmp_path, change)


def test_a_fisheye_or_unknown_pixels_matter_only_where_they_are_mapped(tmp_path):
    camera = {"header": (0.0, "t265"), "height": 4, "width": 4, "k": np.eye(3).ravel(), "d": np.full(4, 0.1)}
    picture = {"header": (0.1, "t265"), "encoding": "yuv422", "image": np.zeros((4, 4, 2), np.uint8)}
    more = [
        ("/t265/camera_info", "sensor_msgs/msg/CameraInfo", 0.2, camera | {"distortion_model": "equidistant"}),
        ("/t265/image", "sensor_msgs/msg/Image", 0.2, picture),
    ]
    write_bag(tmp_path / "bag", sorted([*messages(motion()), *more], key=lambda one: one[2]), "mcap")
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "robot.toml").write_text(ROS_MAP)
    assert cw.import_log(tmp_path / "bag", tmp_path / "robot.xml", mapping=tmp_path / "robot.toml")[0].image
    text = ROS_MAP.replace("/camera/color/image_raw", "/t265/image")
    assert "an image has an encoding that is not read; expected one of ['rgb8'" in refused(tmp_path, "bag", text)
    text = ROS_MAP.replace("[image.front]", '[image.front]\ncalibration = "/t265/camera_info"')
    assert "fisheye lenses are not supported" in refused(tmp_path, "bag", text)


def test_missing_transforms_are_named(tmp_path):
    def change(*message):
        return [] if message[0] == "/tf_static" else [message]

    assert "no such frame in the transforms of the log" in spoilt(tmp_path, change)


def test_a_velocity_in_degrees_is_found(bag):
    text = ROS_MAP.replace('velocity/elbow"', 'velocity/elbow"\nscale = 57.29578')
    assert "[measured.elbow_velocity]: it moves as much as degrees beside radians" in refused(bag, "bag", text)


def test_a_body_whose_pose_the_scene_does_not_measure_is_refused(bag):
    scene = SCENE.replace('<framequat name="block_orientation" objtype="xbody" objname="block"/>', "")
    assert 'add <framepos objtype="xbody" objname="block"/>' in refused(bag, "bag", ROS_MAP, scene)


def test_damaged_bags_are_refused(bag, tmp_path):
    whole = next((bag / "bag").glob("*.mcap")).read_bytes()
    said = ""
    for name, content in {"cut": whole[: len(whole) // 2], "none": b"", "text": b"time,elbow\n0,1\n" * 100}.items():
        (tmp_path / f"{name}.mcap").write_bytes(content)
        said = refused(tmp_path, f"{name}.mcap", ROS_MAP)
        assert "the log cannot be read as a bag or MCAP file of ROS" in said
    assert "mcap recover" in said


def test_damaged_data_sets_are_refused(lerobot, tmp_path):
    import shutil

    def broken(change) -> str:
        shutil.rmtree(tmp_path / "data", ignore_errors=True)
        shutil.copytree(lerobot / "data", tmp_path / "data")
        change(tmp_path / "data")
        return refused(tmp_path, "data", LEROBOT_MAP)

    def older(folder):
        path = folder / "meta" / "info.json"
        path.write_text(path.read_text().replace("v3.0", "v2.1"))

    def outside(folder):
        path = folder / "meta" / "info.json"
        info = json.loads(path.read_text())
        path.write_text(json.dumps(info | {"data_path": "../../{chunk_index}/{file_index}.parquet"}))

    def cut(folder):
        path = next(folder.glob("videos/*/*/*.mp4"))
        path.write_bytes(path.read_bytes()[:500])

    assert "another version of LeRobot data sets; expected v3.0, found v2.1" in broken(older)
    assert "a path leads out of the data set" in broken(outside)
    assert "a video cannot be decoded" in broken(cut)
    assert "a video of the data set is missing" in broken(lambda f: shutil.rmtree(f / "videos"))
    assert "a table of the data set is missing" in broken(lambda f: shutil.rmtree(f / "data"))
    assert "the data set has no table of episodes" in broken(lambda f: shutil.rmtree(f / "meta" / "episodes"))
    assert "not a JSON file" in broken(lambda f: (f / "meta" / "info.json").write_text("{"))
    table = next((lerobot / "data" / "data").glob("*/*.parquet")).relative_to(lerobot / "data")
    assert "a table of the data set cannot be read" in broken(lambda f: (f / table).write_bytes(b"PAR1"))
    assert "no such episode; expected some of [0], found [7]" in refused(lerobot, "data", LEROBOT_MAP, episodes=(7,))


def test_images_that_are_none_are_refused(images):
    log = images / "log"
    first = min((log / "depth").iterdir())
    cv2.imwrite(str(first), np.zeros((*SIZE, 3), np.uint8))
    assert "an image of depths is not one" in refused(images, "log", IMAGES_MAP)
    first.write_bytes(b"no image")
    assert "an image cannot be decoded" in refused(images, "log", IMAGES_MAP)
    first.rename(first.with_name("depth.png"))
    assert "an image has no time in its name" in refused(images, "log", IMAGES_MAP)


def test_intrinsics_that_are_none_are_refused(images):
    path = images / "log" / "intrinsics.json"
    path.write_text(json.dumps({"fx": 40, "fy": 40, "cx": 23.5}))
    assert "the intrinsics lack a number; expected fx, fy, cx (or ppx), cy (or ppy) [px], found no cy" in refused(
        images, "log", IMAGES_MAP
    )
    path.write_text(json.dumps({"fx": 40, "fy": 40, "ppx": 20, "ppy": 15, "model": "ftheta", "coeffs": [0.1] * 5}))
    assert "fisheye lenses are not supported" in refused(images, "log", IMAGES_MAP)
    path.unlink()
    assert "the intrinsics of the camera are missing" in refused(images, "log", IMAGES_MAP)


def test_tables_that_are_none_are_refused(images):
    path = images / "log" / "joints.csv"
    path.write_text("elbow,grip\n0,1\n")
    assert "a table has no times" in refused(images, "log", IMAGES_MAP)
    path.write_text("time,elbow,grip\n0,one,2\n1,1,2\n")
    assert "joints.csv, line 2: a cell of column 'elbow' is not a number" in refused(images, "log", IMAGES_MAP)


def test_paths_that_are_no_logs_are_refused(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"")
    (tmp_path / "a.h5").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    assert "no such log" in refused(tmp_path, "gone.mcap", ROS_MAP)
    assert "unknown kind of log" in refused(tmp_path, "a.mp4", ROS_MAP)
    assert "unknown kind of log" in refused(tmp_path, "folder", ROS_MAP)
    assert "every command reads it as it is" in refused(tmp_path, "a.h5", ROS_MAP)


def test_large_images_are_refused_before_they_are_decoded(bag, monkeypatch):
    monkeypatch.setenv("CONCENT_MAX_RECORDING_BYTES", "10000")
    assert "the images are too large; expected at most 10,000 bytes once decoded" in refused(bag, "bag", ROS_MAP)


def test_load_recording_names_the_command(bag, lerobot, images):
    for path, words in (
        (bag / "bag", "a ROS bag or MCAP file"),
        (next((bag / "bag").glob("*.mcap")), "a ROS bag or MCAP file"),
        (lerobot / "data", "a LeRobot data set"),
        (images / "log", "a folder of images"),
    ):
        with pytest.raises(cw.RecordingError, match=f"this is {words}, not yet a recording.*`concent import {path}"):
            cw.load_recording(path)
