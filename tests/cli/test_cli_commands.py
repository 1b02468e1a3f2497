import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.cli import main
from concent_warp.comparison.initial_states import with_initial_states
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.examples import example
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording


def test_record_writes_a_recording_of_every_seed(tmp_path):
    path = tmp_path / "made" / "demo.h5"
    assert main(["record", "--out", str(path), "--seeds", "3", "--reality.expert.speed", "2"]) == 0
    recording = load_recording(path)
    assert [d.name for d in recording.demonstrations] == ["demo_0"]
    assert recording[0].duration < 6


def test_geometry_exports_a_scene_that_plain_mujoco_loads(bench, tmp_path):
    assert main(["geometry", str(bench / "inset.toml"), "--export", str(tmp_path / "m.xml")]) == 0
    exported = mujoco.MjModel.from_xml_path(str(tmp_path / "m.xml"))
    model = Model.load(bench / "inset.toml")
    assert model.geometry is not None
    assert exported.ngeom == model.scene.model.ngeom + len(model.geometry)


def test_geometry_adds_an_object_from_a_mesh(bench, tmp_path):
    import trimesh

    trimesh.creation.box(extents=(40, 40, 60)).export(tmp_path / "peg.stl")
    out = tmp_path / "peg.toml"
    arguments = ["--add", "peg", str(tmp_path / "peg.stl"), "--scale", "0.001", "--objects", "peg", "--count", "30"]
    assert main(["geometry", str(bench / "demo.h5"), *arguments, "--out", str(out)]) == 0
    model = Model.load(out)
    assert model.geometry is not None
    assert model.geometry.bodies == ("peg",)
    assert len(model.geometry) == 30


def test_replay_writes_a_file_for_each_demonstration(bench, tmp_path):
    arguments = ["replay", str(bench / "demo.h5"), "--model", str(bench / "inset.toml"), "--out"]
    assert main([*arguments, str(tmp_path / "r.npz")]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r_demo_0.npz", "r_demo_1.npz"]
    assert main([*arguments, str(tmp_path / "one.npz"), "--demonstrations", "demo_1"]) == 0
    with np.load(tmp_path / "one.npz", allow_pickle=False) as one, np.load(tmp_path / "r_demo_1.npz") as two:
        assert np.array_equal(one["qpos"], two["qpos"])
        assert "sensor/block_position" in one


def test_replay_starts_where_compare_does_and_says_so(bench, tmp_path, capsys):
    recording = load_recording(bench / "demo.h5").only(["demo_0"])
    model, moved = Model.load(bench / "inset.toml"), tmp_path / "moved.h5"
    (d,) = recording.demonstrations
    unstated = replace(recording, demonstrations=(replace(d, qpos=None, qvel=None),))
    write_hdf5(unstated, moved)
    for path, fitted in ((moved, True), (bench / "demo.h5", False)):
        out = tmp_path / f"{path.stem}.npz"
        arguments = ["replay", str(path), "--model", str(bench / "inset.toml"), "--demonstrations", "demo_0"]
        assert main([*arguments, "--out", str(out)]) == 0
        assert ("initial state fitted to the first readings: demo_0" in capsys.readouterr().out) == fitted
        (started,) = with_initial_states(model, load_recording(path).only(["demo_0"])).demonstrations
        with np.load(out, allow_pickle=False) as saved:
            for name, value in (("qpos", started.qpos), ("qvel", started.qvel)):
                assert value is not None
                np.testing.assert_array_equal(saved[name].reshape(-1, len(value))[0], value)


def test_events_writes_the_sequence_and_its_picture(bench, tmp_path, capsys):
    arguments = ["--model", str(bench / "inset.toml"), "--out", str(tmp_path), "--demonstrations", "demo_0"]
    assert main(["events", str(bench / "demo.h5"), *arguments]) == 0
    sequence = ContactEventSequence.load(tmp_path / "events.json")
    assert (tmp_path / "schedule.png").stat().st_size > 5000
    assert sequence.stages[0].name in capsys.readouterr().out


def test_compare_prints_one_json_object_and_nothing_else(bench, capsys):
    models = ["--model", str(bench / "inset.toml"), "--baseline", str(bench / "surface.toml")]
    assert main(["compare", str(bench / "demo.h5"), *models, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["models"] == ["baseline", "model"]
    assert document["headline"]["channel"] == "block_position"
    assert document["headline"]["difference"]["verdict"] in ("fallen", "risen", "unclear")
    assert document["phases"]["demo_0"][0]["name"] == "free"


def test_compare_shows_a_table_and_writes_a_report(bench, tmp_path, capsys):
    html = tmp_path / "r.html"
    arguments = ["compare", str(bench / "demo.h5"), "--model", str(bench / "inset.toml"), "--html", str(html)]
    assert main([*arguments, "--markdown", "--phases", "none"]) == 0
    out = capsys.readouterr().out
    assert "| block_position | all |" in out
    assert "mean baseline" not in out
    assert "block_position" in html.read_text()
    assert main(arguments) == 2
    assert "the file exists" in capsys.readouterr().err
    assert main([*arguments, "--overwrite"]) == 0


def test_compare_names_the_worst_places(bench, capsys):
    arguments = ["compare", str(bench / "demo.h5"), "--model", str(bench / "surface.toml")]
    assert main([*arguments, "--places", "2"]) == 0
    out = capsys.readouterr().out
    assert "\n1. " in out
    assert "\n3. " not in out
    assert " x noise (" in out
    assert main([*arguments, "--markdown", "--places", "0"]) == 0
    assert "\n1. " not in capsys.readouterr().out


def test_compare_takes_the_scene_of_the_recording_by_default(bench, capsys):
    assert main(["compare", str(bench / "demo.h5")]) == 0
    out = capsys.readouterr().out
    assert "noise: as stated" in out
    assert "Nowhere above 3 x noise." in out


@pytest.mark.parametrize("command", ["replay", "events"])
def test_files_are_not_overwritten_unasked(command, bench, tmp_path, capsys):
    out = tmp_path / "r.npz" if command == "replay" else tmp_path
    arguments = [command, str(bench / "demo.h5"), "--model", str(bench / "inset.toml"), "--out", str(out)]
    assert main(arguments) == 0
    capsys.readouterr()
    assert main(arguments) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*arguments, "--overwrite"]) == 0


@pytest.mark.parametrize(
    "command",
    [
        ["compare", "--model"],
        ["compare", "--baseline"],
        ["events", "--model"],
        ["replay", "--model"],
        ["fit", "--model"],
        ["diagnose", "--model"],
        ["locate", "--model"],
        ["add", "joint_friction", "--out", "more.toml", "--fit"],
    ],
    ids=" ".join,
)
def test_a_model_of_another_robot_is_called_that(bench, tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    other = tmp_path / "other.xml"
    other.write_text(
        "<mujoco><worldbody><body><joint name='hinge'/><geom size='.1'/></body></worldbody>"
        "<actuator><motor name='motor' joint='hinge'/></actuator></mujoco>"
    )
    recording = str(bench / "demo.h5")
    given = [*command, recording, "--model", str(other)] if command[0] == "add" else [command[0], recording, command[1]]
    assert main(given if command[0] == "add" else [*given, str(other)]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "of another robot or scene" in error
    assert "expected actuators ['motor'] as in the model, found ['drive'] in the recording" in error
    assert [p.name for p in tmp_path.iterdir()] == ["other.xml"]


def test_a_model_with_more_bodies_than_were_recorded_is_refused(bench, tmp_path, capsys):
    model = Model.load(bench / "inset.toml")
    more = tmp_path / "more.xml"
    text = model.scene.xml.replace("</worldbody>", "<body><freejoint/><geom size='.1'/></body></worldbody>")
    more.write_text(text)
    assert main(["compare", str(bench / "demo.h5"), "--model", str(more)]) == 2
    assert "15 positions in the state as in the model, found 8 in the recording" in " ".join(
        capsys.readouterr().err.split()
    )


@pytest.mark.parametrize(
    "line",
    [
        "compare demo.h5 --model inset.toml --baseline surface.toml --every-phase",
        "compare demo.h5 --model inset.toml",
        "add --list",
        "add --list --model inset.toml",
        "add joint_damping --model inset.toml --fit demo.h5 --demonstrations demo_0 -o {out}/damped.toml",
        "diagnose {servo} --effects joint_friction joint_damping --jobs 1",
    ],
)
def test_tables_fit_80_columns(line, bench, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(bench)
    monkeypatch.delenv("COLUMNS", raising=False)
    assert main(line.format(out=tmp_path, servo=example("servo")).split()) == 0
    rows = [row for row in capsys.readouterr().out.splitlines() if set(row) & set("│┃━─")]
    assert rows
    assert max(map(len, rows)) <= 80


@pytest.mark.parametrize("option", ["--robot.tcp-site", "--robot.gripper-actuators"])
def test_record_refuses_names_of_a_robot_that_is_not_given(tmp_path, monkeypatch, capsys, option):
    monkeypatch.chdir(tmp_path)
    assert main(["record", option, "gone"]) == 2
    assert "are given without the robot; add --robot" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
