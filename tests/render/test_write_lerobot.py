"""A recording is written as a LeRobot data set and read back the same."""

from __future__ import annotations

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

import concent_warp as cw
from concent_warp.cli import main
from concent_warp.recording.logs.readers.video import CODES, DepthCodes
from concent_warp.recording.recording import ImageStream
from concent_warp.render.cameras import Camera, scene_calibration

SCENE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="elbow" axis="0 1 0" range="-170 170"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
      <camera name="wrist" pos="0.1 0 0.05" quat="0.7 0.1 0.2 0.3" fovy="50"/>
    </body>
    <body name="block" pos="0.4 0.3 0.05"><freejoint/><geom type="box" size="0.05 0.05 0.05"/></body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="20"/></actuator>
  <sensor>
    <jointpos name="elbow_position" joint="elbow"/>
    <force name="push" site="tip"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
""".replace('<geom type="capsule"', '<site name="tip"/><geom type="capsule"')
RATE, COUNT, SIZE = 20, 12, (32, 48)
POSE = np.array([[0.0, 0, 1, -0.5], [-1, 0, 0, 0.1], [0, -1, 0, 0.6], [0, 0, 0, 1]])
INTRINSICS = np.array([[60.0, 0, 23.5], [0, 60.0, 15.5], [0, 0, 1]])
LOST = slice(4, 7)


def recording(shift: float = 0.0) -> cw.Recording:
    rng = np.random.default_rng(0)
    fast, time = np.arange(0, 0.6, 0.01), np.arange(COUNT) / RATE
    place = np.array([0.4, 0.3, 0.05]) + 0.01 * rng.normal(size=(COUNT, 3))
    turn = rng.normal(size=(COUNT, 4)) * 0.1 + [1, 0, 0, 0]
    turn[9] *= -1  # the same rotation
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    place[LOST], turn[LOST] = np.nan, np.nan
    covariance = np.tile(1e-6 * np.eye(3), (COUNT, 1, 1))
    covariance[LOST] = np.nan
    rgb = np.full((COUNT, *SIZE, 3), 40, np.uint8) + 10 * np.arange(COUNT, dtype=np.uint8)[:, None, None, None]
    depth = rng.uniform(0.5, 3, (COUNT, *SIZE)).astype(np.float32)
    depth[:, :3] = 0
    demonstration = cw.Demonstration(
        "demo_0",
        "push the block",
        action={"elbow": cw.Channel(np.array([0.0, 0.22, 0.4]), np.array([0.1, 0.5, 0.3]) + shift)},
        measured={
            "elbow_position": cw.Channel(fast, np.sin(fast)[:, None] + shift, noise_std=2e-4),
            "push": cw.Channel(fast, fast[:, None] * [1.0, 2, 3]),
            "block_position": cw.Channel(time, place, 1e-3, None, covariance),
            "block_orientation": cw.Channel(time, turn, 1e-3, None, covariance),
        },
        image={
            "front": ImageStream(time, rgb, depth, INTRINSICS, POSE),
            "wrist": ImageStream(time, rgb[::-1], np.zeros_like(depth), INTRINSICS, np.eye(4), "arm"),
        },
    )
    return cw.Recording(SCENE, (demonstration,))


def read_back(folder) -> cw.Recording:
    # The images are noise, which does not fit the scene.
    return cw.import_log(folder, folder / "scene.xml", cw.ImportCfg(checked_frames=1), mapping=folder / "map.toml")


def test_a_recording_is_read_back_the_same(tmp_path):
    first, second = recording()[0], replace(recording(0.2)[0], name="demo_1", task="push again")
    written = replace(recording(), demonstrations=(first, second))
    shares = []
    assert cw.write_lerobot(written, tmp_path / "data", progress=shares.append) == 2
    assert shares[-1] == 1
    found = read_back(tmp_path / "data")
    assert [one.task for one in found.demonstrations] == ["push the block", "push again"]
    time = np.arange(COUNT) / RATE
    step = float(np.diff(DepthCodes().metres(np.arange(1, CODES - 1))).max())
    for one, true, shift in zip(found.demonstrations, (first, second), (0.0, 0.2), strict=True):
        held = np.select([time < 0.22, time < 0.4 - 1e-9], [0.1, 0.5], 0.3)
        np.testing.assert_allclose(one.action["elbow"].value, held + shift, atol=1e-6)
        np.testing.assert_allclose(one.measured["elbow_position"].value[:, 0], np.sin(time) + shift, atol=1e-6)
        assert one.measured["elbow_position"].noise_std == 2e-4
        np.testing.assert_allclose(one.measured["push"].value, time[:, None] * [1, 2, 3], atol=1e-6)
        for name in ("block_position", "block_orientation"):
            value, expected = one.measured[name].value, np.array(true.measured[name].value)
            signs = np.where((value * expected).sum(axis=1, keepdims=True) < 0, -1, 1) if value.shape[1] == 4 else 1
            np.testing.assert_allclose(one.measured[name].time, time, atol=1e-6)
            np.testing.assert_allclose(signs * value, expected, atol=1e-6)
        front = one.image["front"]
        np.testing.assert_allclose(front.time, time, atol=1e-6)
        np.testing.assert_array_equal(front.pose, POSE)
        np.testing.assert_array_equal(front.intrinsics, INTRINSICS)
        np.testing.assert_allclose(front.depth, true.image["front"].depth, atol=step)
        assert not front.depth[:, :3].any()
        np.testing.assert_allclose(front.rgb[:, 10, 10], true.image["front"].rgb[:, 10, 10], atol=4)
        assert one.image["wrist"].body == "arm"
        assert not one.image["wrist"].depth.any()
    info = json.loads((tmp_path / "data" / "meta" / "info.json").read_text())
    assert info["features"]["observation.pose.block"]["names"][:4] == [
        *(f"position/{a}" for a in "xyz"),
        "orientation/w",
    ]
    assert not list(tmp_path.glob(".data*"))
    assert not (tmp_path / "data" / "episodes").exists()


def test_poses_without_video_are_resampled_at_a_rate(tmp_path):
    still = replace(recording()[0], image={})
    assert (
        cw.write_lerobot(replace(recording(), demonstrations=(still,)), tmp_path / "d", cw.WriteLeRobotCfg(rate=40))
        == 1
    )
    assert not (tmp_path / "d" / "calibration.json").exists()
    assert not (tmp_path / "d" / "videos").exists()
    found = read_back(tmp_path / "d")[0].measured["block_position"]
    true = still.measured["block_position"].value
    np.testing.assert_allclose(np.diff(found.time), 1 / 40, atol=1e-6)
    np.testing.assert_allclose(found.value[1], (true[0] + true[1]) / 2, atol=1e-6)
    np.testing.assert_allclose(found.value[6], true[3], atol=1e-6)
    # Beside a missing pose nothing is made up.
    assert np.isnan(found.value[7:14]).all()
    np.testing.assert_allclose(found.value[14], true[7], atol=1e-6)


def test_weights_that_a_data_set_lacks_are_warned_of(tmp_path):
    loaded = replace(recording()[0], image={}, payloads=(cw.Payload("arm", 0.2),))
    with pytest.warns(UserWarning, match="payloads have no place in a LeRobot data set: that bodies carry weights in "):
        cw.write_lerobot(replace(recording(), demonstrations=(loaded,)), tmp_path / "d")
    assert not read_back(tmp_path / "d")[0].payloads


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path):
    whole = recording()
    second = replace(whole[0], name="demo_1", image={})
    with pytest.raises(cw.RenderError, match="the demonstrations have other cameras"):
        cw.write_lerobot(replace(whole, demonstrations=(whole[0], second)), tmp_path / "d")
    moved = replace(whole[0].image["front"], pose=POSE + 0.1 * np.eye(4))
    second = replace(second, image={**whole[0].image, "front": moved})
    with pytest.raises(cw.RenderError, match="a camera is calibrated otherwise"):
        cw.write_lerobot(replace(whole, demonstrations=(whole[0], second)), tmp_path / "d")
    with pytest.raises(cw.RenderError, match="needs commands and measurements"):
        cw.write_lerobot(replace(whole, demonstrations=(replace(whole[0], action={}),)), tmp_path / "d")
    odd = replace(whole[0].image["front"], rgb=whole[0].image["front"].rgb[:, :31], depth=np.zeros((COUNT, 31, 48)))
    with pytest.raises(cw.RenderError, match="images of this size make no video"):
        cw.write_lerobot(replace(whole, demonstrations=(replace(whole[0], image={"front": odd}),)), tmp_path / "d")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "mine.txt").write_text("x")
    with pytest.raises(cw.RenderError, match="the folder is not empty"):
        cw.write_lerobot(whole, tmp_path / "d")


def test_the_command_writes_a_data_set(tmp_path, capsys):
    cw.write_hdf5(recording(), tmp_path / "demo.h5")
    command = ["export", "--recording", str(tmp_path / "demo.h5"), "-o", str(tmp_path / "data")]
    assert main([*command, "--lerobot.no-depth"]) == 0
    assert "the data set holds 1 episode" in capsys.readouterr().out
    assert not read_back(tmp_path / "data")[0].image["front"].depth.any()
    for wrong, sentence in (
        ([], "the folder is not empty"),
        (["--pretrained"], "one thing is to be exported"),
        (["--lerobot.rate", "0"], "--lerobot.rate"),
    ):
        assert main([*command, *wrong]) == 2
        assert sentence in capsys.readouterr().err


def test_calibration_of_a_scenes_camera_is_that_of_the_renderer():
    scene = cw.Scene(SCENE)
    found = scene_calibration(scene.model, "wrist", SIZE)
    blank = np.zeros((1, *SIZE, 3), np.uint8)
    assert found.pose is not None
    stream = ImageStream(np.zeros(1), blank, np.zeros((1, *SIZE)), found.intrinsics, found.pose, found.body)
    mine, true = Camera.of("wrist", stream), Camera.in_scene(scene, "wrist")
    assert mine.body == true.body == "arm"
    assert mine.position == pytest.approx(true.position)
    assert abs(np.dot(mine.quaternion, true.quaternion)) == pytest.approx(1)
    assert mine.fovy == pytest.approx(true.fovy)
    # A point on the upper edge of the field of view is half a pixel above the first row.
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    up = np.array([0, np.tan(np.radians(25.0)), -1.0])
    point = data.cam_xpos[0] + data.cam_xmat[0].reshape(3, 3) @ up
    world = np.eye(4)
    arm = scene.model.body("arm").id
    world[:3, :3], world[:3, 3] = data.xmat[arm].reshape(3, 3), data.xpos[arm]
    local = np.linalg.inv(world @ found.pose) @ [*point, 1]
    assert (found.intrinsics @ local[:3])[1] / local[2] == pytest.approx(-0.5)
