"""A model that is far off where a free body touches: its own error takes the place of the noise in fits of effects."""

import mujoco
import numpy as np
import pytest

from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects import fit as module
from concent_warp.fit.effects.cfg import RaisedNoiseCfg
from concent_warp.fit.effects.fit import fit_effects
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

NOISE = 2e-5
"""Of the position [m]."""
FRICTION = 0.4
SCENE = """<mujoco><option timestep="0.002" cone="elliptic"/><worldbody>
<geom name="table" type="plane" size="2 2 .1" friction="{friction} 0 0"/>
<body name="block" pos="0 0 .02"><freejoint name="free"/>
<geom name="block" type="box" size=".03 .03 .02" mass=".2" friction="{friction} 0 0"/></body></worldbody>
<sensor><framepos name="place" objtype="xbody" objname="block"/></sensor></mujoco>"""


def slid(speed: float) -> Demonstration:
    """Return a block that is slowed down by friction for 0.2 s."""
    m = mujoco.MjModel.from_xml_string(SCENE.format(friction=FRICTION))
    d = mujoco.MjData(m)
    d.qvel[0] = speed
    qpos, qvel, rows = d.qpos.copy(), d.qvel.copy(), []
    for _ in range(50):
        mujoco.mj_forward(m, d)
        rows.append((d.time, *d.sensordata))
        mujoco.mj_step(m, d, nstep=2)
    table = np.array(rows)
    place = table[:, 1:] + NOISE * np.random.default_rng(int(100 * speed)).standard_normal((len(table), 3))
    return Demonstration(
        f"at_{speed}", qpos=qpos, qvel=qvel, measured={"place": Channel(table[:, 0], place, noise_std=NOISE)}
    )


@pytest.mark.parametrize(("ratio", "touching", "scale"), [(60.0, True, 20.0), (20.0, True, 1.0), (60.0, False, 1.0)])
def test_the_noise_is_raised_beyond_a_limit_until_a_few_times_of_it_are_left(ratio, touching, scale):
    m = mujoco.MjModel.from_xml_string(SCENE.format(friction=0.3))
    if not touching:
        m.geom_contype[:] = m.geom_conaffinity[:] = 0
    assert RaisedNoiseCfg().scale(ratio, m) == pytest.approx(scale)


def test_a_fit_of_a_model_far_off_is_told_in_units_of_the_noise(monkeypatch):
    told, original = [], module.observe
    monkeypatch.setattr(module, "observe", lambda *a, **k: told.append(k["noise"]["place"]) or original(*a, **k))
    recording = Recording(SCENE.format(friction=0.1), (slid(1.0), slid(0.7)))
    model = Model(Scene(recording.scene)).add(effect_class("sliding_friction")("block"), [0.1])
    fitted = fit_effects(model, recording)
    first, raised = told
    assert first == pytest.approx(NOISE)
    assert fitted.before > 20
    assert raised / first > 20 / 3
    ((friction,),) = fitted.parameters
    assert friction.value == pytest.approx(FRICTION, abs=0.02)
    assert fitted.after < 0.1 * fitted.before
    (channel,) = fitted.channels
    assert (channel.before, channel.after) == (fitted.before, fitted.after)
