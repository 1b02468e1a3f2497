import pytest

from concent_warp.cli import main
from concent_warp.effects.registry import effect_classes
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Recording
from tests.cli.conftest import XML
from tests.scenes.swinging import DAMPING, swung


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """A folder with a recording of a pendulum and its drawing, which lacks a damping."""
    folder = tmp_path_factory.mktemp("swing")
    recording = swung(seconds=1.0)
    write_hdf5(recording, folder / "demo.h5")
    (folder / "scene.xml").write_text(recording.scene)
    return folder


def add(folder, *arguments):
    return main(["add", *arguments, "--model", str(folder / "scene.xml")])


def test_an_effect_is_added_where_it_may_act_at_its_null_value(swing, tmp_path, capsys):
    assert add(swing, "joint_damping", "-o", str(tmp_path / "m.toml")) == 0
    (added,) = Model.load(tmp_path / "m.toml").effects
    assert (added.effect.name, added.effect.target, added.values) == ("joint_damping", ("hinge",), (0.0,))
    assert "joint_damping: damping[hinge] 0" in capsys.readouterr().out


def test_values_are_set_by_name(swing, tmp_path):
    out = str(tmp_path / "m.toml")
    assert add(swing, "joint_friction", "--target", "hinge", "--set", "torque[hinge]=0.1", "-o", out) == 0
    assert Model.load(tmp_path / "m.toml").effects[0].values == (0.1,)


def test_a_fit_finds_the_value_and_says_how_far_the_error_falls(swing, tmp_path, capsys):
    out = str(tmp_path / "m.toml")
    assert add(swing, "joint_damping", "--fit", str(swing / "demo.h5"), "-o", out) == 0
    (added,) = Model.load(tmp_path / "m.toml").effects
    assert added.values[0] == pytest.approx(DAMPING, rel=0.05)
    ((low, high),) = added.intervals
    assert low < DAMPING < high
    said = capsys.readouterr().out
    assert "damping[hinge]" in said
    assert "N m s/rad" in said
    assert "x noise" in said


def test_effects_that_the_model_has_are_fitted_along(swing, tmp_path):
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    assert add(swing, "joint_damping", "-o", str(first)) == 0
    more = ["--model", str(first), "--fit", str(swing / "demo.h5"), "-o", str(second)]
    assert main(["add", "armature", *more]) == 0
    damping, armature = Model.load(second).effects
    assert damping.values[0] == pytest.approx(DAMPING, rel=0.05)
    assert armature.intervals[0][0] <= 1e-4


def test_by_default_each_selection_gets_the_effect(tmp_path):
    (tmp_path / "scene.xml").write_text(XML)
    assert add(tmp_path, "sensor_bias", "-o", str(tmp_path / "m.toml")) == 0
    targets = [a.effect.target for a in Model.load(tmp_path / "m.toml").effects]
    assert len(targets) == len(set(targets)) > 0
    assert ("rail",) in targets


def test_the_list_has_every_effect_with_units_and_with_a_model_where_each_may_act(swing, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "240")
    assert main(["add", "--list"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in effect_classes())
    assert "N m s/rad" in listed
    assert main(["add", "--list", "--model", str(swing / "scene.xml")]) == 0
    there = capsys.readouterr().out
    assert "may act on" in there
    assert "nothing here" in there


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["joint_frictoin"], "did you mean 'joint_friction'"),
        (["joint_friction", "--target", "servo"], "joints among ['hinge']"),
        (["joint_friction", "--set", "torque=0.1"], "did you mean 'torque[hinge]'"),
        (["joint_friction", "--set", "torque[hinge]"], "expected name=value"),
        (["joint_friction", "--set", "torque[hinge]=much"], "expected name=value"),
        (["joint_friction", "--set", "torque[hinge]=-1"], "out of bounds"),
        (["sliding_friction"], "nothing for sliding_friction to act on"),
        (["joint_friction", "--fit", "nowhere.h5"], "no such recording"),
        ([], "EFFECT is missing"),
    ],
)
def test_what_is_wrong_is_reported_in_one_sentence_and_nothing_is_written(arguments, words, swing, tmp_path, capsys):
    assert add(swing, *arguments, "-o", str(tmp_path / "m.toml")) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_model_is_not_overwritten_unasked_and_has_to_be_named(swing, tmp_path, capsys):
    out = tmp_path / "m.toml"
    assert add(swing, "joint_damping", "-o", str(out)) == 0
    assert add(swing, "joint_damping", "-o", str(out)) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert add(swing, "joint_damping", "-o", str(out), "--overwrite") == 0
    assert add(swing, "joint_damping") == 2
    assert add(swing, "joint_damping", "-o", str(tmp_path / "m.xml")) == 2
    assert main(["add", "joint_damping", "--model", str(out), "-o", str(tmp_path / "n.toml")]) == 2
    assert "already has joint_damping on a target" in capsys.readouterr().err


def test_a_recording_that_the_model_cannot_follow_is_an_error(swing, tmp_path, capsys):
    (d,) = swung(seconds=1.0).demonstrations
    d.measured["angle"].value[1:] = float("nan")
    write_hdf5(Recording(swung().scene, (d,)), tmp_path / "empty.h5")
    assert add(swing, "joint_damping", "--fit", str(tmp_path / "empty.h5"), "-o", str(tmp_path / "m.toml")) == 2
    assert "too little was measured" in capsys.readouterr().err
