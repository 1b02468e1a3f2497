import json
import shlex
import tomllib
from dataclasses import replace

import pytest

from concent_warp.cli import main
from concent_warp.errors import ConcentError
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.fit.geometry.search import Search
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import run_folder

SMALL = ["--count", "60", "--radius", "0.008", "--fit.generations", "3", "--fit.evolution.population", "4"]


def fit(bench, folder, *more):
    return main(["fit", str(bench / "demo.h5"), "--out", str(folder), "--demonstrations", "demo_0", *SMALL, *more])


@pytest.fixture(scope="module")
def run(bench, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit") / "run"
    assert fit(bench, folder) == 0
    return folder


def test_a_run_folder_holds_models_events_comparison_and_report(run):
    start, model = Model.load(run / "start.toml"), Model.load(run / "model.toml")
    assert start.geometry is not None
    assert model.geometry is not None
    assert len(start.geometry) == len(model.geometry) == 60
    for name in ("demo_0", "demo_1"):
        ContactEventSequence.load(run / f"events_{name}.json")
        assert (run / f"schedule_{name}.png").is_file()
    comparison = json.loads((run / "comparison.json").read_text())
    assert comparison["models"] == ["before", "no contact", "after"]
    assert comparison["fitted"] == ["demo_0"]
    assert len(json.loads((run / "history.json").read_text())["generations"]) == 3
    assert "not seen" in (run / "report.html").read_text()
    assert not [p for p in run.iterdir() if "partial" in p.name]


def test_the_resolved_settings_are_beside_the_results(run):
    document = tomllib.loads((run / "settings.toml").read_text())
    assert document["settings"]["fit"]["generations"] == 3
    assert document["settings"]["fit"]["evolution"]["population"] == 4
    assert document["settings"]["geometry"]["count"] == 60
    assert document["settings"]["demonstrations"] == ["demo_0"]
    assert {"concent-warp", "mujoco", "python"} <= set(document["versions"])


def test_gradients_are_tried_and_it_is_reported_whether_they_helped(bench, tmp_path, capsys):
    more = ("--method", "gradient+es", "--fit.gradient.starts", "2", "--fit.gradient.iterations", "3")
    assert fit(bench, tmp_path / "run", *more, "--fit.generations", "1") == 0
    found = json.loads((tmp_path / "run" / "history.json").read_text())
    assert found["gradients"]["remark"][:40] in capsys.readouterr().out
    assert ("gradients helped" in found["gradients"]["remark"]) == found["gradients"]["helped"]
    assert found["generations"][-1]["generation"] == 1
    assert (tmp_path / "run" / "checkpoint.descent.npz").is_file()


def test_a_run_is_not_overwritten_unasked(bench, run, capsys):
    before = (run / "model.toml").stat().st_mtime_ns
    assert fit(bench, run) == 2
    assert "--overwrite or --resume" in capsys.readouterr().err
    assert (run / "model.toml").stat().st_mtime_ns == before


def test_a_folder_with_other_things_is_left_alone_even_with_overwrite(bench, tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert fit(bench, tmp_path, "--overwrite") == 2
    assert "other things than a run" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_run_is_not_resumed_with_other_settings_and_stays_as_it_is(bench, run, capsys):
    before = {path.name: path.stat().st_mtime_ns for path in run.iterdir()}
    assert fit(bench, run, "--resume", "--fit.generations", "4", "--fit.seed", "1") == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "expected fit.generations 3, fit.seed 0, found fit.generations 4, fit.seed 1" in error
    assert "--fit.generations 3" in error
    assert {path.name: path.stat().st_mtime_ns for path in run.iterdir()} == before
    assert fit(bench, run, "--resume", "--engine", "mujoco") == 0


def test_a_run_killed_while_it_wrote_its_settings_can_go_on(tmp_path):
    (tmp_path / ".settings.toml.partial").write_text("comm")
    with run_folder(tmp_path, overwrite=False, resume=True):
        pass
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ConcentError, match="other things"), run_folder(tmp_path, overwrite=False, resume=True):
        pass


def test_an_interrupted_fit_says_how_to_go_on_and_then_ends_as_if_it_had_not_been(
    bench, run, tmp_path, monkeypatch, capsys
):
    folder = tmp_path / "run"
    whole_step = Search.step

    def step(self):
        if self.evolution.generation == 2:
            raise KeyboardInterrupt
        whole_step(self)

    monkeypatch.setattr(Search, "step", step)
    assert fit(bench, folder, "--overwrite") == 130
    error = capsys.readouterr().err
    assert "The state is saved" in error
    again = shlex.split(error.rsplit("continue with: concent ")[1])
    assert not (folder / "model.toml").exists()
    monkeypatch.undo()
    assert main(again) == 0
    name = "model.geometry.npz"
    assert (folder / name).read_bytes() == (run / name).read_bytes()


def test_a_run_that_cannot_start_leaves_no_folder(bench, tmp_path, capsys):
    recording = load_recording(bench / "demo.h5")
    blind = replace(recording[0], measured={"rail": recording[0].measured["rail"]})
    write_hdf5(replace(recording, demonstrations=(blind,)), tmp_path / "blind.h5")
    folder = tmp_path / "run"
    assert main(["fit", str(tmp_path / "blind.h5"), "--out", str(folder), *SMALL]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not folder.exists()


def test_a_start_from_a_saved_model_keeps_its_spheres(bench, tmp_path):
    folder = tmp_path / "run"
    assert fit(bench, folder, "--model", str(bench / "surface.toml"), "--fit.generations", "1") == 0
    saved, start = Model.load(bench / "surface.toml"), Model.load(folder / "start.toml")
    assert saved.geometry is not None
    assert start.geometry is not None
    assert (saved.geometry.position == start.geometry.position).all()


def test_the_demo_goes_from_recording_to_report(tmp_path, capsys):
    folder = tmp_path / "demo"
    small = ["--seeds", "0", "--unseen-seeds", "--count", "96", "--fit.generations", "1"]
    more = ["--fit.evolution.population", "2", "--reality.expert.speed", "1.5"]
    assert main(["demo", "--out", str(folder), *small, *more]) == 0
    out = capsys.readouterr().out
    assert "block_position [mm]" in out
    assert str(folder / "report.html") in out.replace("\n", "")
    overlap = json.loads((folder / "comparison.json").read_text())["contact_overlap"]
    assert 0 <= overlap["after"]["demo_0"] <= 1
    assert (folder / "demo.h5").is_file()
