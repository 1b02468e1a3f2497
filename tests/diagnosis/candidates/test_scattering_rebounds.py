"""A rebound that differs by no more than rebounds scatter is named where all other effects explain clearly less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.evidence import AT_NULL, assess, with_scattering
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

XML = """
<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="1 1 0.1" solref="0.04 {ratio}"/>
<body name="ball" pos="0 0 0.05"><joint name="height" type="slide" axis="0 0 1"/>
<geom name="ball" type="sphere" size="0.05" mass="0.1" solref="0.04 {ratio}"/></body></worldbody>
<sensor><jointpos name="height" joint="height"/></sensor></mujoco>
"""
CFG = DiagnoseCfg(jobs=1)


@pytest.fixture(scope="module")
def fitted():
    """The model, and drag and compliance fitted to bounces of a ball that rebounds a little less than the model's."""
    truth, model = Model(Scene(XML.format(ratio=0.406))), Model(Scene(XML.format(ratio=0.4)))
    rng, seen = np.random.default_rng(0), []
    for k, height in enumerate((0.3, 0.4, 0.5, 0.6)):
        start = Variants(1, qpos=np.array([[height]]), qvel=np.zeros((1, 1)))
        fall = MujocoEngine(truth).run(start, np.zeros((750, 0))).numpy()
        time = 0.01 * np.arange(150)
        value = np.interp(time, fall.time, fall.sensordata[0, :, 0]) + 3e-4 * rng.normal(size=len(time))
        measured = {"height": Channel(time, value[:, None], noise_std=3e-4)}
        seen.append(Demonstration(f"{k}", "drop", qpos=np.array([height]), qvel=np.zeros(1), measured=measured))
    windows = observe(model, Recording(model.scene.xml, tuple(seen), "made up"))
    base = fit_baseline(model, windows, cut_blocks(windows))
    effects = [effect_class(name)("ball") for name in ("air_drag", "contact_compliance")]
    candidates = [fit_candidate(base, screen(base, effect)) for effect in effects]
    return base, candidates, [assess(base, c, np.zeros(400), 0, effects, CFG) for c in candidates]


def test_it_is_named_in_place_of_one_that_explains_less(fitted):
    base, candidates, (drag, compliance) = fitted
    assert compliance.reason == AT_NULL  # 1.5 % of the damping ratio: rebounds scatter by more
    assert compliance.gain > drag.gain
    other = replace(drag, accepted=True, reason="")
    found = with_scattering(base, candidates, [other, compliance], CFG.search)
    assert found == [other, replace(compliance, accepted=True, reason="")]


def test_it_is_not_named_alone_or_for_other_reasons(fitted):
    base, candidates, (drag, compliance) = fitted
    refused = replace(drag, accepted=False, reason="no better than chance")
    assert with_scattering(base, candidates, [refused, compliance], CFG.search) == [refused, compliance]
    other, chance = replace(drag, accepted=True, reason=""), replace(compliance, reason="no better than chance")
    assert with_scattering(base, candidates, [other, chance], CFG.search) == [other, chance]


def test_it_is_not_named_where_another_one_explains_nearly_as_much(fitted):
    base, (drag, compliance), (of_drag, of_compliance) = fitted
    near = replace(drag, errors=1.001 * compliance.errors)
    findings = [replace(of_drag, accepted=True, reason=""), of_compliance]
    assert near.share(base) < compliance.share(base)
    assert with_scattering(base, [near, compliance], findings, CFG.search) == findings
