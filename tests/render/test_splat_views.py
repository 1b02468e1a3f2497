import json

import cv2
import numpy as np
import pytest
from photographed import photographed

from concent_warp.errors import RenderError
from concent_warp.render.splats.views import FILE, read_views


@pytest.fixture
def folder(tmp_path):
    photographed(3, 16).write(tmp_path)
    return tmp_path


def edit(folder, change):
    document = json.loads((folder / FILE).read_text())
    change(document)
    (folder / FILE).write_text(json.dumps(document))


def test_written_views_are_read_back(folder):
    views, again = photographed(3, 16), read_views(folder)
    assert again.masked
    np.testing.assert_array_equal(again.rgba, views.rgba)
    np.testing.assert_allclose(again.poses, views.poses, atol=1e-12)
    np.testing.assert_allclose(again.intrinsics, views.intrinsics, atol=1e-9)


def test_camera_angle_gives_the_focal_length_and_the_middle(folder):
    def change(document):
        document["camera_angle_x"] = 2 * np.arctan(0.5)
        for frame in document["frames"]:
            for name in ("fl_x", "fl_y", "cx", "cy"):
                del frame[name]

    edit(folder, change)
    np.testing.assert_allclose(read_views(folder).intrinsics[1], [[16, 0, 7.5], [0, 16, 7.5], [0, 0, 1]])


def test_camera_given_for_larger_images_is_scaled(folder):
    before = read_views(folder).intrinsics

    def change(document):
        document["w"] = document["h"] = 32
        for frame in document["frames"]:
            frame |= {name: 2 * frame[name] for name in ("fl_x", "fl_y", "cx", "cy")}

    edit(folder, change)
    np.testing.assert_allclose(read_views(folder).intrinsics, before)


def test_pose_of_the_object_moves_the_cameras_into_its_frame(folder):
    before = read_views(folder).poses
    edit(folder, lambda document: document.update(object_pose=[0.1, 0, 0, 0.5**0.5, 0, 0, 0.5**0.5]))
    after = read_views(folder).poses
    # A quarter turn about z: what was along the world's y is now along the object's x.
    np.testing.assert_allclose(after[:, 0, 3], before[:, 1, 3], atol=1e-9)
    np.testing.assert_allclose(after[:, 1, 3], 0.1 - before[:, 0, 3], atol=1e-9)


def test_shrunk_views_show_the_same_from_the_same_cameras():
    large, small = photographed(3, 64), photographed(3, 32)
    shrunk = large.shrunk(32)
    assert shrunk.size == (32, 32)
    np.testing.assert_allclose(shrunk.intrinsics, small.intrinsics, atol=1e-9)
    solid = (small.rgba[..., 3] > 250) & (shrunk.rgba[..., 3] > 250)
    assert np.abs(shrunk.rgba[solid].astype(float) - small.rgba[solid]).mean() < 8
    for one, other in zip(shrunk.rgba[..., 3], small.rgba[..., 3], strict=True):
        middles = [np.average(np.indices((32, 32)), axis=(1, 2), weights=np.tile(a, (2, 1, 1))) for a in (one, other)]
        np.testing.assert_allclose(middles[0], middles[1], atol=0.1)
    assert large.shrunk(64) is large


def test_images_without_alpha_have_no_mask(folder):
    for path in folder.glob("*.png"):
        cv2.imwrite(str(path), np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR)))
    views = read_views(folder)
    assert not views.masked
    assert (views.rgba[..., 3] == 255).all()


def tilt(document):
    document["frames"][1]["transform_matrix"][0][0] += 0.1


BROKEN = {
    "no file": (lambda f: (f / FILE).unlink(), "no posed images"),
    "no JSON": (lambda f: (f / FILE).write_text("{"), "not a JSON file"),
    "no frames": (lambda f: edit(f, lambda d: d.pop("frames")), "no list of frames"),
    "no image": (lambda f: (f / "0001.png").unlink(), r"frame 1: no such image.*'0001.png'"),
    "no picture": (lambda f: (f / "0002.png").write_text("hello"), "8-bit"),
    "other size": (lambda f: cv2.imwrite(str(f / "0002.png"), np.zeros((8, 8, 4), np.uint8)), "differ in size"),
    "no pose": (lambda f: edit(f, lambda d: d["frames"][0].pop("transform_matrix")), "frame 0: .*no camera pose"),
    "no rotation": (lambda f: edit(f, tilt), "frame 1: .*no rotation"),
    "no focal length": (lambda f: edit(f, lambda d: d["frames"][0].pop("fl_x")), "focal length is missing"),
    "flat camera": (lambda f: edit(f, lambda d: d["frames"][0].update(fl_x=0)), "focal lengths > 0"),
    "object nowhere": (lambda f: edit(f, lambda d: d.update(object_pose=[1, 2])), "object_pose is no pose"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_views_get_one_clear_sentence(folder, kind):
    make, message = BROKEN[kind]
    make(folder)
    with pytest.raises(RenderError, match=message) as error:
        read_views(folder)
    assert "\n" not in str(error.value)
