import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from concent_warp.cli import main
from concent_warp.diagnosis.suggestion.search import Search
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from tests.diagnosis.suggestion.carts import one_speed, open_group

QUICK = ["--method", "menu", "--duration", "3"]


@pytest.fixture(scope="module")
def cart(tmp_path_factory):
    """A folder with a recording of a cart with friction, and diagnoses that leave something open and nothing."""
    folder = tmp_path_factory.mktemp("cart")
    recording = one_speed(friction=0.2)
    write_hdf5(recording, folder / "demo.h5")
    (folder / "scene.xml").write_text(recording.scene)
    (folder / "found.json").write_text(json.dumps(open_group()))
    (folder / "known.json").write_text(json.dumps(open_group(verdict="effect", groups=[["joint_friction"]])))
    return folder


@pytest.fixture
def suggest(cart, tmp_path, monkeypatch):
    """Run the command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments, diagnosis="found.json"):
        return main(["suggest", str(cart / "demo.h5"), "--diagnosis", str(cart / diagnosis), *QUICK, *arguments])

    return run


def test_it_writes_the_motion_its_commands_and_its_page(suggest, capsys):
    assert suggest("-o", "motion.h5") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Open: joint_friction or joint_damping." in said
    assert "wrote motion.html" in said
    assert sorted(path.name for path in Path().iterdir()) == ["motion.csv", "motion.h5", "motion.html"]
    motion = load_recording(Path("motion.h5"))[0]
    with Path("motion.csv").open() as file:
        assert next(csv.reader(file)) == ["time", "drive"]
    assert motion.duration <= 3.0 + 1e-9
    page = Path("motion.html").read_text()
    assert "[[table]]" not in page
    assert "joint_damping" in page
    assert suggest("-o", "motion.h5") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert suggest("-o", "motion.h5", "--overwrite") == 0


def test_nothing_to_suggest_has_an_exit_status_of_its_own(suggest, capsys):
    assert suggest("-o", "motion.h5", diagnosis="known.json") == 3
    assert "there is nothing to suggest" in " ".join(capsys.readouterr().out.split())
    assert list(Path().iterdir()) == []


def test_json_is_one_object(suggest, capsys):
    assert suggest("-o", "motion.h5", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["found"]
    assert found["hypotheses"] == ["joint_friction", "joint_damping"]
    assert {"true", "other", "evidence", "separation", "channel", "resolved"} == set(found["pairs"][0])


def test_an_interruption_says_how_to_go_on(suggest, monkeypatch, capsys):
    rate, calls = Search._rated, []

    def stopped(self, candidates, *, starts):
        if calls:
            raise KeyboardInterrupt
        calls.append(len(candidates))
        return rate(self, candidates, starts=starts)

    monkeypatch.setattr(Search, "_rated", stopped)
    small = ["-o", "motion.h5", "--population", "4"]
    assert suggest(*small) == 130
    assert "--resume" in capsys.readouterr().err
    monkeypatch.setattr(Search, "_rated", rate)
    assert suggest(*small) == 2
    assert "was interrupted" in capsys.readouterr().err
    assert suggest(*small, "--resume") == 0
    assert sorted(path.name for path in Path().iterdir()) == ["motion.csv", "motion.h5", "motion.html"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "motion.csv"], "the motion file has another suffix"),
        (["--limits.workspace", "1", "2"], "the workspace is no box"),
        (["--diagnosis", "gone.json"], "gone.json"),
        (["--max-interval", "0"], "--max-interval is out of bounds"),
    ],
)
def test_bad_input_is_one_sentence(suggest, capsys, arguments, words):
    assert suggest(*arguments) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not list(Path().glob("*"))


def test_reality_performs_a_motion_and_both_recordings_are_diagnosed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rig = ["record", "--rig", "pendulum", "--hide", "joint_friction=0.04"]
    assert main([*rig, "--longest", "1.2", "-o", "demo.h5"]) == 0
    recording = load_recording(Path("demo.h5"))
    assert recording[0].duration <= 1.2
    still = {"qpos": np.zeros(1), "qvel": np.zeros(1)}
    write_hdf5(replace(recording, demonstrations=(replace(recording[0], **still),)), "motion.h5")
    assert main([*rig, "--motion", "motion.h5", "-o", "extra.h5"]) == 0
    capsys.readouterr()
    few = ["--effects", "joint_friction", "--jobs", "1", "--json"]
    assert main(["diagnose", "demo.h5", "extra.h5", *few]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "effect"


def test_hidden_effects_of_reality_are_checked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for more, words in (
        (["--hide", "magic=1"], "no effect 'magic' can be hidden"),
        (["--hide", "joint_friction"], "a hidden effect is not right"),
        (["--rig", "pendulum", "--task", "stacking"], "a rig has no task"),
        (["--rig", "insertion", "--motion", "gone.h5"], "no such recording"),
    ):
        assert main(["record", *more, "-o", "demo.h5"]) == 2
        assert words in " ".join(capsys.readouterr().err.split())
    assert not Path("demo.h5").exists()
