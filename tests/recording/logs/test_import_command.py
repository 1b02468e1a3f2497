"""``concent import``: a map is proposed, shown, checked and used."""

from __future__ import annotations

import pytest
from made_logs import SCENE, messages, motion, write_bag

import concent_warp as cw
from concent_warp.cli import main


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "140")
    write_bag(tmp_path / "bag", messages(motion()), "mcap")
    (tmp_path / "robot.xml").write_text(SCENE)
    return tmp_path


COMMAND = ["import", "bag", "--model", "robot.xml", "--map", "robot.toml"]


def test_from_a_bag_to_a_recording(place, capsys):
    assert main([*COMMAND, "--suggest"]) == 0
    assert "2 guesses or gaps are marked" in capsys.readouterr().out
    assert main([*COMMAND, "--suggest"]) == 2
    assert "robot.toml" in capsys.readouterr().err
    path = place / "robot.toml"
    path.write_text(path.read_text().replace('# reference = "world"', 'reference = "world"'))
    assert main([*COMMAND, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "measured/elbow_position" in shown
    assert "-0.8 to 0.8 rad" in shown
    assert "-2.97 to 2.97" in shown
    assert "nothing is wrong" in shown
    assert not (place / "demo.h5").exists()
    assert main([*COMMAND, "-o", "demo.h5"]) == 0
    assert "demo_0: 3.0 s, 2 commands, 5 sensors, 1 cameras" in capsys.readouterr().out
    assert len(cw.load_recording("demo.h5")[0].measured) == 5
    assert main([*COMMAND, "-o", "demo.h5"]) == 2


def test_a_dry_run_lists_all_that_is_wrong(place, capsys):
    (place / "robot.toml").write_text(
        """
        [action.elbow]
        source = "/arm/commands/data/0"
        scale = 57.29578
        [measured.elbow_position]
        source = "/joint_states/position/shoulder"
        [measured.grip_position]
        source = "/joint_states/position/grip"
        """
    )
    assert main([*COMMAND, "--dry-run"]) == 2
    out, err = capsys.readouterr()
    assert "1. demo_0: robot.toml, [measured.elbow_position]: the log has no such channel" in out
    assert "2. demo_0: robot.toml, [action.elbow]: its values look like degrees" in out
    assert "3. demo_0: robot.toml: commands are missing" in out
    assert "not mapped:" in out
    assert "3 things are wrong" in err
    assert main([*COMMAND, "-o", "demo.h5"]) == 2
    assert "; 3 things are wrong, which concent import --dry-run lists." in capsys.readouterr().err
    assert not (place / "demo.h5").exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--suggest", "--dry-run"], "exclude one another"),
        ([], "no file to write is named"),
        (["-o", "demo.h5", "--episodes", "5-3"], "not a number of an episode"),
        (["-o", "demo.h5", "--episodes", "first"], "not a number of an episode"),
        (["-o", "demo.h5"], "no such map; check the path, or let concent import --suggest write one"),
    ],
)
def test_options_that_make_no_sense(place, capsys, options, sentence):
    assert main([*COMMAND, *options]) == 2
    assert sentence in capsys.readouterr().err
    assert list(place.glob("demo*")) == []
