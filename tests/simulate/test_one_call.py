from __future__ import annotations

import numpy as np
import pytest

from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

SERVO = """<mujoco><option timestep=".002" integrator="implicitfast"/><worldbody>
<geom type="plane" size="1 1 .1"/><body name="link" pos="0 0 .3"><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".5"/></body>
<body name="ball" pos=".3 0 .2"><freejoint/><geom size=".03"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="2" kv=".05"/>
<motor name="motor" joint="hinge" gear="1e9"/></actuator>
<sensor><jointpos joint="hinge"/><framepos objtype="body" objname="ball"/></sensor></mujoco>"""


def run(ctrl: np.ndarray, bodies: list[str] | None):
    engine = MujocoEngine(Model(Scene(SERVO)), threads=1)
    mass = np.stack([engine.compiled.body_mass * scale for scale in (1.0, 1.5)])
    return engine.run(
        Variants(2, fields={"body_mass": mass}), ctrl, record=np.arange(0, len(ctrl) + 1, 7), bodies=bodies
    )


def test_stepping_in_one_call_records_the_same_to_the_last_bit():
    ctrl = np.sin(np.arange(350) * 0.02)[:, None] * [1.0, 0.0]
    watched, unwatched = run(ctrl, None), run(ctrl, [])
    for name in ("qpos", "qvel", "sensordata"):
        np.testing.assert_array_equal(getattr(unwatched, name), getattr(watched, name))


@pytest.mark.parametrize("bodies", [None, []])
def test_a_run_that_diverges_says_so_and_keeps_what_was_sane(bodies):
    ctrl = np.zeros((350, 2))
    ctrl[200:, 1] = 1e9
    rollout = run(ctrl, bodies)
    assert rollout.diverged.all()
    sane = np.isfinite(rollout.qpos).all(axis=2)
    assert sane[:, rollout.step <= 196].all()
    assert not sane[:, rollout.step >= 203].any()
