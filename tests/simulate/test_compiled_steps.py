"""Steps with force models as machine code: what they find, and where they are allowed."""

import mujoco
import numpy as np
import pytest

from concent_warp.effects import compiled_forces
from concent_warp.effects.registry import effect_class
from concent_warp.effects.unknown_force import WAYS, UnknownBodyForce, UnknownJointForce
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate import mujoco_engine
from concent_warp.simulate.compiled_steps import SHARE_OF_ARENA, can_step, cannot_fill_arena, most_memory
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

pytestmark = pytest.mark.skipif(not compiled_forces.can_compile(), reason="no Numba")
ROBOT = """<mujoco><option timestep=".002" integrator="implicitfast"/><worldbody>
<body name="upper" pos="0 0 .5"><joint name="shoulder" axis="0 1 0" armature=".01" frictionloss=".02"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".5"/>
<body name="lower" pos="0 0 -.2"><joint name="elbow" axis="0 1 0" armature=".005"/>
<geom type="capsule" fromto="0 0 0 0 0 -.15" size=".015" mass=".3"/></body></body></worldbody>
<actuator><position name="shoulder" joint="shoulder" kp="20" kv=".4" ctrlrange="-1 1" forcerange="-2 2"/>
<position joint="elbow" kp="10" kv=".2"/></actuator>
<sensor><jointpos joint="shoulder"/><jointpos joint="elbow"/></sensor></mujoco>"""
STEPS = 250
VALUES = {
    "load_friction": [0.3],
    "stribeck_friction": [0.2, 0.1],
    "backlash": [0.03],
    "joint_compliance": [0.01, 0.5],
}


def run(names, integrator="implicitfast", bodies=()):
    model = Model(Scene(ROBOT.replace("implicitfast", integrator)))
    for name in names:
        model = model.add(effect_class(name)("shoulder"))
    engine = MujocoEngine(model, threads=1)
    found = []
    for name, added in zip(names, model.effects, strict=True):
        force_model = added.effect.force_model(engine.compiled)
        assert force_model is not None
        found.append((force_model, np.array([VALUES[name], np.multiply(VALUES[name], 0.5)])))
    ctrl = np.sin(np.arange(STEPS) * 0.02)[None, :, None] * np.array([1.5, -0.7])
    record = [0, 1, 7, 100, STEPS]
    return engine.run(
        Variants(2, qpos=np.array([[0.3, -0.2]] * 2), force_models=tuple(found)), ctrl, record=record, bodies=bodies
    )


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
@pytest.mark.parametrize(
    "names",
    [
        ("load_friction",),
        ("stribeck_friction",),
        ("backlash",),
        ("joint_compliance",),
        ("stribeck_friction", "load_friction", "joint_compliance"),
    ],
    ids="+".join,
)
def test_compiled_steps_find_what_python_finds_to_the_last_bit(names, integrator, monkeypatch):
    calls = []
    original = compiled_forces.step
    monkeypatch.setattr("concent_warp.simulate.compiled_steps.step", lambda *a: (calls.append(1), original(*a)))
    compiled = run(names, integrator)
    assert len(calls) == 2
    monkeypatch.setattr(mujoco_engine, "can_step", lambda _: False)
    python, watched = run(names, integrator), run(names, integrator, bodies=None)
    assert len(calls) == 2
    for name in ("qpos", "qvel", "sensordata"):
        np.testing.assert_array_equal(getattr(compiled, name), getattr(python, name))
        np.testing.assert_allclose(getattr(watched, name), getattr(python, name), rtol=1e-9, atol=1e-12)
    assert np.ptp(compiled.qpos[:, -1, 0]) > 1e-4


def test_a_smooth_force_on_a_joint_acts_compiled_as_in_python(monkeypatch):
    force_model = UnknownJointForce(
        np.array([0]), np.array([1]), np.array([[-1.0, 0.0, 1.0]]), np.array([0.5]), moving=True
    )
    values = np.array([[0.3, 0.0, -0.4], [0.0, 0.0, 0.0]])
    assert can_step([(force_model, values[0])])
    engine = MujocoEngine(Model(Scene(ROBOT)), threads=1)
    variants = Variants(2, qpos=np.array([[0.3, -0.2]] * 2), force_models=((force_model, values),))
    compiled = engine.run(variants, np.zeros((1, STEPS, 2)), bodies=[])
    monkeypatch.setattr(mujoco_engine, "can_step", lambda _: False)
    python = engine.run(variants, np.zeros((1, STEPS, 2)), bodies=[])
    np.testing.assert_array_equal(compiled.qpos, python.qpos)
    assert np.abs(compiled.qpos[0, -1] - compiled.qpos[1, -1]).max() > 1e-3


SLIDING = """<mujoco><option timestep=".002" cone="elliptic"/><worldbody>
<geom type="plane" size="1 1 .1" zaxis=".1 0 1"/><geom type="plane" pos="-.08 0 0" size="1 1 .1" zaxis="1 0 0"/>
<body name="block" pos="0 0 .055"><freejoint/>
<geom type="box" size=".05 .04 .03" mass=".3"/><geom type="{shape}" pos=".02 0 .03" size=".02 .03 .02" mass=".1"/>
</body></worldbody><sensor><framepos objtype="body" objname="block"/></sensor></mujoco>"""


@pytest.mark.parametrize("shape", ["sphere", "capsule", "cylinder", "box"])
def test_adhesion_to_planes_acts_compiled_as_in_python_to_the_last_bit(shape, monkeypatch):
    model = Model(Scene(SLIDING.format(shape=shape)))
    engine = MujocoEngine(model, threads=1)
    force_model = effect_class("adhesion")("block").force_model(engine.compiled)
    assert force_model is not None
    values = np.array([[0.4], [0.0], [1.5]])
    start = np.tile(engine.compiled.qpos0 + np.array([0, 0, 0, 0, 0.02, 0.1, 0]), (3, 1))
    speed = np.tile([-0.4, 0.1, 0, 0.3, 0, 2.0], (3, 1))
    variants = Variants(3, qpos=start, qvel=speed, force_models=((force_model, values),))
    assert can_step([(force_model, values[0])])
    compiled = engine.run(variants, np.zeros((1, STEPS, 0)), bodies=[])
    monkeypatch.setattr(mujoco_engine, "can_step", lambda _: False)
    python = engine.run(variants, np.zeros((1, STEPS, 0)), bodies=[])
    for name in ("qpos", "qvel", "sensordata"):
        np.testing.assert_array_equal(getattr(compiled, name), getattr(python, name))
    # It holds the block back.
    travelled = np.linalg.norm(compiled.qpos[:, -1, :3] - compiled.qpos[:, 0, :3], axis=1)
    assert travelled[0] < 0.9 * travelled[1]


def test_adhesion_to_a_box_is_not_compiled():
    m = mujoco.MjModel.from_xml_string(SLIDING.format(shape="box").replace('type="plane" pos="-.08 0 0"', 'type="box"'))
    force_model = effect_class("adhesion")("block").force_model(m)
    assert force_model is not None
    assert not can_step([(force_model, np.array([0.4]))])


@pytest.mark.parametrize("way", WAYS)
def test_a_smooth_force_on_a_body_acts_compiled_as_in_python(way, monkeypatch):
    centre = np.array([[0.0, 0, 0.05], [0.05, 0.02, 0.05]]) if way in ("field", "brake") else np.array([[0.1], [0.4]])
    engine = MujocoEngine(Model(Scene(SLIDING.format(shape="box"))), threads=1)
    force_model = UnknownBodyForce(1, 0, 0, centre, 0.1, 2.0, way)
    values = np.array([np.linspace(0.2, 0.4, force_model.count), np.zeros(force_model.count)])
    speed = np.tile([0.4, 0.1, 0, 0.3, 0, 2.0], (2, 1))
    variants = Variants(2, qvel=speed, force_models=((force_model, values),))
    assert can_step([(force_model, values[0])])
    compiled = engine.run(variants, np.zeros((1, STEPS, 0)), bodies=[])
    monkeypatch.setattr(mujoco_engine, "can_step", lambda _: False)
    python = engine.run(variants, np.zeros((1, STEPS, 0)), bodies=[])
    np.testing.assert_array_equal(compiled.qpos, python.qpos)
    assert np.abs(compiled.qpos[0, -1] - compiled.qpos[1, -1]).max() > 1e-3


def test_a_diverging_simulation_is_reported_as_without_compiling():
    wild = ROBOT.replace('kp="20"', 'kp="2e7"').replace('forcerange="-2 2"', "").replace("implicitfast", "Euler")
    model = Model(Scene(wild)).add(effect_class("load_friction")("shoulder"))
    engine = MujocoEngine(model, threads=1)
    force_model = model.effects[0].effect.force_model(engine.compiled)
    assert force_model is not None
    found = engine.run(Variants(1, force_models=((force_model, np.array([[0.3]])),)), np.ones((1, STEPS, 2)), bodies=[])
    assert found.diverged.tolist() == [True]
    assert np.isnan(found.qpos[0, -1]).all()


PILE = (
    """<mujoco><option solver="{solver}"/><worldbody><geom type="plane" size="2 2 .1"/>{boxes}</worldbody></mujoco>"""
)
BOX = '<body pos="{x} {y} {z}"><freejoint/><geom type="{shape}" size=".05 .05 .05" condim="4"/></body>'


def pile(count, shape="box", solver="Newton"):
    places = np.random.default_rng(0).uniform([-0.1, -0.1, 0.02], [0.1, 0.1, 0.15], (count, 3))
    boxes = "".join(BOX.format(x=x, y=y, z=z, shape=shape) for x, y, z in places)
    return mujoco.MjModel.from_xml_string(PILE.format(boxes=boxes, solver=solver))


@pytest.mark.parametrize("solver", ["Newton", "PGS"])
@pytest.mark.parametrize("shape", ["box", "sphere", "capsule", "cylinder"])
def test_contacts_and_constraints_of_a_pile_take_less_than_the_bound(shape, solver):
    m = pile(8, shape, solver)
    d = mujoco.MjData(m)
    mujoco.mj_step(m, d, nstep=5)
    assert d.ncon > 10
    assert d.maxuse_arena - d.maxuse_stack < most_memory(m)


def test_models_whose_contacts_might_fill_the_arena_are_not_compiled():
    assert cannot_fill_arena(mujoco.MjModel.from_xml_string(ROBOT))
    assert cannot_fill_arena(pile(1))
    assert not cannot_fill_arena(pile(40))
    assert most_memory(pile(40)) > SHARE_OF_ARENA * pile(40).narena
