"""Friction far from the model's, of a box that is tossed: it tumbles another way, and no sensitivity leads there."""

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

BOX = """<mujoco><worldbody><geom type="plane" size="5 5 0.1" friction="{0}"/>
<body name="box" pos="0 0 0.12"><freejoint/><geom type="box" size="0.05 0.05 0.05" mass="0.4" friction="{0}"/></body>
</worldbody><sensor><framepos name="place" objtype="xbody" objname="box"/>
<framequat name="turned" objtype="xbody" objname="box"/></sensor></mujoco>"""
TRUE, NOMINAL = 0.55, 0.2


def tossed(seed):
    m = mujoco.MjModel.from_xml_string(BOX.format(TRUE))
    d, rng, rows = mujoco.MjData(m), np.random.default_rng(seed), []
    turned = rng.normal(size=4)
    d.qpos[3:7] = turned / np.linalg.norm(turned)
    d.qvel[:] = [1.3, 0.2, 0.3, *rng.normal(0, 3, 3)]
    for k in range(400):
        mujoco.mj_forward(m, d)
        if k % 5 == 0:
            rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    value = np.array(rows) + rng.normal(0, 5e-4, (80, 7))
    value[:, 3:] /= np.linalg.norm(value[:, 3:], axis=1)[:, None]
    time = np.arange(80) * 0.01
    measured = {"place": Channel(time, value[:, :3], 5e-4), "turned": Channel(time, value[:, 3:], 1e-3)}
    return Demonstration(f"demo_{seed}", measured=measured)


def test_friction_that_is_off_by_far_is_found_among_the_values_that_are_tried():
    recording = Recording(BOX.format(NOMINAL), (tossed(0), tossed(1)))
    model = Model(Scene(recording.scene))
    windows = observe(model, recording)
    found = screen(fit_baseline(model, windows, cut_blocks(windows)), effect_class("sliding_friction")("box"))
    assert found.start == pytest.approx([TRUE], rel=0.3)
    assert found.scanned_gain > 0.5
