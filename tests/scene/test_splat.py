import numpy as np
import pytest

from concent_warp.errors import SceneError
from concent_warp.scene.shapes.ply import read_vertices
from concent_warp.scene.shapes.splat import read_splats, write_splats

FIELDS = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
FIELDS += [f"f_rest_{k}" for k in range(24)]
FIELDS += [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]


def table(count: int = 200) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {name: rng.normal(size=count).astype(np.float32) for name in FIELDS}


def write_ply(path, values, form="binary_little_endian", extra="", count=None):
    names = list(values)
    rows = len(values[names[0]])
    header = (
        f"ply\nformat {form} 1.0\ncomment made by a test\n{extra}element vertex {rows if count is None else count}\n"
    )
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    if form == "ascii":
        body = "\n".join(" ".join(repr(float(values[n][i])) for n in names) for i in range(rows)).encode() + b"\n"
    else:
        order = "<" if "little" in form else ">"
        body = np.stack([values[n] for n in names], axis=1).astype(f"{order}f4").tobytes()
    path.write_bytes(header.encode() + body)
    return path


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_splats_are_read_by_name_in_any_order(tmp_path, form):
    values = table()
    shuffled = {name: values[name] for name in np.random.default_rng(1).permutation(FIELDS)}
    splats = read_splats(write_ply(tmp_path / "s.ply", shuffled, form))
    assert len(splats) == 200
    np.testing.assert_allclose(splats.mean, np.stack([values["x"], values["y"], values["z"]], 1))
    np.testing.assert_allclose(np.log(splats.scale[:, 1]), values["scale_1"], atol=1e-6)
    np.testing.assert_allclose(np.log(splats.opacity / (1 - splats.opacity)), values["opacity"], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(splats.rotation, axis=1), 1)
    turned = np.stack([values[f"rot_{k}"] for k in range(4)], axis=1)
    np.testing.assert_allclose(
        np.einsum("nd,nd->n", splats.rotation, turned), np.linalg.norm(turned, axis=1), rtol=1e-5
    )
    np.testing.assert_allclose(splats.rgb[:, 2], 0.28209479 * values["f_dc_2"] + 0.5, atol=1e-6)


@pytest.mark.parametrize("count", [0, 9, 24, 45])
def test_written_splats_are_read_back_with_harmonics_of_any_degree(tmp_path, count):
    rng = np.random.default_rng(3)
    values = {name: column for name, column in table().items() if not name.startswith("f_rest")}
    values |= {f"f_rest_{k}": rng.normal(size=200).astype(np.float32) for k in range(count)}
    splats = read_splats(write_ply(tmp_path / "s.ply", values))
    assert splats.harmonics.shape == (200, 1 + count // 3, 3)
    if count:
        # Green follows red as a whole.
        np.testing.assert_array_equal(splats.harmonics[:, 2, 1], values[f"f_rest_{count // 3 + 1}"])
    write_splats(splats, tmp_path / "again.ply")
    again = read_splats(tmp_path / "again.ply")
    for name in ("mean", "scale", "rotation", "opacity", "harmonics"):
        np.testing.assert_allclose(getattr(again, name), getattr(splats, name), rtol=1e-5, atol=1e-6, err_msg=name)
    original, written = read_vertices(tmp_path / "s.ply"), read_vertices(tmp_path / "again.ply")
    for name in ("f_dc_1", *(f"f_rest_{k}" for k in range(count))):
        np.testing.assert_array_equal(original[name], written[name])


def test_opaque_splats_are_written_with_finite_logits(tmp_path):
    splats = read_splats(write_ply(tmp_path / "s.ply", {**table(), "opacity": np.full(200, 400, np.float32)}))
    write_splats(splats, tmp_path / "again.ply")
    assert read_splats(tmp_path / "again.ply").opacity.min() > 0.999


def test_faint_splats_and_floaters_are_no_surface(tmp_path):
    values = table(500)
    for name in "xyz":
        values[name] = np.random.default_rng(2).uniform(-0.1, 0.1, 500).astype(np.float32)
    values["opacity"][:] = 3
    values["opacity"][:100] = -3
    values["x"][499] = 5
    points = read_splats(write_ply(tmp_path / "s.ply", values)).surface_points()
    assert 380 <= len(points) <= 399
    assert points.max() < 0.11
    assert not np.isin(values["x"][:100], points[:, 0].astype(np.float32)).any()


def test_scaled_splats_scale_lengths_and_nothing_else(tmp_path):
    splats = read_splats(write_ply(tmp_path / "s.ply", table()))
    half = splats.scaled(0.5)
    np.testing.assert_allclose(half.mean, splats.mean / 2)
    np.testing.assert_allclose(half.scale, splats.scale / 2)
    np.testing.assert_array_equal(half.opacity, splats.opacity)


def test_vertices_after_fixed_rows_are_read(tmp_path):
    path = tmp_path / "s.ply"
    header = "ply\nformat binary_little_endian 1.0\nelement camera 2\nproperty double f\nelement vertex 1\n"
    header += "property uchar red\nproperty double x\nend_header\n"
    path.write_bytes(header.encode() + np.zeros(2).tobytes() + b"\x07" + np.array([0.25]).tobytes())
    values = read_vertices(path)
    assert values["red"].tolist() == [7]
    assert values["x"].tolist() == [0.25]


BROKEN = {
    "not a PLY": (lambda p: p.write_bytes(b"hello"), "not a PLY file"),
    "no end of header": (lambda p: p.write_bytes(b"ply\nformat ascii 1.0\n"), "not a PLY file"),
    "unknown format": (lambda p: write_ply(p, table(), "binary"), "unknown PLY format"),
    "cut short": (lambda p: p.write_bytes(write_ply(p, table()).read_bytes()[:-10]), "cut short"),
    "ascii cut short": (lambda p: write_ply(p, table(), "ascii", count=201), "cut short"),
    "absurd count": (lambda p: write_ply(p, table(), count=10**12), "number of vertices"),
    "empty": (lambda p: write_ply(p, table(), count=0), "number of vertices"),
    "odd header line": (lambda p: write_ply(p, table(), extra="element vertex -3\n"), "line of the PLY header"),
    "lists first": (
        lambda p: write_ply(p, table(), extra="element face 2\nproperty list uchar int vertex_indices\n"),
        "follow lists",
    ),
    "no opacity": (lambda p: write_ply(p, {n: v for n, v in table().items() if n != "opacity"}), r"no \['opacity'\]"),
    "odd harmonics": (
        lambda p: write_ply(p, {n: v for n, v in table().items() if n != "f_rest_7"}),
        "no known degree",
    ),
    "colour not finite": (lambda p: write_ply(p, {**table(), "f_rest_3": np.full(200, np.inf, np.float32)}), "colours"),
    "not finite": (lambda p: write_ply(p, {**table(), "y": np.full(200, np.nan, np.float32)}), "200 of 200"),
    "no rotation": (
        lambda p: write_ply(p, {**table(), **{f"rot_{k}": np.zeros(200, np.float32) for k in range(4)}}),
        "without a rotation",
    ),
    "words for numbers": (
        lambda p: p.write_bytes(write_ply(p, table(), "ascii").read_bytes().replace(b"0.1", b"zero")),
        "vertex of the PLY file",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_files_get_one_clear_sentence(tmp_path, kind):
    make, message = BROKEN[kind]
    path = tmp_path / "broken.ply"
    make(path)
    with pytest.raises(SceneError, match=message) as error:
        read_splats(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(SceneError, match="no such file"):
        read_splats(tmp_path / "nothing.ply")
