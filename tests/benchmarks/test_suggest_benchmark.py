"""The benchmark of suggested recordings: which data sets it has, what counts as right, and its page."""

from __future__ import annotations

import json

import pytest

from benchmarks.diagnose import suggest_report
from benchmarks.diagnose.suggest_report import METHODS, page, read_rows
from benchmarks.diagnose.suggest_sets import (
    first_recording,
    open_group,
    outcome,
    second_recording,
    suggest_sets,
)
from tests.reality.test_record_motion import swing

GROUP = ["joint_friction", "joint_damping"]


def test_sets_differ_and_their_first_recordings_are_short():
    sets = suggest_sets()
    assert len({one.name for one in sets}) == len(sets) >= 60
    one = next(one for one in sets if one.base.rig == "pendulum")
    recording, scene = first_recording(one)
    assert recording[0].duration < 1.5
    assert second_recording(one, swing(scene.xml))[0].duration == pytest.approx(1.5, abs=0.1)
    thrown = next(one for one in sets if one.base.rig == "slide")
    assert len(first_recording(thrown)[0].demonstrations) == 1


@pytest.mark.parametrize(
    ("groups", "found"),
    [
        ([["joint_friction"]], "right"),
        ([["joint_friction"], ["mass(arm)"]], "right"),
        ([["joint_friction", "joint_damping"]], "open"),
        ([["joint_friction"], ["joint_damping"]], "open"),
        ([["joint_damping"]], "wrong"),
        ([["mass"]], "wrong"),
        ([], "open"),
    ],
)
def test_what_a_second_recording_comes_to(groups, found):
    assert outcome(groups, GROUP, "joint_friction") == found


def test_only_groups_with_the_hidden_effect_are_asked_about():
    assert open_group([["mass(arm)", "actuator_gain"]], ["mass"]) == (["mass", "actuator_gain"], "mass")
    assert open_group([["mass"], GROUP], ["joint_damping"]) == (GROUP, "joint_damping")
    assert open_group([GROUP], ["mass"]) is None
    assert open_group([["mass"]], ["mass"]) is None


def test_the_page_counts_what_was_measured(tmp_path, monkeypatch):
    told = {"verdict": "group", "groups": [GROUP], "ratio": [3.0, 1.0], "seconds": 5.0}
    facts = dict.fromkeys(("processor", "cores", "python", "mujoco", "mujoco-warp", "warp-lang", "torch", "date"), "x")
    row = {"rig": "pendulum", "truth": ["joint_friction"], "machine": facts, "seconds": 60.0, "first": told}
    outcomes = {"a": "right", "b": "right", "c": "wrong", "d": "none"}
    rows = [
        {
            **row,
            "name": name,
            "group": GROUP,
            "true": "joint_friction",
            "methods": {m: {"outcome": found, "seconds": 9.0} for m in METHODS},
        }
        for name, found in outcomes.items()
    ]
    rows += [{**row, "name": "e", "group": None, "methods": {}}, {**row, "name": "f", "error": "it failed"}]
    text = page(rows, 84)
    assert "| suggested (best of menu and search) | 4 | 2 (50 %) | 1 (25 %) | 0 (0 %) | 1 (25 %) | 0 |" in text
    assert "| suggested (best of menu and search) | 3 | 2 (67 %) | 1 (33 %) | 0 (0 %) | 0 (0 %) | 0 |" in text
    assert "Of 84 data sets 5 are done and 1 ended in an error; 4 ended in a group" in " ".join(text.split())
    path = tmp_path / "rows.jsonl"
    path.write_text("".join(json.dumps(one) + "\n" for one in rows) + '{"name": "g", "fi')
    assert [one["name"] for one in read_rows(path)] == ["a", "b", "c", "d", "e", "f"]
    monkeypatch.setattr(suggest_report, "DATA", tmp_path / "none.jsonl")
    with pytest.raises(SystemExit, match="nothing was measured"):
        suggest_report.write_report([], 84)
