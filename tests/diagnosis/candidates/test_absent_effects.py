"""A value of zero where the model has more is an answer, not a bound that a fit has run to."""

from __future__ import annotations

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.evidence import fitted_parameters
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.effects.library.joints import JointDamping
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

XML = """
<mujoco><option timestep="0.002"/><worldbody><body name="arm"><joint name="hinge" type="hinge" axis="0 1 0"
damping="{damping}"/><geom name="arm" type="sphere" size="0.01" pos="0 0 -0.2" mass="0.2"/></body></worldbody>
<sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>
"""


@pytest.mark.parametrize(("growth", "at_bound"), [(0.0, False), (0.015, False), (0.1, True)])
def test_damping_that_is_not_there_is_at_no_bound_unless_the_motion_grows(growth, at_bound):
    truth, model = Model(Scene(XML.format(damping=0.0))), Model(Scene(XML.format(damping=0.002)))
    start = Variants(1, qpos=np.array([[0.2]]), qvel=np.zeros((1, 1)))
    swing = MujocoEngine(truth).run(start, np.zeros((1000, 0))).numpy()
    time, noise = 0.01 * np.arange(200), np.random.default_rng(0).normal(size=200)
    value = np.interp(time, swing.time, swing.sensordata[0, :, 0]) * np.exp(growth * time) + 1e-3 * noise
    seen = {"angle": Channel(time, value[:, None], noise_std=1e-3)}
    one = Demonstration("one", "swing", qpos=np.array([0.2]), qvel=np.zeros(1), measured=seen)
    windows = observe(model, Recording(model.scene.xml, (one,), "made up"))
    base = fit_baseline(model, windows, cut_blocks(windows))
    candidate = fit_candidate(base, screen(base, JointDamping("hinge")))
    (damping,) = fitted_parameters(base, candidate)
    assert damping.value == pytest.approx(0.0, abs=1e-5)
    assert damping.excludes_null
    assert damping.at_bound is at_bound
