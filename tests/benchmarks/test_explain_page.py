"""The page of the benchmark of explanations counts what it says."""

import json
from pathlib import Path
from typing import Any

from benchmarks.deploy.explain import METHOD, first_rows, page

MACHINE = {
    "processor": "x", "cores": 2, "python": "3", "mujoco": "3", "mujoco-warp": "3", "warp-lang": "1", "torch": "2",
    "date": "2026-01-01",
}  # fmt: skip


def row(cause: str, found: str | None, **more: Any) -> dict[str, Any]:
    return {"machine": MACHINE, "cause": cause, "found": found, "effect": "", "failed": 6, "episodes": 24, **more}


def test_an_effect_counts_as_named_whatever_joints_it_acts_on():
    rows = {
        "a": row("physics", "physics", effect="joint_friction", effects=["joint_friction(joint1, ...)"],
                 groups=[["joint_friction(joint1, ...)", "joint_damping(joint1, ...)"]]),
        "b": row("physics", "physics", effect="backlash", effects=["actuator_lag"],
                 groups=[["actuator_lag", "backlash"]]),
        "c": row("physics", "unexplained", effect="armature"),
    }  # fmt: skip
    before = {"b": row("physics", "physics", effect="backlash", effects=["backlash"], verdict="effect", seconds=7)}
    text = page(rows, None, before)
    assert "| b | actuator_lag | None | 0 | backlash | effect | 7 |" in text
    assert "named 1 first" in text
    assert "Of 3 cases of changed physics the missing effect is named first in 1 " in text
    assert "among those that the data cannot distinguish in 2." in text
    assert "| physics | 2 of 3 |" in text


def test_a_case_without_failed_trials_counts_for_nothing():
    text = page({"a": row("policy", "policy"), "b": row("policy", None)})
    assert "| policy | 1 of 1 |" in text
    assert "no trial failed" in text


def test_cases_measured_again_are_compared_with_what_was_found_before():
    rows = {
        "a": row("perception", "perception", key="a", method=METHOD, **{"one by one": ["perception", "policy"]}),
        "b": row("perception", "policy", key="b"),
    }
    earlier = {"a": row("perception", "unexplained", key="a"), "b": rows["b"]}
    text = page(rows, earlier)
    assert "| perception | 1 of 1 | 21% to 100% | 1 of 2 | 9% to 91% | 0 of 1 |" in text
    assert "| perception | 1 of 2 |" in text
    assert "| a | perception | perception | unexplained | 1 of 2 |" in text
    assert "| b | perception | policy |  |" in text


def test_rows_of_another_method_are_those_before(tmp_path: Path):
    path = tmp_path / "rows.jsonl"
    rows = [{"key": "a", "found": "policy"}, {"key": "a", "found": "perception", "method": METHOD}]
    path.write_text("\n".join(map(json.dumps, rows)))
    assert first_rows(path) == {"a": rows[0]}
