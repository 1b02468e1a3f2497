from __future__ import annotations

import numpy as np
import pytest

from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate import mujoco_engine
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_batch import BatchCfg, distinct
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


def test_the_sensors_of_runge_kutta_are_those_of_recorded_states(monkeypatch):
    scene = SERVO.replace("implicitfast", "RK4").replace(
        "<sensor>",
        '<sensor><accelerometer site="tip"/><touch site="under"/><jointactuatorfrc joint="hinge"/>'
        '<velocimeter site="tip"/>',
    )
    scene = scene.replace(
        '<freejoint/><geom size=".03"/>', '<freejoint/><geom size=".03"/><site name="under" size=".04"/>'
    )
    scene = scene.replace('mass=".5"/>', 'mass=".5"/><site name="tip" pos="0 0 -.1"/>')
    engine = MujocoEngine(Model(Scene(scene)), threads=1)
    ctrl = np.sin(np.arange(350) * 0.02)[:, None] * [1.0, 0.0]
    mass = np.stack([engine.compiled.body_mass * scale for scale in (1.0, 1.5, 1.0)])
    qpos = np.tile(engine.compiled.qpos0, (3, 1))
    qpos[:, 0] = 0.0, 0.1, 0.2
    variants, record = Variants(3, fields={"body_mass": mass}, qpos=qpos), np.arange(0, 351, 7)
    calls, batch = [], mujoco_engine.simulate_batch
    monkeypatch.setattr(mujoco_engine, "simulate_batch", lambda *a: (calls.append(1), batch(*a))[1])
    together = engine.run(variants, ctrl, record=record, bodies=[])
    assert calls
    one_by_one = engine.run(variants, ctrl, record=record, bodies=None)
    assert len(calls) == 1
    assert one_by_one.sensordata[:, :, 3].max() > 1  # the ball touches the floor
    for name in ("qpos", "qvel"):
        np.testing.assert_array_equal(getattr(together, name), getattr(one_by_one, name))
    np.testing.assert_allclose(together.sensordata, one_by_one.sensordata, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("bodies", [None, []])
def test_a_run_that_diverges_says_so_and_keeps_what_was_sane(bodies):
    ctrl = np.zeros((350, 2))
    ctrl[200:, 1] = 1e9
    rollout = run(ctrl, bodies)
    assert rollout.diverged.all()
    sane = np.isfinite(rollout.qpos).all(axis=2)
    assert sane[:, rollout.step <= 196].all()
    assert not sane[:, rollout.step >= 203].any()


def test_variants_of_one_call_are_those_of_as_many_calls_also_beside_one_that_diverges():
    engine = MujocoEngine(Model(Scene(SERVO)), threads=1)
    rng, scales = np.random.default_rng(0), np.array([1.0, 1.5, 1.0, 2.0, 1.5])
    ctrl = np.zeros((5, 300, 2))
    ctrl[:, :, 0] = rng.normal(size=(5, 300))
    ctrl[2, 100:, 1] = 1e9
    qpos = np.tile(engine.compiled.qpos0, (5, 1))
    qpos[:, 0] = rng.normal(size=5)
    fields = {"body_mass": np.stack([engine.compiled.body_mass * scale for scale in scales])}
    together = engine.run(Variants(5, fields=fields, qpos=qpos), ctrl, bodies=[])
    assert together.diverged.tolist() == [False, False, True, False, False]
    for n in range(5):
        own = {name: value[n : n + 1] for name, value in fields.items()}
        alone = engine.run(Variants(1, fields=own, qpos=qpos[n : n + 1]), ctrl[n], bodies=None)
        for name in ("qpos", "qvel", "sensordata"):
            np.testing.assert_array_equal(getattr(together, name)[n], getattr(alone, name)[0])


def test_parts_of_a_run_are_small_enough_and_leave_no_thread_idle():
    cfg = BatchCfg(max_variants=10, max_steps=1000, calls_per_thread=2)
    assert cfg.parts(range(25), 50, 1) == [list(range(10)), list(range(10, 20)), list(range(20, 25))]
    assert [len(part) for part in cfg.parts(range(25), 300, 1)] == [3] * 8 + [1]
    assert [len(part) for part in cfg.parts(range(3), 5000, 1)] == [1, 1, 1]
    assert [len(part) for part in cfg.parts(range(12), 50, 2)] == [3, 3, 3, 3]


def test_equal_rows_share_the_first_of_them():
    values = np.array([1.0, 2.0, 1.0, 2.0, 3.0])
    assert distinct([1, 2, 3, 4], [values, np.ones(5)]) == [1, 2, 1, 4]
    assert distinct([1, 2], []) == [1, 1]
