"""Several logs at once become demonstrations of one recording."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_logs import SCENE, messages, motion, write_bag, write_lerobot

import concent_warp as cw
from concent_warp.cli import main

MAP = """
[action.elbow]
source = "/arm/commands/data/0"
[action.grip]
source = "/arm/commands/data/1"
[measured."*_position"]
source = "/joint_states/position/*"
"""
FILES: dict[str, Any] = {"model": "robot.xml", "mapping": "robot.toml"}


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.xml").write_text(SCENE)
    (tmp_path / "robot.toml").write_text(MAP)
    (tmp_path / "bags").mkdir()
    made = messages(motion())
    for name, kind in (("b", "mcap"), ("a", "sqlite3")):
        write_bag(tmp_path / "bags" / name, made, kind)
    return tmp_path


def test_a_folder_of_bags_is_read_in_the_order_of_names(place):
    (place / "bags" / "notes").mkdir()
    (place / "bags" / "readme.txt").write_text("two pushes")
    shares = []
    found = cw.import_log("bags", **FILES, out="demo.h5", progress=shares.append)
    assert [one.name for one in found.demonstrations] == ["demo_0", "demo_1"]
    assert found.source == "bags/a and 1 more"
    single = [cw.import_log(f"bags/{name}", **FILES)[0] for name in "ab"]
    for one, alone in zip(found.demonstrations, single, strict=True):
        assert np.array_equal(one.measured["elbow_position"].value, alone.measured["elbow_position"].value)
        assert np.array_equal(one.action["grip"].time, alone.action["grip"].time)
    assert shares == sorted(shares)
    assert shares[-1] == 1
    assert len(cw.load_recording("demo.h5").demonstrations) == 2


def test_paths_are_read_in_the_order_given_and_episodes_are_counted_through(place):
    assert [d.duration for d in cw.import_log(["bags/b", "bags/a"], **FILES).demonstrations]
    for name, count in (("one", 2), ("two", 1)):
        write_lerobot(place / name, count)
    (place / "robot.toml").write_text(
        """
        [action."*"]
        source = "action/*.pos"
        unit = "deg"
        [action.grip]
        source = "action/grip.pos"
        unit = "percent"
        [measured.elbow_position]
        source = "observation.state/elbow.pos"
        unit = "deg"
        """
    )
    found = cw.import_log([place / "two", place / "one"], **FILES)
    assert [one.name for one in found.demonstrations] == ["demo_0", "demo_1", "demo_2"]
    assert [len(one.action["elbow"].time) for one in found.demonstrations] == [100, 100, 110]
    with pytest.raises(cw.RecordingError, match="episodes are of one log; found 2 logs"):
        cw.import_log(["one", "two"], cfg=cw.ImportCfg(episodes=(0,)), **FILES)


def test_the_command_takes_several_and_refuses_what_makes_no_sense(place, capsys):
    options = ["--model", "robot.xml", "--map", "robot.toml"]
    assert main(["import", "bags/a", "bags/b", *options, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "demo_0" in shown
    assert "demo_1" in shown
    assert main(["import", "bags", *options, "-o", "demo.h5"]) == 0
    assert "demo_1: 3.0 s, 2 commands" in capsys.readouterr().out
    assert main(["import", "bags", *options[:2], "--map", "new.toml", "--suggest"]) == 0
    assert "# Map from a (" in (place / "new.toml").read_text()
    capsys.readouterr()
    for line, sentence in (
        (["bags/a", "bags/../bags/a", *options], "a log is named twice"),
        (["bags/a", "bags/c", *options], "bags/c: no such log"),
        (options, "no log is named"),
        (["bags/a", "--map", "robot.toml"], "a log needs a scene; add --model robot.xml"),
        (["bags/a", "--model", "robot.xml"], "a log needs a map; add --map robot.toml"),
        (["bags/notes", *options], "bags/notes: no such log"),
    ):
        assert main(["import", *line, "-o", "other.h5"]) == 2
        assert sentence in capsys.readouterr().err
    assert main(["import", "bags/a", "--suggest"]) == 2
    assert "--suggest needs a scene and a file for the map" in capsys.readouterr().err
    assert not (place / "other.h5").exists()
