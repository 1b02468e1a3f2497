from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.errors import ConcentError, RecordingError
from concent_warp.reality.record import RealityCfg
from concent_warp.reality.sensors.footage import FootageCfg, apply_tone_curve, footage
from concent_warp.recording.formats.hdf5 import read_hdf5, write_hdf5
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.scene.cameras import add_cameras
from concent_warp.scene.shape_sorter import home

CFG = FootageCfg(cameras=("base", "wrist"), size=(64, 64), noise=0.0, samples=1)


@pytest.fixture(scope="module")
def streams():
    """Return footage of two postures, with the objects and without."""
    cfg = RealityCfg()
    scene = cfg.task.build()
    world = cfg.world.build(scene)
    qpos = np.tile(home(world.compile()), (2, 1))
    qpos[1, 0] += 0.3
    rng = np.random.default_rng(0)
    return [
        footage(replace(CFG, objects=there), world, scene.objects(), np.array([0.0, 0.1]), qpos, rng)
        for there in (True, False)
    ], scene, qpos  # fmt: skip


def test_objects_are_left_out_of_the_images_and_nothing_else_is(streams):
    (there, gone), scene, _ = streams
    before = np.abs(there["base"].rgb.astype(int) - gone["base"].rgb).max(axis=-1)[0] > 8
    assert 5 < before.sum() < 0.1 * before.size
    spec = scene.spec()
    add_cameras(spec, scene.objects())
    block = Pixel(there["base"], spec.compile()).of("block")
    assert before[block[1] - 1 : block[1] + 2, block[0] - 1 : block[0] + 2].any()


class Pixel:
    """Where a body is in the images of a fixed camera, by the calibration that came with them."""

    def __init__(self, stream, model: mujoco.MjModel) -> None:
        self.stream, self.data = stream, mujoco.MjData(model)
        self.data.qpos[:] = home(model)
        mujoco.mj_kinematics(model, self.data)

    def of(self, body: str) -> tuple[int, int]:
        local = self.stream.pose[:3, :3].T @ (self.data.body(body).xpos - self.stream.pose[:3, 3])
        u, v, _ = self.stream.intrinsics @ (local / local[2])
        return round(u), round(v)


def test_wrist_camera_is_on_the_hand_and_sees_other_things_when_the_arm_turns(streams):
    (there, _), _, _ = streams
    assert there["base"].body is None
    assert there["wrist"].body == "hand"
    still, moved = (np.abs(np.diff(there[name].rgb.astype(int), axis=0)).mean() for name in ("base", "wrist"))
    assert moved > 2 * still > 0


def test_camera_on_a_body_is_kept_in_the_file_and_no_points_are_tracked_from_it(streams, tmp_path):
    (there, _), scene, qpos = streams
    demonstration = Demonstration("demo_0", qpos=qpos[0], image=there)
    write_hdf5(Recording(scene.xml, (demonstration,)), tmp_path / "demo.h5")
    read = read_hdf5(tmp_path / "demo.h5")[0]
    assert read.image["wrist"].body == "hand"
    assert read.image["base"].body is None
    assert np.allclose(read.image["wrist"].pose, there["wrist"].pose)
    nobody = replace(there["wrist"], body="elbow")
    with pytest.raises(RecordingError, match=r"a body that the scene lacks.*elbow"):
        write_hdf5(Recording(scene.xml, (replace(demonstration, image={"wrist": nobody}),)), tmp_path / "bad.h5")


def test_tone_curve_keeps_black_and_order():
    levels = apply_tone_curve(np.linspace(0, 1, 20)[:, None].repeat(3, axis=1), FootageCfg())
    assert np.allclose(levels[0], 0)
    assert (np.diff(levels, axis=0) >= 0).all()


def test_a_video_that_lacks_frames_is_an_error(tmp_path, monkeypatch):
    from concent_warp.reality.sensors import video

    frames = np.random.default_rng(0).integers(0, 255, (8, 64, 64, 3), dtype=np.uint8)
    (tmp_path / "a.mp4").write_text("earlier")
    grab = video._check_video
    monkeypatch.setattr(
        video, "_check_video", lambda path, count, to: (path.write_bytes(b"cut"), grab(path, count, to))
    )
    with pytest.raises(
        ConcentError, match=r"a\.mp4: the video cannot be written; expected 8 frames, found 0; make room"
    ):
        video.write_video(tmp_path / "a.mp4", frames, 10.0)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.mp4", "earlier")]
    monkeypatch.undo()
    video.write_video(tmp_path / "a.mp4", frames, 10.0)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    video._check_video(tmp_path / "a.mp4", 8, tmp_path)
