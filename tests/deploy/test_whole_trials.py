"""Effects that explain free motion alike are distinguished by whole trials."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.deploy.explain.whole_trials import better_in_whole_trials

CFG = cw.ExplainCfg().judge
TRIALS = np.linspace(-0.01, 0.01, 8)


def finding(name: str, gain: float, *, accepted: bool = False, step: int = 0) -> Any:
    """Evidence of an effect."""
    return SimpleNamespace(name=name, gain=gain, low=gain - 0.04, accepted=accepted, step=step, parameters=(1,))


def chosen(effects: list[Any], shares: dict[str, float], trials: np.ndarray = TRIALS) -> str | None:
    """Return the effect that is preferred, each explaining a share of whole trials."""
    found = better_in_whole_trials(effects, lambda f: shares[f.name] + trials, CFG)
    return None if found is None else found[0].name


PLAY, FRICTION = finding("backlash", 0.83, accepted=True), finding("joint_friction", 0.88)


@pytest.mark.parametrize(
    ("shares", "preferred"),
    [({"backlash": 0.05, "joint_friction": 0.6}, "joint_friction"), ({"backlash": 0.5, "joint_friction": 0.6}, None)],
)
def test_the_effect_that_explains_more_of_whole_trials_is_preferred(shares: dict[str, float], preferred: str) -> None:
    assert chosen([PLAY, FRICTION], shares) == preferred


def test_of_several_the_best_is_preferred_and_said() -> None:
    damping = finding("joint_damping", 0.82)
    shares = {"backlash": 0.05, "joint_friction": 0.6, "joint_damping": 0.4}
    found = better_in_whole_trials([PLAY, damping, FRICTION], lambda f: shares[f.name] + TRIALS, CFG)
    assert found is not None
    assert found[0].name == "joint_friction"
    assert "backlash explains" in found[1]
    assert "joint_friction explains 60%" in found[1]


def test_of_equal_ones_that_of_the_largest_gain_is_preferred() -> None:
    stribeck = finding("stribeck_friction", 0.87)
    shares = {"backlash": 0.05, "joint_friction": 0.6, "stribeck_friction": 0.61}
    assert chosen([PLAY, stribeck, FRICTION], shares) == "joint_friction"


def test_effects_that_explain_less_where_they_were_searched_for_are_no_rivals() -> None:
    shares = {"backlash": 0.05, "joint_friction": 0.6}
    assert chosen([PLAY, finding("joint_friction", 0.7)], shares) is None
    assert chosen([PLAY, finding("joint_friction", 0.9, step=1)], shares) is None
    assert chosen([FRICTION], shares) is None


def test_few_trials_prefer_nothing() -> None:
    assert chosen([PLAY, FRICTION], {"backlash": 0.05, "joint_friction": 0.6}, TRIALS[:3]) is None
