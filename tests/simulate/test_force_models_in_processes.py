"""Force models in Python, in processes of their own."""

import numpy as np
import pytest

from concent_warp.effects.registry import effect_class
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.parallel import ProcessPoolCfg

PENDULUM = """<mujoco><option timestep=".002"/><worldbody>
<body name="link" pos="0 0 .3"><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".5"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator>
<sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>"""
COUNT, STEPS = 6, 300


def run(threads: int, processes: ProcessPoolCfg | None = None):
    model = Model(Scene(PENDULUM))
    effect = effect_class("load_friction")("hinge")
    engine = MujocoEngine(model.add(effect), threads=threads, processes=processes)
    force_model = effect.force_model(engine.compiled)
    assert force_model is not None
    values = np.linspace(0.0, 0.4, COUNT)[:, None] * np.ones(len(effect.parameters(engine.compiled)))
    mass = np.stack([engine.compiled.body_mass * scale for scale in np.linspace(1.0, 2.0, COUNT)])
    ctrl = 0.2 * np.sin(np.arange(STEPS) * 0.02)[None, :, None] * np.array([1.0, 2.0])[:, None, None]
    variants = Variants(
        COUNT, qpos=np.linspace(0, 1, COUNT)[:, None], fields={"body_mass": mass}, force_models=((force_model, values),)
    )
    return engine.run(variants, ctrl, bodies=[])


def test_processes_find_what_one_thread_finds_to_the_last_bit(monkeypatch):
    alone = run(1)
    with monkeypatch.context() as here:
        here.setattr(MujocoEngine, "_simulate", None)  # in this process alone
        shared = run(3, ProcessPoolCfg(min_steps=1))
    for name in ("qpos", "qvel", "sensordata", "diverged"):
        np.testing.assert_array_equal(getattr(shared, name), getattr(alone, name))
    assert np.ptp(alone.qpos[:, -1]) > 0.1


def test_few_steps_stay_where_they_are(monkeypatch):
    monkeypatch.setattr(MujocoEngine, "_all_in_turn", None)
    assert not run(3).diverged.any()


def test_an_error_in_another_process_is_reported_as_here(monkeypatch):
    effect = effect_class("load_friction")("hinge")
    engine = MujocoEngine(Model(Scene(PENDULUM)), threads=3, processes=ProcessPoolCfg(min_steps=1))
    force_model = effect.force_model(engine.compiled)
    assert force_model is not None
    monkeypatch.setattr(MujocoEngine, "_simulate", None)  # in this process alone
    with pytest.raises(ValueError):  # a force model without its parameters
        engine.run(Variants(3, force_models=((force_model, np.zeros((3, 0))),)), np.zeros((1, STEPS, 1)), bodies=[])


def test_variants_that_share_a_model_find_what_each_finds_alone():
    model = Model(Scene(PENDULUM))
    effect = effect_class("load_friction")("hinge")
    engine = MujocoEngine(model.add(effect), threads=1)
    force_model = effect.force_model(engine.compiled)
    assert force_model is not None
    mass = engine.compiled.body_mass * np.array([1.0, 2.0, 1.0, 2.0])[:, None]
    values = np.array([0.3, 0.1, 0.0, 0.3])[:, None]
    start, ctrl = np.array([0.5, 0.5, 0.2, 0.1])[:, None], np.full((1, STEPS, 1), 0.1)

    def simulated(rows):
        chosen = ((force_model, values[rows]),)
        return engine.run(
            Variants(len(rows), qpos=start[rows], fields={"body_mass": mass[rows]}, force_models=chosen), ctrl
        )

    together = simulated([0, 1, 2, 3])
    for n in range(4):
        np.testing.assert_array_equal(together.qpos[n], simulated([n]).qpos[0])
    assert len({tuple(row) for row in together.qpos[:, -1]}) == 4
