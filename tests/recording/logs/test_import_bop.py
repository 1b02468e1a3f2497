"""Scenes in BOP's format are read as they were written, tracked, evaluated, and refused where something is wrong."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

import concent_warp as cw
from benchmarks.perception.bop_scene import SENSING, Orbit, camera_poses, object_poses, write_bop_scene
from concent_warp.cli import main
from concent_warp.perception.evaluation.bop_results import HEADER, bop_errors, bop_estimates, write_results
from concent_warp.perception.tracking.cfg import AcceptCfg, TrackCfg
from concent_warp.recording.logs.bop.dataset import BopInstance, read_scene, symmetric_objects
from concent_warp.recording.logs.bop.import_bop import open_bop
from concent_warp.recording.logs.bop.meshes import read_mesh
from concent_warp.recording.logs.cfg import BopCfg

ORBIT = Orbit(images=4)
SIZE = (240, 320)
BODIES = ["obj_000001", "obj_000002", "obj_000003"]


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("bop") / "own"
    return write_bop_scene(root, 7, ORBIT, replace(SENSING, image_size=SIZE))


@pytest.fixture
def scene(written, tmp_path) -> Path:
    """A copy that a test may change."""
    shutil.copytree(written.parent.parent, tmp_path / "own")
    return tmp_path / "own" / "test" / "000007"


def edit(path: Path, change) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def test_a_scene_is_read_in_metres_with_the_camera_as_world(written):
    recording = cw.import_log(written)
    demonstration = recording[0]
    assert demonstration.name == "demo_7"
    stream = demonstration.image["camera"]
    assert stream.depth.shape == (4, *SIZE)
    assert np.allclose(stream.pose, np.eye(4))
    assert np.allclose(stream.time, np.arange(4) / 30)
    scale = 1e-3 * json.loads((written / "scene_camera.json").read_text())["2"]["depth_scale"]
    raw = cv2.imread(str(written / "depth" / "000002.png"), cv2.IMREAD_UNCHANGED)
    assert np.allclose(stream.depth[1], scale * raw, atol=1e-6)
    assert 0.5 < np.median(stream.depth[stream.depth > 0]) < 1.2
    model = cw.Scene(recording.scene).model
    assert cw.Scene(recording.scene).objects() == tuple(BODIES)
    for body, pose in zip(BODIES, object_poses().values(), strict=True):
        true = np.linalg.inv(camera_poses(ORBIT)) @ pose
        assert np.allclose(demonstration.measured[f"{body}_position"].value, true[:, :3, 3], atol=1e-9)
        start = model.joint(body).qposadr[0]
        assert np.allclose(demonstration.qpos[start : start + 3], true[0, :3, 3], atol=1e-9)
    # Vertices of the meshes are in metres, in the frame of the object: the carton is 8 x 5 x 10 cm.
    low = model.mesh_vert[: model.mesh_vertnum[0]]
    assert np.allclose(np.sort(np.ptp(low, axis=0)), [0.05, 0.08, 0.1], atol=1e-6)


def test_a_scene_is_tracked_and_its_result_file_has_bops_columns(written, tmp_path):
    bop = open_bop(written)
    found = cw.track(bop.recording(), TrackCfg(accept=AcceptCfg(max_unexplained=1.0)))
    estimates = bop_estimates(bop, found.tracks, seconds=0.25)
    errors = {one.object: one for one in bop_errors(estimates, written.parent.parent)}
    assert max(errors[1].add.max(), errors[3].add.max()) < 3e-3
    assert errors[2].adds.max() < 3e-3
    assert symmetric_objects(written.parent.parent / "models") == {2}
    path = tmp_path / "concent_own-test.csv"
    assert write_results(path, estimates) == 12
    lines = path.read_text().splitlines()
    assert lines[0] == HEADER
    assert len(lines) == 13
    for line in lines[1:]:
        cells = line.split(",")
        assert (cells[0], cells[3], cells[6]) == ("7", "1", "0.25")
        turn, shift = np.array(cells[4].split(), float).reshape(3, 3), np.array(cells[5].split(), float)
        assert np.allclose(turn @ turn.T, np.eye(3))
        truth = json.loads((written / "scene_gt.json").read_text())[cells[1]][int(cells[2]) - 1]
        assert np.linalg.norm(shift - truth["cam_t_m2c"]) < 3.0  # mm


def test_a_pose_of_the_truth_has_no_error_and_a_lost_one_is_infinitely_far(written, tmp_path):
    bop = open_bop(written)
    exact = [replace(e, pose=e.truth) for e in bop_estimates(bop, ())]
    assert all(np.isinf(one.add).all() for one in bop_errors(bop_estimates(bop, ()), written.parent.parent))
    errors = bop_errors(exact, written.parent.parent)
    assert [one.object for one in errors] == [1, 2, 3]
    assert max(one.adds.max() for one in errors) < 1e-9
    assert write_results(tmp_path / "none.csv", bop_estimates(bop, ())) == 0


def test_images_and_truth_are_left_out_on_demand_and_instances_are_counted(scene):
    few = cw.import_log(scene, cfg=cw.ImportCfg(bop=BopCfg(first_image=2, last_image=3, rate=10, truth=False)))[0]
    assert len(few.image["camera"].time) == 2
    assert np.allclose(few.image["camera"].time, [0, 0.1])
    assert few.measured == {}
    assert few.qpos is None
    edit(scene / "scene_gt.json", lambda d: [d[k].append(d[k][0]) for k in d])
    assert BopInstance(1, 1) in open_bop(scene).instances
    assert "obj_000001_1_position" in cw.import_log(scene)[0].measured


def test_an_object_that_appears_later_waits_behind_the_camera(scene):
    edit(scene / "scene_gt.json", lambda d: d["1"].pop(1))
    recording = cw.import_log(scene)
    start = cw.Scene(recording.scene).model.joint("obj_000002").qposadr[0]
    assert recording[0].qpos[start + 2] == -1
    assert len(recording[0].measured["obj_000002_position"].time) == 3


def test_without_truth_the_targets_of_the_challenge_name_the_objects(scene):
    (scene / "scene_gt.json").unlink()
    with pytest.raises(cw.RecordingError, match="nothing tells which objects the scene has"):
        cw.import_log(scene)
    targets = [
        {"scene_id": 7, "im_id": 2, "obj_id": 3, "inst_count": 2},
        {"scene_id": 8, "im_id": 2, "obj_id": 1, "inst_count": 1},
    ]
    (scene.parent.parent / "test_targets_bop19.json").write_text(json.dumps(targets))
    found = cw.import_log(scene)
    assert cw.Scene(found.scene).objects() == ("obj_000003", "obj_000003_1")
    assert found[0].qpos is None
    only = bop_estimates(open_bop(scene), (), only_targets=True)
    assert [(e.image, e.object) for e in only] == [(2, 3), (2, 3)]


def test_images_of_another_principal_point_are_resampled_to_the_first(scene):
    def shift(document):
        document["2"]["cam_K"][2] += 5

    before = cw.import_log(scene)[0].image["camera"]
    edit(scene / "scene_camera.json", shift)
    after = cw.import_log(scene)[0].image["camera"]
    assert np.array_equal(after.depth[0], before.depth[0])
    assert np.array_equal(after.depth[1, :, :-5], before.depth[1, :, 5:])
    assert np.array_equal(after.rgb[1, :, :-5], before.rgb[1, :, 5:])


def test_gray_images_are_colours_of_one_kind(scene):
    (scene / "rgb").rename(scene / "gray")
    for path in (scene / "gray").iterdir():
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), image)
    rgb = cw.import_log(scene)[0].image["camera"].rgb
    assert np.array_equal(rgb[..., 0], rgb[..., 2])


def test_a_textured_mesh_with_seams_is_closed(scene):
    """The carton in the ASCII form of YCB-V: each face with corners of its own, normals, colours and a texture."""
    corners = np.array([(x, y, z) for x in (-40, 40) for y in (-25, 25) for z in (-50, 50)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices = [f"{x} {y} {z} 0 0 1 0.5 0.5 9 9 9 255" for quad in quads for x, y, z in corners[list(quad)]]
    faces = [f"3 {4 * k + a} {4 * k + b} {4 * k + c}" for k in range(6) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    names = ["float x", "float y", "float z", "float nx", "float ny", "float nz", "float texture_u", "float texture_v"]
    names += ["uchar red", "uchar green", "uchar blue", "uchar alpha"]
    header = ["ply", "format ascii 1.0", "comment TextureFile obj_000001.png", "element vertex 24"]
    header += [f"property {name}" for name in names] + ["element face 12", "property list uchar int vertex_indices"]
    path = scene.parent.parent / "models" / "obj_000001.ply"
    path.write_text("\n".join([*header, "end_header", *vertices, *faces]) + "\n")
    mesh = read_mesh(path.parent, 1)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(0.08 * 0.05 * 0.1)
    assert cw.import_log(scene)[0].image


def test_an_open_mesh_is_filled_and_one_that_cannot_be_is_named(scene):
    path = scene.parent.parent / "models" / "obj_000003.ply"
    mesh = trimesh.load(path, force="mesh")
    assert isinstance(mesh, trimesh.Trimesh)
    keep = np.ones(len(mesh.faces), bool)
    keep[0] = False
    mesh.update_faces(keep)
    mesh.export(path)
    assert read_mesh(path.parent, 3).is_watertight
    keep = np.arange(len(mesh.faces)) < 5
    mesh.update_faces(keep)
    mesh.export(path)
    with pytest.warns(UserWarning, match="obj_000003.ply: the mesh is not watertight"):
        read_mesh(path.parent, 3)


def no_camera(scene):
    edit(scene / "scene_camera.json", lambda d: d["1"].pop("cam_K"))


def no_scale(scene):
    edit(scene / "scene_camera.json", lambda d: d["1"].update(depth_scale=0))


def mirrored(scene):
    edit(scene / "scene_gt.json", lambda d: d["1"][0].update(cam_R_m2c=[1, 0, 0, 0, 1, 0, 0, 0, -1]))


def unknown_image(scene):
    edit(scene / "scene_gt.json", lambda d: d.update({"99": d["1"]}))


def no_depth(scene):
    (scene / "depth" / "000003.png").unlink()


def small_image(scene):
    cv2.imwrite(str(scene / "depth" / "000003.png"), np.ones((10, 10), np.uint16))


def no_mesh(scene):
    (scene.parent.parent / "models" / "obj_000003.ply").unlink()


def broken_mesh(scene):
    (scene.parent.parent / "models" / "obj_000003.ply").write_text("ply\nformat ascii 1.0\nend_header\n")


def no_models(scene):
    shutil.rmtree(scene.parent.parent / "models")


def no_numbers(scene):
    (scene / "scene_camera.json").write_text('{"first": {}}')


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (no_camera, "cam_K is not right"),
        (no_scale, "depth_scale is not right"),
        (mirrored, "cam_R_m2c is no rotation"),
        (unknown_image, "a pose in an image that is not there"),
        (no_depth, "an image is missing; expected depth/000003.png"),
        (small_image, "the images differ in their size"),
        (no_mesh, "the mesh of an object is missing"),
        (broken_mesh, "the mesh of an object"),
        (no_models, "the data set has no meshes"),
        (no_numbers, "not a file of a BOP scene"),
    ],
)
def test_what_is_wrong_with_a_scene_is_said(scene, damage, sentence):
    damage(scene)
    with pytest.raises(cw.RecordingError, match=sentence):
        cw.import_log(scene)


def test_the_command_reads_a_scene_and_says_what_it_does_not_need(written, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    command = ["import", str(written)]
    assert main([*command, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "measured/obj_000003_orientation" in shown
    assert "320 x 240" in shown
    out = tmp_path / "demo.h5"
    assert main([*command, "-o", str(out), "--bop.last-image", "2"]) == 0
    assert "demo_7: 0.0 s, 6 sensors, 1 cameras" in capsys.readouterr().out
    assert len(cw.load_recording(out)[0].image["camera"].time) == 2
    for wrong, sentence in (
        (["--map", "robot.toml"], "needs neither model, map nor episodes"),
        (["--bop.first-image", "50"], "no images between the first and the last number"),
        (["--bop.rate", "0"], "--bop.rate"),
        (["--bop.models", "gone"], "the data set has no meshes"),
        ([str(tmp_path / "x")], "a scene of a BOP data set among other logs"),
    ):
        assert main([*command, *wrong, "-o", str(tmp_path / "other.h5")]) == 2
        assert sentence in capsys.readouterr().err
    assert main(["import", str(written.parent.parent), "-o", str(tmp_path / "other.h5")]) == 2
    assert "a data set with the scenes test/000007; name one of its scenes" in capsys.readouterr().err
    assert main(["compare", str(written)]) == 2
    assert "not yet a recording" in capsys.readouterr().err
    assert read_scene(written).split == "test"
