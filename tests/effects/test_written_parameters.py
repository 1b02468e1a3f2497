"""Parameters of every effect, on the scenes of `test_every_effect`, are those that are written down.

Those that are changed on purpose are written down by ``python tests/effects/test_written_parameters.py``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_every_effect import CASES, FOUND, MODELS

from concent_warp.effects.effect import Effect

WRITTEN = Path(__file__).with_name("parameters.json")
EXPECTED = json.loads(WRITTEN.read_text()) if WRITTEN.is_file() else {}


def key(scene: str, effect: Effect) -> str:
    """Return the name of an effect on a target in a scene."""
    return " ".join([scene, effect.name, *effect.target])


def described(scene: str, effect: Effect) -> dict[str, Any]:
    """Return the fields that an effect sets and its parameters: name, unit and numbers; an infinite one is None."""
    m = MODELS[scene].compile()
    rows = []
    for p in effect.parameters(m):
        numbers = [p.null, p.low, p.high, p.scale, *p.scan]
        rows.append([p.name, p.unit, *(float(f"{x:.9g}") if np.isfinite(x) else None for x in numbers)])
    return {"fields": list(effect.fields(m)), "parameters": rows}


@pytest.mark.parametrize(("scene", "effect"), CASES)
def test_parameters_are_those_that_are_written_down(scene, effect):
    expected, found = EXPECTED[key(scene, effect)], described(scene, effect)
    assert found["fields"] == expected["fields"]
    assert len(found["parameters"]) == len(expected["parameters"])
    for one, other in zip(found["parameters"], expected["parameters"], strict=True):
        assert one[:2] == other[:2]
        numbers, written = ([np.inf if x is None else x for x in row[2:]] for row in (one, other))
        assert numbers == pytest.approx(written, rel=1e-6, abs=1e-12)


def test_effects_apply_to_what_is_written_down():
    assert {key(scene, effect) for scene, effect in FOUND} == set(EXPECTED)


if __name__ == "__main__":
    lines = [f" {json.dumps(key(scene, effect))}: {json.dumps(described(scene, effect))}" for scene, effect in FOUND]
    WRITTEN.write_text("{\n" + ",\n".join(lines) + "\n}\n")
