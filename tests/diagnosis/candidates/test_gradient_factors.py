"""Which candidates start from the factors of a gradient fit, which are made up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates import gradient_start
from concent_warp.diagnosis.candidates.gradient_start import GradientStarts, _factor_of, _scaled
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.errors import ModelError

ANY: Any = None


def effect(name: str, *target: str) -> Any:
    """Return an effect by its name."""
    return SimpleNamespace(name=name, target=target)


FACTORS: Any = SimpleNamespace(friction=2.0, stiffness=4.0, mass={"box": 3.0})


def test_factors_act_on_friction_stiffness_and_mass():
    names = (
        ("sliding_friction", "box"),
        ("contact_compliance", "box"),
        ("mass", "box"),
        ("mass", "lid"),
        ("size", "box"),
    )
    assert [_factor_of(effect(*n), FACTORS) for n in names] == [2.0, 4.0, 3.0, 1.0, 1.0]
    values = np.array([0.02, 1.0])
    assert _scaled(effect("contact_compliance"), values, 4.0).tolist() == [0.01, 1.0]
    assert _scaled(effect("mass"), values, 3.0).tolist() == [0.06, 1.0]
    assert values.tolist() == [0.02, 1.0]


def test_candidates_with_a_factor_are_started_from_it_and_factors_follow_the_model(monkeypatch):
    asked = []

    def factors(model, _recording, _cfg):
        asked.append(model)
        if "wild" in model.effects:
            raise ModelError("Newton cannot simulate it.")
        return FACTORS

    monkeypatch.setattr(gradient_start, "factors", factors)
    monkeypatch.setattr(gradient_start, "start_from_factor", lambda _b, s, f: (s.effect.name, f))

    def model(*effects: str) -> Any:
        return SimpleNamespace(effects=effects)

    starts: Any = GradientStarts(model(), ANY)
    candidates: Any = [SimpleNamespace(effect=effect(n, "box")) for n in ("size", "mass", "sliding_friction")]
    found = starts.apply(SimpleNamespace(model=model()), candidates, TaskRunner())
    assert found == [candidates[0], ("mass", 3.0), ("sliding_friction", 2.0)]
    assert len(asked) == 1
    for _ in range(2):
        starts.apply(SimpleNamespace(model=model("more")), candidates, TaskRunner())
    assert [m.effects for m in asked] == [(), ("more",)]
    assert starts.apply(SimpleNamespace(model=model("wild")), candidates, TaskRunner()) == candidates
    with pytest.raises(ModelError, match=r"Newton cannot simulate it; or diagnose without --gradient\."):
        GradientStarts(model("wild"), ANY)
