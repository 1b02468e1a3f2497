"""The benchmark of rounds of improvement: its arms, and its page."""

from __future__ import annotations

from typing import Any

import pytest

import concent_warp as cw
from benchmarks.deploy.improve import CASES, WIDE, Arm, key, page, true_model
from benchmarks.pages import machine
from concent_warp.deploy.setting_options import changed_settings, with_settings


def rows(before: int) -> dict[str, Any]:
    """Results of one case and seed whose given policy succeeds in `before` of 100 trials."""
    successes: dict[Arm, int] = {"before": before, "rounds": 90, "true effect": 96, "randomised": 70}
    found: dict[str, Any] = {}
    for arm, count in successes.items():
        row = {"case": "backlash=0.015", "seed": 1, "arm": arm, "successes": count, "trials": 100}
        if arm == "rounds":
            row |= {"by round": [[before, 100], [90, 100]], "effects": [["backlash"], []]}
        found[key("backlash=0.015", 1, arm)] = {**row, "machine": machine()}
    return found


def test_the_page_sets_the_arms_side_by_side() -> None:
    text = page(rows(60), 0.98)
    assert "1 of 1 cases and seeds with all arms count" in text
    assert "| rounds | 90 of 100 | 83% to 94% | 94%, at least 94% |" in text
    assert "| backlash=0.015 | 1 | 60.0%, 60% to 60% | 70.0%, 70% to 70% | 96.0%, 96% to 96% | 1 of 1 | 1 |" in text
    assert "| backlash=0.015 | 1 | 38.0 points | 26% | 95% |" in text
    assert "| backlash=0.015 | 1 | 60% (60 of 100) | 90% (90 of 100) | - | - | 1 of 1 |" in text
    assert "| backlash=0.015 | 1 | 60.0% | backlash | 60 of 100, 90 of 100 | 90.0% |" in text


def test_cases_in_which_the_given_policy_is_good_do_not_count() -> None:
    text = page(rows(95), 0.98)
    assert "0 of 1 cases and seeds with all arms count" in text
    assert "| rounds | 0 of" not in text


def test_rounds_whose_last_policy_was_not_judged_count_by_their_own_trials() -> None:
    found = {name: row for name, row in rows(60).items() if row["arm"] in ("before", "rounds")}
    rounds = next(row for row in found.values() if row["arm"] == "rounds")
    del rounds["successes"], rounds["trials"]
    assert "| backlash=0.015 | 1 | 60.0% | backlash | 60 of 100, 90 of 100 | - |" in page(found, 0.98)


@pytest.mark.parametrize("case", CASES)
def test_the_library_has_every_hidden_effect_at_its_true_values(case: str) -> None:
    policy, hidden = cw.load_policy("shape_sorter"), cw.EvaluateCfg(hide=(case,))
    model = true_model(policy, hidden)
    assert [added.effect.name for added in model.effects] == [case.partition("=")[0]]
    model.compile()


def test_randomisation_is_wider_than_the_default() -> None:
    cfg = with_settings(cw.TrainCfg(), WIDE)
    assert set(changed_settings(cfg, cw.TrainCfg())) == set(WIDE)
