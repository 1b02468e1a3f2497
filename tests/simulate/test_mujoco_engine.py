from dataclasses import replace

import mujoco
import numpy as np
import pytest
from pushing import STEPS, make_model

from concent_warp.errors import EngineError
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine


def block_height(rollout):
    return rollout.body_position[:, -1, rollout.bodies.index("block"), 2]


def test_variant_equals_plain_mujoco_compiled_with_its_geometry(model, engine, ctrl, variants):
    rollout = engine.run(replace(variants, fields={}), ctrl)
    for n in range(variants.count):
        geometry = replace(
            model.geometry,
            position=variants.sphere_position[n],
            radius=variants.sphere_radius[n],
            friction=variants.sphere_friction[n],
        )
        m = model.with_geometry(geometry).compile()
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = variants.qpos[n], variants.qvel[n]
        for k in range(STEPS):
            np.testing.assert_allclose(rollout.qpos[n, k], d.qpos, atol=1e-12)
            d.ctrl[:] = ctrl[k]
            mujoco.mj_step(m, d)
            np.testing.assert_allclose(rollout.sensordata[n, k], d.sensordata, atol=1e-12)
        np.testing.assert_allclose(rollout.qvel[n, -1], d.qvel, atol=1e-12)


def test_fields_equal_a_scene_that_says_so(model, engine, ctrl):
    heavy = model.scene.xml.replace('mass=".2"', 'mass=".3"').replace('kv="10"/>', 'kv="10" forcerange="-2 2"/>')
    m = replace(model, scene=replace(model.scene, xml=heavy)).compile()
    assert m.body("pusher").mass == 0.3
    d = mujoco.MjData(m)
    for k in range(STEPS):
        d.ctrl[:] = ctrl[k]
        mujoco.mj_step(m, d)
    mass = engine.compiled.body_mass.copy()
    mass[engine.compiled.body("pusher").id] = 0.3
    variants = Variants(1, fields={"body_mass": mass[None], "body_inertia": m.body_inertia[None]})
    rollout = engine.run(variants, ctrl, record=[STEPS])
    np.testing.assert_allclose(rollout.qpos[0, 0], d.qpos, atol=1e-9)
    assert np.abs(engine.run(Variants(1), ctrl, record=[STEPS]).qpos[0, 0] - d.qpos).max() > 1e-6


def test_sphere_moved_far_from_its_place_still_collides(model, engine):
    position = np.tile(model.geometry.position, (2, 1, 1))
    below = np.linalg.norm(model.geometry.position - [0, 0, -0.015], axis=1).argmin()
    position[1, below, 2] -= 0.01
    rollout = engine.run(Variants(2, sphere_position=position), np.zeros((100, 1)), record=[100])
    low, high = block_height(rollout)
    assert high > low + 0.002


def test_what_does_not_vary_is_the_models_own_after_a_run_that_varied_it(model, engine, ctrl, variants):
    nominal = engine.run(Variants(1), ctrl, record=[STEPS])
    engine.run(variants, ctrl, record=[STEPS])
    again = engine.run(Variants(1, sphere_friction=model.geometry.friction[None]), ctrl, record=[STEPS])
    np.testing.assert_array_equal(again.qpos, nominal.qpos)
    np.testing.assert_array_equal(engine.run(Variants(1), ctrl, record=[STEPS]).qpos, nominal.qpos)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_record_has_what_follows_from_its_own_state(integrator, ctrl):
    engine = MujocoEngine(make_model(integrator))
    rollout = engine.run(Variants(1), ctrl, contacts="all")
    m = engine.compiled
    for row in (0, 3, 60, 120, STEPS):
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = rollout.qpos[0, row], rollout.qvel[0, row]
        d.ctrl[:] = ctrl[min(row, STEPS - 1)]
        mujoco.mj_forward(m, d)
        np.testing.assert_allclose(rollout.sensordata[0, row], d.sensordata, atol=1e-5)
        np.testing.assert_allclose(rollout.body_position[0, row], d.xpos, atol=1e-12)
        np.testing.assert_allclose(rollout.body_quaternion[0, row], d.xquat, atol=1e-12)
        if row < STEPS:
            inside = rollout.contacts.step == row
            geom = np.sort(d.contact.geom[d.contact.efc_address >= 0].reshape(-1, 2), axis=1)
            np.testing.assert_array_equal(rollout.contacts.geom[inside], geom[np.lexsort((geom[:, 1], geom[:, 0]))])
    np.testing.assert_allclose(rollout.time, np.arange(STEPS + 1) * 0.005)


def test_sparse_records_equal_the_full_ones_with_commands_that_change_now_and_then(engine, variants):
    ctrl = np.repeat(np.linspace(0, 0.08, 10), 20)[:, None]
    rows = [0, 1, 39, 40, 77, STEPS]
    full = engine.run(variants, ctrl)
    sparse = engine.run(variants, ctrl, record=rows, bodies=["block"])
    for name in ("qpos", "qvel", "sensordata"):
        np.testing.assert_array_equal(getattr(sparse, name), getattr(full, name)[:, rows])
    block = full.bodies.index("block")
    np.testing.assert_array_equal(sparse.body_position[:, :, 0], full.body_position[:, rows, block])
    assert sparse.bodies == ("block",)
    assert not engine.run(variants, ctrl, record=[]).qpos.size


def test_each_variant_follows_its_own_commands(engine, ctrl):
    both = np.stack([ctrl, 0.5 * ctrl])
    rollout = engine.run(Variants(2), both, record=[STEPS])
    for n in range(2):
        alone = engine.run(Variants(1), both[n], record=[STEPS])
        np.testing.assert_array_equal(rollout.qpos[n], alone.qpos[0])
    assert rollout.qpos[0, 0, 0] > rollout.qpos[1, 0, 0] + 0.01


def test_commands_repeat_over_the_variants(engine, ctrl):
    both = np.stack([ctrl, 0.5 * ctrl])
    rollout = engine.run(Variants(4), both, record=[STEPS])
    np.testing.assert_array_equal(rollout.qpos, engine.run(Variants(4), np.tile(both, (2, 1, 1)), record=[STEPS]).qpos)
    np.testing.assert_array_equal(rollout.qpos[:2], rollout.qpos[2:])


def test_contact_forces_carry_the_weight_of_a_resting_block(engine):
    rollout = engine.run(Variants(1), np.zeros((200, 1)), contacts="all")
    log, m = rollout.contacts, engine.compiled
    last = (log.step == 199) & (m.geom_bodyid[log.geom[:, 1]] == m.body("block").id)
    assert (log.geom[last, 0] == m.geom("floor").id).all()
    np.testing.assert_allclose(log.force[last].sum(axis=0), [0, 0, 0.08 * 9.81], atol=0.01)
    np.testing.assert_allclose(log.normal[last], np.tile([0, 0, 1.0], (last.sum(), 1)), atol=1e-6)
    assert (log.distance[last] < 0).all()


def test_contact_log_does_not_depend_on_threads_and_touched_sums_it_up(model, engine, ctrl, variants):
    log = engine.run(variants, ctrl, contacts="all").contacts
    alone = MujocoEngine(model, threads=1).run(variants, ctrl, contacts="all").contacts
    for name, value in vars(log).items():
        np.testing.assert_array_equal(value, getattr(alone, name))
    order = np.lexsort((log.geom[:, 1], log.geom[:, 0], log.step, log.variant))
    np.testing.assert_array_equal(order, np.arange(len(order)))
    m = engine.compiled
    touched = np.zeros((variants.count, m.ngeom, m.nbody), dtype=bool)
    touched[log.variant, log.geom[:, 0], m.geom_bodyid[log.geom[:, 1]]] = True
    touched[log.variant, log.geom[:, 1], m.geom_bodyid[log.geom[:, 0]]] = True
    np.testing.assert_array_equal(engine.run(variants, ctrl, contacts="touched").touched, touched)
    assert touched[:, m.geom("pad").id, m.body("block").id].all()


def test_spheres_that_are_not_collidable_take_no_part(model, ctrl):
    collidable = model.geometry.body == 0
    engine = MujocoEngine(model, collidable=collidable)
    assert (engine.sphere_geom >= 0).tolist() == collidable.tolist()
    assert engine.compiled.geom(engine.sphere_geom[3]).name == model.geometry.names()[3]
    touched = engine.run(Variants(1), ctrl, contacts="touched").touched[0]
    assert touched[:, engine.compiled.body("block").id].any()
    assert not touched[:, engine.compiled.body("wall").id].any()


def test_small_arena_grows_to_the_same_result(model, engine, ctrl, variants):
    small = MujocoEngine(model, memory=2**12)
    rollout = small.run(variants, ctrl, record=[STEPS])
    assert small.repeats > 0
    assert small.memory > 2**12
    np.testing.assert_array_equal(rollout.qpos, engine.run(variants, ctrl, record=[STEPS]).qpos)


def test_arena_that_may_not_grow_enough_is_an_error(model, ctrl):
    with pytest.raises(EngineError, match="max_memory="):
        MujocoEngine(model, memory=2**12, max_memory=2**13).run(Variants(1), ctrl)


@pytest.mark.parametrize("contacts", ["none", "all"])
def test_unstable_variant_is_flagged_and_harms_no_other(engine, ctrl, contacts):
    qvel = np.zeros((3, engine.compiled.nv))
    qvel[1, 3] = 1e11
    rollout = engine.run(Variants(3, qvel=qvel), ctrl, contacts=contacts)
    assert rollout.diverged.tolist() == [False, True, False]
    assert np.isnan(rollout.qpos[1]).all()
    np.testing.assert_array_equal(rollout.qpos[2], engine.run(Variants(1), ctrl).qpos[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ctrl": np.zeros((5, 2))}, r"expected \(steps, 1\)"),
        ({"ctrl": np.zeros((3, 5, 1))}, "wrong shape of the commands"),
        ({"ctrl": np.full((5, 1), np.nan)}, "not finite"),
        ({"record": [2, 1]}, r"increasing steps in 0\.\.5"),
        ({"record": [6]}, r"increasing steps in 0\.\.5"),
        ({"record": [0.5]}, "integers"),
        ({"bodies": ["blok"]}, "blok"),
        ({"contacts": "some"}, "unknown `contacts`"),
        ({"variants": Variants(0)}, "at least one variant"),
        ({"variants": Variants(2, qpos=np.zeros((2, 3)))}, r"variants.qpos; expected \(2, 8\)"),
        ({"variants": Variants(2, sphere_radius=np.zeros((2, 39)))}, "not positive"),
        ({"variants": Variants(2, sphere_position=np.zeros((2, 4, 3)))}, r"\(2, 39, 3\)"),
        ({"variants": Variants(1, fields={"geom_pos": np.zeros((1, 43, 3))})}, "sphere_position"),
        ({"variants": Variants(1, fields={"opt.timestep": np.ones(1)})}, "another time step"),
        ({"variants": Variants(1, fields={"bdy_mass": np.ones(1)})}, "no field 'bdy_mass'"),
        ({"variants": Variants(1, fields={"body_mass": np.full((1, 4), np.inf)})}, "not finite"),
    ],
)
def test_wrong_input_is_named(engine, change, message):
    arguments = {"variants": Variants(2), "ctrl": np.zeros((5, 1)), **change}
    with pytest.raises(EngineError, match=message):
        engine.run(arguments.pop("variants"), arguments.pop("ctrl"), **arguments)


def test_wrong_collidable_is_named(model):
    with pytest.raises(EngineError, match=r"bool of shape \(39,\)"):
        MujocoEngine(model, collidable=np.ones(3, dtype=bool))
