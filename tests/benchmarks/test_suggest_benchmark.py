"""The benchmark of suggested recordings: which data sets it has, what counts as right, and its page."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import pytest

from benchmarks.diagnose import suggest_report
from benchmarks.diagnose.suggest_pool import run_all
from benchmarks.diagnose.suggest_report import METHODS, page, read_rows
from benchmarks.diagnose.suggest_sets import (
    SEEDS,
    first_recording,
    open_group,
    outcome,
    second_recording,
    suggest_sets,
)
from benchmarks.diagnose.suggest_stages import next_tasks, rows_of
from tests.reality.test_record_motion import swing

GROUP = ["joint_friction", "joint_damping"]


def test_sets_differ_and_their_first_recordings_are_short():
    sets = suggest_sets()
    assert len({one.name for one in sets}) == len(sets) >= 60 * SEEDS
    assert len({(one.base.name, one.base.seed) for one in sets}) == len(sets)
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
    outcomes = {"a": "right", "b": "right", "c": "wrong", "d": "none", "h": "time-out"}
    rows = [
        {
            **row,
            "name": name,
            "group": GROUP,
            "true": "joint_friction",
            "repeat": 3 if name == "c" else 0,
            "methods": {m: {"outcome": found, "seconds": 9.0} for m in METHODS},
        }
        for name, found in outcomes.items()
    ]
    rows += [{**row, "name": "e", "group": None, "methods": {}}, {**row, "name": "f", "error": "it failed"}]
    rows += [{**row, "name": "i", "error": "time-out"}]
    rows += [{**row, "name": "j", "group": GROUP, "true": "joint_friction", "methods": {}}]
    text = page(rows, 84)
    assert "| suggested (best of menu and search) | 5 | 2 (40 %) | 1 (20 %) | 0 (0 %) | 1 (20 %) | 1 | 0 |" in text
    assert "| suggested (best of menu and search) | 4 | 2 (50 %) | 1 (25 %) | 0 (0 %) | 0 (0 %) | 1 | 0 |" in text
    assert "| the first 3 | suggested (best of menu and search) | 4 | 2 (50 %) | 0 (0 %) |" in text
    assert "| others | suggested (best of menu and search) | 1 | 0 (0 %) | 1 (100 %) |" in text
    words = " ".join(text.split())
    assert "Of 84 data sets 9 were begun" in words
    assert "1 of these were stopped in the first diagnosis" in words
    assert "and 1 ended in an error. 6 ended in a group that the hidden effect is in; for 5 of these" in words
    assert '1 that had not ended when the time was up are failures ("time-out")' in words
    assert "not begun | not begun | not begun" in text
    path = tmp_path / "rows.jsonl"
    path.write_text("".join(json.dumps(one) + "\n" for one in rows) + '{"name": "g", "fi')
    assert [one["name"] for one in read_rows(path)] == [one["name"] for one in rows]
    assert {one["name"] for one in rows} == {"a", "b", "c", "d", "e", "f", "h", "i", "j"}
    monkeypatch.setattr(suggest_report, "DATA", tmp_path / "none.jsonl")
    with pytest.raises(SystemExit, match="nothing was measured"):
        suggest_report.write_report([], 84)


def stage(one, task, folder):
    """Pretend to do a stage: the second set never ends its suggestion, and the third one dies at once."""
    name = one.name.rsplit("/", 1)[-1]
    if task == ("first",):
        found = {"first": {"verdict": "group", "groups": [GROUP], "ratio": [2.0], "seconds": 1.0}, "seconds": 1.0}
        if name == "dies":
            raise SystemExit(3)
        (folder / "first.json").write_text(json.dumps({**found, "group": GROUP, "true": GROUP[0], "diagnosis": {}}))
    elif task == ("suggest",):
        (folder / "best.json").write_text(json.dumps({"name": "a sweep", "seconds": 1.0}))
        time.sleep(60 if name == "hangs" else 0)
        (folder / "menu.json").write_text(json.dumps({"seconds": 0.5, "like": "best"}))
        (folder / "random.json").write_text(json.dumps({"seconds": 0.5, "outcome": "none"}))
    else:
        result = json.loads((folder / f"{task[1]}.json").read_text())
        (folder / f"{task[1]}.json").write_text(json.dumps({**result, "outcome": "right", "second": {"seconds": 2.0}}))


def test_what_has_not_ended_when_the_time_is_up_is_counted_and_done_later(tmp_path):
    sets = [replace(suggest_sets()[k], name=name) for k, name in enumerate(("ends", "hangs", "dies", "waits"))]
    begun, told = time.monotonic(), []
    assert not run_all(sets[:3], tmp_path, 2, 4.0, told.append, stage)
    assert time.monotonic() - begun < 30
    assert any("stopped: hangs suggest" in text for text in told)
    assert any("DIED (3)" in text for text in told)
    ends, hangs, dies = rows_of(sets, tmp_path)
    assert {m: found["outcome"] for m, found in ends["methods"].items()} == {
        "best": "right",
        "menu": "right",
        "random": "none",
    }
    assert ends["seconds"] == 1.0 + 1.0 + 2.0 + 0.5
    assert {found["outcome"] for found in hangs["methods"].values()} == {"time-out"}
    assert dies["error"] == "time-out"
    assert next_tasks(tmp_path / "ends") == []
    assert next_tasks(tmp_path / "hangs") == [("second", "best"), ("suggest",)]
    assert next_tasks(tmp_path / "dies") == next_tasks(tmp_path / "waits") == [("first",)]
