"""Inertias that are off by no more than data sheets are, in a mechanism of two links whose motion shows them."""

from __future__ import annotations

import numpy as np

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

XML = """
<mujoco><option timestep="0.002" integrator="RK4"/><worldbody>
<body name="upper"><joint name="top" axis="0 1 0"/>
<inertial pos="0 0 -0.14" mass="0.42" diaginertia="{upper} {upper} 0.0001"/>
<body name="lower" pos="0 0 -0.28"><joint name="mid" axis="0 1 0"/>
<inertial pos="0 0 -0.11" mass="{mass}" diaginertia="{lower} {lower} 0.00005"/></body></body></worldbody>
<sensor><jointpos name="top_angle" joint="top"/><jointpos name="mid_angle" joint="mid"/></sensor></mujoco>
"""
NOISE = 5e-4


def test_no_effect_is_named_for_them():
    model = Model(Scene(XML.format(upper=0.0031, mass=0.2, lower=0.0009)))
    truth = Model(Scene(XML.format(upper=0.992 * 0.0031, mass=0.995 * 0.2, lower=1.016 * 0.0009)))
    start = Variants(1, qpos=np.array([[0.9, -0.3]]), qvel=np.zeros((1, 2)))
    swing = MujocoEngine(truth).run(start, np.zeros((2000, 0))).numpy()
    time, rng = 0.01 * np.arange(399), np.random.default_rng(0)
    measured = {}
    for k, name in enumerate(("top_angle", "mid_angle")):
        value = np.interp(time, swing.time, swing.sensordata[0, :, k]) + NOISE * rng.normal(size=len(time))
        measured[name] = Channel(time, value[:, None], noise_std=NOISE)
    one = Demonstration("one", "swing", qpos=np.array([0.9, -0.3]), qvel=np.zeros(2), measured=measured)
    cfg = DiagnoseCfg(jobs=1, explain=False, effects=("sensor_gain", "joint_friction", "stribeck_friction"))
    found = diagnose(model, Recording(model.scene.xml, (one,), "made up"), cfg)
    assert found.verdict == "none_needed"
    # Under gravity alone masses and lengths of links stand in for their inertias: which ones are fitted is open.
    assert found.nominal_values
    assert found.ratio[-1] < 1.05 < 10 < found.ratio[0]
    assert all(p.low < p.value < p.high for p in found.nominal_values)
