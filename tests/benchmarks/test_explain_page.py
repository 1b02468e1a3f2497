"""The page of the benchmark of explanations counts what it says."""

from typing import Any

from benchmarks.deploy.explain import page

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
    text = page(rows)
    assert "Of 3 cases of changed physics the missing effect is named first in 1 " in text
    assert "among those that the data cannot distinguish in 2." in text
    assert "| physics | 2 of 3 |" in text


def test_a_case_without_failed_trials_counts_for_nothing():
    text = page({"a": row("policy", "policy"), "b": row("policy", None)})
    assert "| policy | 1 of 1 |" in text
    assert "no trial failed" in text
