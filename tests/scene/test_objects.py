import mujoco
import numpy as np
import pytest
import trimesh

from concent_warp.errors import SceneError
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.objects import load_object
from concent_warp.scene.shapes.solid import Box
from concent_warp.scene.spheres.build import ContactGeometryCfg

HALF = np.array([0.02, 0.03, 0.01])


def scene_of(thing, **pose) -> Scene:
    spec = mujoco.MjSpec.from_string('<mujoco><worldbody><geom type="plane" size="1 1 .1"/></worldbody></mujoco>')
    thing.add_to(spec, **pose)
    return Scene.from_spec(spec)


def write_points(path, points):
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    path.write_text(header + "end_header\n" + "\n".join(" ".join(map(str, p)) for p in points) + "\n")
    return path


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_mesh_becomes_a_free_body_with_its_inertia(tmp_path, suffix):
    mesh = trimesh.creation.box(2000 * HALF, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    mesh.export(tmp_path / f"brick.{suffix}")
    brick = load_object(tmp_path / f"brick.{suffix}", "brick", mass=0.1, scale=0.001)
    model = scene_of(brick, position=(0, 0, 0.1)).model
    body = model.body("brick")
    assert model.jnt_type[body.jntadr[0]] == mujoco.mjtJoint.mjJNT_FREE
    np.testing.assert_allclose(body.mass, 0.1)
    np.testing.assert_allclose(body.ipos, [0.005, 0, 0], atol=1e-8)
    expected = 0.1 / 3 * (np.sum(HALF**2) - HALF**2)
    np.testing.assert_allclose(np.sort(body.inertia), np.sort(expected), rtol=1e-4)
    np.testing.assert_allclose(body.pos, [0, 0, 0.1])


def test_object_falls_and_rests_on_the_floor(tmp_path):
    trimesh.creation.box(2 * HALF).export(tmp_path / "brick.stl")
    model = scene_of(load_object(tmp_path / "brick.stl", "brick", density=500), position=(0, 0, 0.02)).model
    assert model.body("brick").mass[0] == pytest.approx(500 * 8 * np.prod(HALF))
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert data.qpos[2] == pytest.approx(0.01, abs=1e-3)


def test_mesh_object_gets_spheres_within_it(tmp_path):
    trimesh.creation.annulus(0.01, 0.03, 0.02).export(tmp_path / "ring.stl")
    ring = load_object(tmp_path / "ring.stl", "ring")
    geometry = ContactGeometryCfg(count=80, candidates=4000, friction=0.5).build(scene_of(ring))
    radial = np.linalg.norm(geometry.position[:, :2], axis=1)
    assert (radial - geometry.radius > 0.0099).all()
    assert (radial + geometry.radius < 0.0301).all()
    assert (np.abs(geometry.position[:, 2]) + geometry.radius < 0.0101).all()


def test_points_keep_their_surface_for_the_spheres(tmp_path):
    points = Box(HALF).sample(4000, np.random.default_rng(0))[0]
    brick = load_object(write_points(tmp_path / "brick.ply", points * 1000), "brick", mass=0.1, scale=0.001)
    assert brick.inertia[0, 0] == pytest.approx(0.1 / 3 * (HALF[1] ** 2 + HALF[2] ** 2), rel=0.05)
    scene = scene_of(brick)
    geometry = ContactGeometryCfg(count=100, radius=0.003).build(scene, surfaces={"brick": brick.surface})
    outside = Box(HALF).distance(geometry.position)[0] + geometry.radius
    assert np.quantile(outside, 0.9) < 5e-4
    assert outside.max() < 1.5e-3
    np.testing.assert_allclose(np.abs(geometry.position).max(axis=0), HALF - 0.003, atol=1e-3)


@pytest.mark.parametrize("suffix", ["xyz", "npy"])
def test_plain_point_files_are_read(tmp_path, suffix):
    points = Box(HALF).sample(1000, np.random.default_rng(0))[0]
    path = tmp_path / f"brick.{suffix}"
    np.save(path, points) if suffix == "npy" else np.savetxt(path, points)
    assert np.ptp(load_object(path, "brick").vertices, axis=0) == pytest.approx(2 * HALF, rel=0.02)


def test_open_mesh_is_replaced_by_its_hull_with_a_warning(tmp_path):
    mesh = trimesh.creation.box(2 * HALF)
    mesh.update_faces(np.arange(12) > 1)
    mesh.export(tmp_path / "open.stl")
    with pytest.warns(UserWarning, match=r"open\.stl: the mesh is not watertight"):
        brick = load_object(tmp_path / "open.stl", "brick", density=1000)
    assert brick.mass == pytest.approx(8000 * np.prod(HALF))


def test_millimetres_are_noticed(tmp_path):
    trimesh.creation.box(2000 * HALF).export(tmp_path / "brick.stl")
    with pytest.raises(SceneError, match=r"found 60 m; looks like millimetres, pass scale=0\.001"):
        load_object(tmp_path / "brick.stl", "brick")
    with pytest.raises(SceneError, match="pass a scale above 1e-06"):
        load_object(tmp_path / "brick.stl", "brick", scale=1e-6)


def test_broken_files_get_one_clear_sentence(tmp_path):
    cases = {
        "none.stl": (None, "no such file"),
        "text.stl": (b"solid nothing", "mesh"),
        "garbage.stl": (bytes(range(256)) * 2, "mesh"),
        "empty.obj": (b"# nothing\n", "mesh"),
        "brick.dae2": (b"x", "kind of file"),
        "words.xyz": (b"a b c\n", "points cannot be read"),
        "flat.xyz": (b"0 0 0\n1 0 0\n0 1 0\n1 1 0\n" * 20, "no volume"),
        "two.xyz": (b"0 0\n1 1\n", "wrong shape"),
        "nan.xyz": (b"0 0 nan\n" * 60, "not finite"),
        "few.xyz": (b"0 0 0\n.1 0 0\n0 .1 0\n0 0 .1\n", "too few points"),
        "cut.npy": (b"\x93NUMPY", "points cannot be read"),
        "pickle.npy": (pickled(tmp_path), "points cannot be read"),
        "huge.npy": (npy("f8", "(2000000000000, 3)"), "points cannot be read"),
        "unclosed.npy": (npy("f8", "((2, 3)"), "points cannot be read"),
        "records.npy": (npy("f8', 'x", "(2, 3)"), "points cannot be read"),
        "normals.ply": (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float nx\nend_header\n1\n",
            "no coordinates",
        ),
    }
    for name, (content, message) in cases.items():
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(SceneError, match=message) as error:
            load_object(path, "thing")
        assert name in str(error.value)
        assert "\n" not in str(error.value)


def npy(kind: str, shape: str) -> bytes:
    """Return an .npy file with 16 bytes of data, whatever its header says."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + bytes(16)


def pickled(folder) -> bytes:
    path = folder / "object.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return path.read_bytes()


def test_settings_and_names_that_make_no_sense_are_refused(tmp_path):
    trimesh.creation.box(2 * HALF).export(tmp_path / "brick.stl")
    with pytest.raises(SceneError, match="scale of object 'brick' is not right"):
        load_object(tmp_path / "brick.stl", "brick", scale=0)
    with pytest.raises(SceneError, match="mass of object 'brick' is not right"):
        load_object(tmp_path / "brick.stl", "brick", mass=float("nan"))
    brick = load_object(tmp_path / "brick.stl", "brick")
    spec = mujoco.MjSpec()
    brick.add_to(spec)
    with pytest.raises(SceneError, match="body 'brick' already"):
        brick.add_to(spec)
