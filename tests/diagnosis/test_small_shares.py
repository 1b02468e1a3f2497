"""Shares that round to nothing are said to be small, not zero."""

from dataclasses import replace

from concent_warp.diagnosis.result import Finding, UnknownForceFound, _owner
from concent_warp.fit.effects.intervals import FittedParameter


def test_a_force_that_explains_next_to_nothing_is_not_said_to_explain_zero():
    found = UnknownForceFound("a force", gain=0.1, p=0.01, share=2e-5, form_error=True)
    assert found.sentence.startswith("A force explains less than 0.1 % of the discrepancy besides")
    assert replace(found, share=0.0123).sentence.startswith("A force explains 1.2 % of the discrepancy besides")


def test_the_body_that_an_effect_acts_on_is_said_where_neither_name_nor_parameters_tell_it():
    def said(name: str, target: tuple[str, ...], parameter: str) -> str:
        mass = FittedParameter(parameter, 1.37, 1.33, 1.41, "-", 1.0)
        finding = Finding(name, target, "objects", (mass,), 0.9, 0.8, 0.95, 0.0025, 0.0025, True, 0, ())
        return f"{finding.name}{_owner(finding)}"

    assert said("mass", ("forearm",), "mass") == "mass of forearm"
    assert said("mass(forearm)", ("forearm",), "mass") == "mass(forearm)"
    assert said("joint_friction", ("elbow",), "torque[elbow]") == "joint_friction"
    assert said("actuator_delay", ("one", "two"), "delay") == "actuator_delay"
    assert said("gravity_tilt", (), "x") == "gravity_tilt"
