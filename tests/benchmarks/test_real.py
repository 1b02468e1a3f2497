"""Page of diagnoses of measured data: which model is judged as the saved one, and what is said of it."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from benchmarks.diagnose.real import step_names
from benchmarks.diagnose.real_report import bar, judgement, saved_sentence
from benchmarks.fit.held_out import change
from concent_warp.effects.registry import effect_class
from concent_warp.model import Model
from concent_warp.scene.scene import Scene

XML = """
<mujoco><option timestep="0.002"/><worldbody><body name="arm"><joint name="hinge" type="hinge" axis="0 1 0"/>
<geom name="arm" type="sphere" size="0.01" pos="0 0 -0.1" mass="0.1"/></body></worldbody>
<sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>
"""


def test_models_of_a_diagnosis_have_the_names_of_what_they_add() -> None:
    given = Model(Scene(XML)).add(effect_class("joint_damping")("hinge"))
    added = given.add(effect_class("joint_friction")("hinge"))
    finer = Model(added.scene.with_timestep(0.001), effects=added.effects)
    assert step_names(given, [given, added, finer]) == [
        "as given",
        "with joint_friction",
        "with joint_friction, shorter time step (saved)",
    ]
    assert step_names(given, [given]) == ["as given (saved)"]


@pytest.mark.parametrize(("factor", "said"), [(1.5, "worse"), (0.5, "better"), (1.0, "no different")])
def test_a_saved_model_that_is_worse_on_held_out_data_is_called_so(factor: float, said: str) -> None:
    before = np.random.default_rng(0).uniform(1, 2, 30)
    found = asdict(change(before, before * factor))
    assert judgement(found) == said
    judges = [{"name": "seen", "held_out": False}, {"name": "unseen", "held_out": True}]
    study = {"judges": judges, "steps": [{"from_first": [found, found]}]}
    assert f"the saved model is {said} in unseen (" in saved_sentence(study)


def test_the_bar_of_time_is_that_of_two_cores() -> None:
    study = {"part": "servo", "recordings": 4, "jobs": 2, "seconds": 14.0, "processor_seconds": 40.0}
    assert bar(study) == "15 s: met"
    assert bar({**study, "jobs": 1}) == "15 s: missed"
    assert not bar({**study, "recordings": 3})
