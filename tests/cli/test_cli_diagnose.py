import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace

import h5py
import numpy as np
import pytest

from concent_warp.cli import main
from concent_warp.cli.commands.diagnose import _say_diagnosis
from concent_warp.cli.fitted_effects import time_left
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose as diagnosed
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Channel
from concent_warp.scene.scene import Scene
from tests.diagnosis.made_up import finding
from tests.scenes.swinging import DAMPING, NOISE, swing_scene, swung

FEW = ["--effects", "joint_damping", "armature", "--jobs", "1"]


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """A folder with a recording of a pendulum whose drawing lacks a damping, and one whose drawing lacks nothing."""
    folder = tmp_path_factory.mktemp("swing")
    write_hdf5(swung(seconds=1.0), folder / "demo.h5")
    write_hdf5(swung(seconds=1.0, damping=0.0), folder / "null.h5")
    (folder / "scene.xml").write_text(swing_scene())
    return folder


@pytest.fixture(scope="module")
def answer(swing) -> Diagnosis:
    """What the diagnosis of the recording of a pendulum comes to."""
    cfg = DiagnoseCfg(effects=("joint_damping", "armature"), jobs=1)
    recording = load_recording(swing / "demo.h5")
    return diagnosed(Model.from_recording(recording), recording, cfg)


def diagnose(path, *arguments):
    return main(["diagnose", str(path), *FEW, *arguments])


@pytest.fixture(scope="module")
def told(swing) -> tuple[str, str]:
    """What a diagnosis that saves the model as m.toml and a report as r.html prints, on both streams."""
    given = ["--model", str(swing / "scene.xml"), "--apply", str(swing / "new" / "m.toml")]
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert diagnose(swing / "demo.h5", *given, "--html", str(swing / "r.html")) == 0
    return out.getvalue(), err.getvalue()


def with_angle(path, channel):
    recording = swung(seconds=1.0)
    (d,) = recording.demonstrations
    measured = {} if channel is None else {"angle": channel}
    write_hdf5(replace(recording, demonstrations=(replace(d, measured=measured),)), path)
    return path


def change(path, end, where, value):
    """Overwrite some numbers in a recording file."""
    with h5py.File(path, "r+") as file:
        names = []
        file.visit(lambda name: names.append(name) if name.endswith(end) else None)
        file[names[0]][where] = value  # pyright: ignore[reportIndexIssue]


def angle():
    return swung(seconds=1.0).demonstrations[0].measured["angle"]


def test_the_verdict_is_reported_in_sentences_with_a_table(told):
    said, _ = told
    assert "An effect is missing, and the data identify it" in said
    assert "Missing: joint_damping (damping[hinge] 0.0" in said
    assert "Where the model as given fails" in said
    assert "accepted" in said


def test_json_is_one_object_and_nothing_else(swing, capsys):
    assert diagnose(swing / "demo.h5", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "effect"
    assert document["effects"][0]["name"] == "joint_damping"
    assert {"concent-warp", "mujoco", "python"} <= set(document["versions"])
    assert document["seed"] == 0


def test_apply_saves_the_model_with_what_was_accepted(swing, told, capsys):
    out = swing / "new" / "m.toml"
    (added,) = Model.load(out).effects
    assert added.effect.name == "joint_damping"
    ((low, high),) = added.intervals
    assert low < DAMPING < high
    assert str(out) in told[0]
    assert diagnose(swing / "demo.h5", "--apply", str(out)) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_where_nothing_is_missing_nothing_is_saved(swing, tmp_path, capsys):
    out = tmp_path / "m.toml"
    assert diagnose(swing / "null.h5", "--apply", str(out)) == 0
    said = capsys.readouterr().out
    assert "No discrepancy detected" in said
    assert "Smallest detectable sizes" in said
    assert "was not written" in said
    assert not out.exists()


def test_the_table_names_the_owners_of_parameters_and_shows_those_that_exclude_no_change(
    swing, answer, capsys, monkeypatch
):
    def three(*_, **__) -> Diagnosis:
        first = answer.effects[0]
        (p,) = first.parameters
        null = [replace(p, name=f"damping[{name}]", value=0.0, low=0.0) for name in ("shoulder", "elbow")]
        return replace(answer, effects=(replace(first, parameters=(*null, replace(p, name="damping[wrist]"))),))

    monkeypatch.setattr("concent_warp.cli.commands.diagnose.diagnose", three)
    assert diagnose(swing / "demo.h5") == 0
    table = capsys.readouterr().out.partition("held-out gain")[2]
    assert "damping[wrist] 0.0" in table
    assert "damping[shoulder] 0 " in table
    assert "damping[elbow]" not in table
    assert "1 more" in table


def test_effects_that_explain_too_little_are_named_and_not_saved(swing, answer, tmp_path, capsys, monkeypatch):
    out = tmp_path / "m.toml"

    def little(*_, **__) -> Diagnosis:
        return replace(answer, verdict="none_of_these", unexplained=0.9, explains=False)

    monkeypatch.setattr("concent_warp.cli.commands.diagnose.diagnose", little)
    assert diagnose(swing / "demo.h5", "--apply", str(out)) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Explains a part: joint_damping" in said
    assert "The effects above explain too little to be added: the model stays as given." in said
    assert f"The accepted effects explain too little: {out} was not written." in said
    assert not out.exists()
    assert diagnose(swing / "demo.h5", "--apply", str(out), "--json") == 0
    assert json.loads(capsys.readouterr().out)["effects"][0]["accepted"] is True
    assert not out.exists()


def test_where_nothing_explains_the_data_it_says_that_no_effect_was_accepted(
    swing, answer, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "m.toml"

    def none(*_, **__) -> Diagnosis:
        effects = tuple(replace(f, accepted=False, reason="no better than chance") for f in answer.effects)
        # As a search without an accepted effect ends where much more than noise is left.
        missing = replace(answer, verdict="none_of_these", unexplained=1.0, effects=effects, groups=())
        return replace(missing, models=answer.models[:1], ratio=answer.ratio[:1], explains=False)

    monkeypatch.setattr("concent_warp.cli.commands.diagnose.diagnose", none)
    assert diagnose(swing / "demo.h5", "--apply", str(out)) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"No effect was accepted: {out} was not written." in said
    assert "explain too little" not in said
    assert not out.exists()


@pytest.mark.usefixtures("told")
def test_a_report_shows_the_diagnosis_before_and_after(swing):
    page = (swing / "r.html").read_text()
    assert "What is missing" in page
    assert "joint damping" in page
    assert "before" in page


def test_an_interrupted_diagnosis_says_how_to_go_on_and_does(swing, tmp_path, capsys, monkeypatch):
    from concent_warp.diagnosis.candidates.fit_promising import CandidateFits

    finish = CandidateFits.fit

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(CandidateFits, "fit", interrupted)
    arguments = ["--out", str(tmp_path / "kept")]
    assert diagnose(swing / "demo.h5", *arguments) == 130
    error = capsys.readouterr().err
    assert f"continue with: concent diagnose {swing / 'demo.h5'}" in error
    assert "Traceback" not in error
    assert list((tmp_path / "kept").glob("*.npz"))
    monkeypatch.setattr(CandidateFits, "fit", finish)
    assert diagnose(swing / "demo.h5", *arguments) == 0
    assert "Missing: joint_damping" in capsys.readouterr().out


def test_without_a_checkpoint_an_interruption_says_what_would_have_helped(swing, capsys, monkeypatch):
    def interrupted(*_, **__) -> Diagnosis:
        raise KeyboardInterrupt

    monkeypatch.setattr("concent_warp.cli.commands.diagnose.diagnose", interrupted)
    assert diagnose(swing / "demo.h5") == 130
    assert "--out FOLDER" in capsys.readouterr().err


@pytest.mark.parametrize("case", ["nothing measured", "one sample", "all missing", "clock backwards"])
def test_recordings_that_have_no_information_are_an_error_of_one_line(case, tmp_path, capsys):
    path = tmp_path / "demo.h5"
    channel = angle()
    words = "too little was measured"
    if case == "nothing measured":
        with_angle(path, None)
    elif case == "one sample":
        with_angle(path, Channel(channel.time[:1], channel.value[:1], NOISE))
    elif case == "all missing":
        with_angle(path, channel)
        change(path, "angle/value", slice(None), np.nan)
        words = "every value is missing"
    else:
        with_angle(path, channel)
        change(path, "angle/time", 10, 0.0)
        words = "time does not increase"
    assert diagnose(path) == 2
    out, error = capsys.readouterr()
    lines = [line for line in error.splitlines() if not line.startswith("diagnosing: ")]
    assert words in lines[-1]
    assert len(lines) == 1
    assert "Traceback" not in out + error


def test_readings_that_are_all_noise_are_reported_to_be_and_no_effect_explains_them(tmp_path, capsys):
    channel = angle()
    noise = np.random.default_rng(2).normal(0, 1, channel.value.shape)
    path = with_angle(tmp_path / "demo.h5", Channel(channel.time, noise, NOISE))
    assert diagnose(path, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "none_of_these"
    assert document["unexplained"] > 0.5
    assert document["explains"] is (document["unexplained"] <= 0.8)
    assert document["issues"] == ["demo_0, angle: the readings scatter like noise, no motion shows in them."]


def test_a_model_that_diverges_is_an_error(swing, tmp_path, capsys):
    (tmp_path / "wild.xml").write_text(swing_scene().replace('damping="0.0"', 'stiffness="-1e8"'))
    assert diagnose(swing / "demo.h5", "--model", str(tmp_path / "wild.xml")) == 2
    assert "does not stay finite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--effects", "air_darg"], "did you mean 'air_drag'"),
        (["--effects", "sliding_friction"], "sliding_friction cannot be missing"),
        (["--demonstrations", "demo_7"], "no such demonstration"),
        (["--jobs", "0"], "--jobs is out of bounds; expected at least -1 and at most 4096, but not 0"),
        (["--window", "0"], "window"),
        (["--additions", "0"], "--additions is out of bounds; expected at least 1"),
        (["--gradient"], "build it with `concent geometry`; or diagnose without --gradient."),
    ],
)
def test_settings_that_make_no_sense_are_an_error_of_one_line(arguments, words, swing, capsys):
    assert main(["diagnose", str(swing / "demo.h5"), "--jobs", "1", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_a_first_ranking_is_printed_before_the_answer(told):
    _, said = told
    assert "diagnosing: first ranking, error expected to fall by: joint_damping " in said


def test_a_time_ends_the_diagnosis_with_what_is_open(swing, capsys):
    assert diagnose(swing / "demo.h5", "--seconds", "0.001") == 0
    said = capsys.readouterr().out
    assert "The time did not suffice for a verdict" in said
    assert "Open: whether any effect is missing." in said
    assert diagnose(swing / "demo.h5", "--seconds", "0.001", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "unsettled"
    assert "Open: whether any effect is missing." in document["unsettled"]
    assert diagnose(swing / "demo.h5", "--seconds", "0") == 2


def test_the_time_left_ends_with_the_time_given():
    assert time_left(0.5, 10.0, None) is None
    assert time_left(0.5, 10.0, 60.0) == 10.0
    assert time_left(0.1, 10.0, 60.0) == 50.0
    assert time_left(0.0, 10.0, 60.0) == 50.0
    assert time_left(0.5, 70.0, 60.0) == 0.0


@pytest.mark.parametrize(
    ("verdict", "said", "other"), [("unsettled", "best so far", "accepted"), ("effect", "accepted", "best so far")]
)
def test_what_was_accepted_is_only_the_best_so_far_under_an_unsettled_verdict(verdict, said, other, capsys):
    model = Model(Scene(swing_scene()))
    effects = (finding("joint_friction", 0.8),)
    _say_diagnosis(Diagnosis(verdict, effects, (), (), 0.0, (4.0, 1.0), (), None, (), (model, model)))
    out = capsys.readouterr().out
    assert f"joint_friction: {said}" in out
    assert f"joint_friction: {other}" not in out
