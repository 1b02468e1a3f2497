"""Model files whose numbers make no sense, or which are no model files at all."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.bad_input.sound_inputs import write_recording_and_model
from concent_warp.errors import ConcentError, ModelError
from concent_warp.model import ContactParameters, Model
from concent_warp.recording.formats.bam import read_bam

EFFECT = '\n[[effect]]\nname = "joint_friction"\ntarget = ["elbow"]\nvalues = [{}]\nintervals = [{}]\n'


@pytest.fixture
def model(tmp_path) -> Path:
    return write_recording_and_model(tmp_path)[1]


def test_contact_parameters_are_written_only_where_they_apply(model, tmp_path):
    spheres = Model.load(model)
    stiff = ContactParameters(solref=(0.004, 1.2))
    bare = spheres.with_geometry(None)
    for one, written in (
        (spheres, True), (bare, False), (replace(bare, contact=stiff), True), (replace(spheres, contact=stiff), True),
    ):  # fmt: skip
        one.save(tmp_path / "again.toml")
        assert ("[contact]" in (tmp_path / "again.toml").read_text()) is written
        assert Model.load(tmp_path / "again.toml").contact == one.contact


def refusal(path: Path) -> str:
    with pytest.raises(ConcentError) as caught:
        Model.load(path)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 2500
    return message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.005", "nan", "[contact] solref is not right; expected 2 finite numbers"),
        ("0.005", "inf", "[contact] solref is not right"),
        ("0.005", "-0.005", "solref is not right; expected a time constant and a damping ratio above 0"),
        ("0.95", "-inf", "[contact] solimp is not right"),
        ("0.95", "0.5", "impedance at zero depth <= impedance at full depth"),
        ("0.95", "1.5", "solimp is not right"),
        ("0.001", "-0.001", "solimp is not right"),
        ("condim = 4", "condim = 5", "condim is not right"),
        ("condim = 4", "condim = 4.0", "condim is not right"),
        ("condim = 4", "condim = true", "condim is not right"),
        ("condim = 4", f"condim = {'4' * 5000}", "not a TOML file"),
        ("condim = 4", f"condim = {'4' * 400}", "condim is not right"),
        ("0.005", "4" * 400, "solref is not right"),
        ("condim = 4", f"condim = {'[' * 100_000}", "brackets too deep"),
        ("condim = 4", f"condim = {'{a=' * 50_000}", "brackets too deep"),
        ("[contact]", "contact = 3\n[other]", "unknown entries"),
        ('geometry = "model.geometry.npz"', "geometry = 3", "the geometry has no file name"),
        ('geometry = "model.geometry.npz"', 'geometry = "/dev/zero"', "the contact geometry is missing"),
        ('scene = "model.scene.xml"', 'scene = "\\u001b[31m.xml"', "\\x1b[31m.xml: no such MJCF file"),
    ],
)
def test_a_senseless_model_file_is_refused(model, old, new, message):
    text = model.read_text()
    assert old in text
    model.write_text(text.replace(old, new, 1))
    assert message in refusal(model)


@pytest.mark.parametrize(
    ("value", "interval", "message"),
    [
        ("nan", "", "values and intervals are not right"),
        ("-1.0", "", "out of bounds"),
        ("inf", "", "out of bounds"),
        ("0.1", "[0.2, 0.1]", "effect 0: an interval is reversed; expected its lower end first, found [0.2, 0.1]"),
        ("0.1", "[nan, 0.1]", "values and intervals are not right"),
        ("0.1", f"[0.1, {'9' * 400}]", "values and intervals are not right"),
    ],
)
def test_senseless_effects_are_refused(model, value, interval, message):
    model.write_text(model.read_text() + EFFECT.format(value, interval))
    assert message in refusal(model)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("mass", np.array([0.03, -0.03]), "a mass is negative; expected >= 0 kg, found -0.03 at sphere 1"),
        (
            "radius",
            np.array([0.01, 1e300]),
            "radius is too large; expected at most 1000, found 1e+300; check the units",
        ),
        ("position", np.full((2, 3), -1e300), "position is too large; expected at most 1000, found 1e+300"),
        ("friction", np.array([-0.5, 0.5]), "a friction is negative; expected >= 0, found -0.5 at sphere 0"),
        ("radius", np.array([0.01, np.nan]), "radius holds values that are not finite"),
        ("radius", np.array(0.01), "wrong shape of body; expected (-1,)"),
        ("radius", np.array(["a", "b"]), "wrong kind of radius; expected numbers, found <U1"),
        ("radius", np.array([1, 2], dtype=complex), "expected numbers and text, found radius of complex128"),
        ("radius", np.array([(1, 2)], dtype=[("a", "f8"), ("b", "f8")]), "expected numbers and text"),
        ("radius", np.array([1, 2], dtype="M8[s]"), "expected numbers and text"),
        ("body", np.array([0.0, 0.0]), "wrong kind of body; expected whole numbers"),
        ("body", np.array([0, 7]), "names a body that does not exist"),
        ("position", np.zeros((2, 2)), "wrong shape of position"),
        ("bodies", np.array([1, 2]), "expected names of bodies"),
        ("bodies", np.array("block"), "expected names of bodies"),
        ("bodies", np.array(["block", "block"]), "two bodies have the same name"),
        ("bodies", np.array(["bl\x1bock"]), "bl\\x1bock"),
    ],
)
def test_a_senseless_geometry_is_refused(model, name, value, message):
    path = model.with_name("model.geometry.npz")
    with np.load(path) as data:
        arrays = {**dict(data), name: value}
    np.savez(path, **arrays)
    assert message in refusal(model)


def test_a_geometry_without_spheres_is_refused(model):
    path = model.with_name("model.geometry.npz")
    with np.load(path) as data:
        arrays = {key: value if key == "bodies" else value[:0] for key, value in data.items()}
    np.savez(path, **arrays)
    assert "the contact geometry has no spheres" in refusal(model)


@pytest.mark.parametrize(
    ("declared", "written", "message"),
    [
        (40_000_000, 320_000_000, "too large; expected at most 268,435,456 bytes once unpacked, found 320,000"),
        (2 * 10**12, 16, "too large"),
        (2, 320_000_000, "too large"),
        (-2, 16, "not a contact geometry"),
        ("(", 16, "not a contact geometry"),
    ],
)
def test_a_geometry_that_unpacks_to_gigabytes_is_refused_before_it_is_read(model, declared, written, message):
    path = model.with_name("model.geometry.npz")
    with np.load(path) as data:
        arrays = dict(data)
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({declared},), }}".ljust(117) + "\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key, value in arrays.items():
            content = io.BytesIO()
            np.save(content, value)
            odd = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + bytes(written)
            archive.writestr(f"{key}.npy", odd if key == "radius" else content.getvalue())
    assert message in refusal(model)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x93NUMPY", b"time,angle\n"])
def test_what_is_no_archive_is_refused(model, content):
    model.with_name("model.geometry.npz").write_bytes(content)
    assert "not a contact geometry" in refusal(model)


def test_contact_parameters_are_checked_where_they_are_made():
    with pytest.raises(ModelError, match="not finite"):
        ContactParameters(solref=(float("nan"), 1.0))
    assert ContactParameters(solref=(-1000.0, -10.0)).solref == (-1000.0, -10.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "brackets too deep"),
        ('{"a":' * 100_000, "brackets too deep"),
        (f'{{"mass": {"9" * 5000}}}', "not a JSON file"),
        (f'{{"mass": {"9" * 400}, "entries": [1, 2]}}', "mass of the set-up is not right"),
        ('{"mass": NaN, "entries": [1, 2]}', "mass of the set-up is not right"),
        ("\x00", "not a JSON file"),
        ("7", "not a log of a servo"),
    ],
)
def test_hostile_json_is_refused(tmp_path, text, message):
    (tmp_path / "log.json").write_text(text)
    with pytest.raises(ConcentError, match=message) as caught:
        read_bam(tmp_path / "log.json")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 2500
