"""An effect of a size far beyond typical ones is not named where one of a plausible size is enough."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.evidence import without_implausible
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.effects.effect import Parameter
from concent_warp.effects.registry import effect_class
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.diagnosis.candidates.made_up_fit import made
from tests.diagnosis.made_up import finding

PUCK = """
<mujoco><worldbody><geom type="plane" size="1 1 0.1"/>
<body name="puck" pos="0 0 0.01"><freejoint/><geom type="cylinder" size="0.04 0.01" mass="0.05"/></body></worldbody>
</mujoco>
"""
BASE: Any = SimpleNamespace(prediction=lambda effect: SimpleNamespace(owned=0, parameters=effect.parameters))


def candidate(gain: float, parameters: tuple[Parameter, ...], *values: float) -> Any:
    """Return a fit that is made up, of an effect with some parameters."""
    found = made("", gain, source=SimpleNamespace(parameters=parameters))
    fit = SimpleNamespace(values=np.array(values))
    return SimpleNamespace(effect=found.effect, fit=fit, share=found.share)


FRICTION = (Parameter("coefficient", "-", 0.15, 0.0, 3.0, 0.15),)
PRESSURE = (Parameter("force", "N", 0.0, -100.0, 100.0, 0.5),)


@pytest.mark.parametrize(
    ("size", "gain", "accepted"),
    [
        (-18.0, 0.96, False),  # 36 x a typical one
        (18.0, 0.96, False),
        (12.0, 0.96, True),  # 24 x
        (18.0, 0.99, True),  # it explains more than an error in the other's formula may be
    ],
)
def test_it_is_refused_where_it_explains_no_more_than_an_error_in_a_formula(size, gain, accepted):
    fitted = [candidate(gain, PRESSURE, size), candidate(0.9, FRICTION, 0.24)]
    findings = [finding("pressure", gain), finding("friction", 0.9)]
    found = without_implausible(BASE, fitted, findings, DiagnoseCfg())
    assert [f.accepted for f in found] == [accepted, True]
    assert ("far beyond typical ones" in found[0].reason) is not accepted


def test_it_stays_where_no_other_one_is_accepted():
    fitted = [candidate(0.96, PRESSURE, 18.0), candidate(0.9, FRICTION, 0.24)]
    findings = [finding("pressure", 0.96), finding("friction", 0.9, accepted=False, reason="folds disagree")]
    assert without_implausible(BASE, fitted, findings, DiagnoseCfg()) == findings


def test_a_storm_from_above_is_far_beyond_typical_winds():
    wind = effect_class("wind")("puck").parameters(Model(Scene(PUCK)).compile())
    friction = candidate(0.95, FRICTION, 0.24)
    findings = [finding("wind", 0.96), finding("friction", 0.95)]
    for velocity, accepted in (((0.1, 0.1, -18.0), False), ((12.0, 0.1, -1.0), True)):
        found = without_implausible(BASE, [candidate(0.96, wind, *velocity), friction], findings, DiagnoseCfg())
        assert [f.accepted for f in found] == [accepted, True]
