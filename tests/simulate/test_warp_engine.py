from dataclasses import replace

import mujoco
import numpy as np
import pytest
from pushing import STEPS, make_model

from concent_warp.errors import EngineError
from concent_warp.simulate import warp_engine as warp_engine_module
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.warp_engine import WarpEngine, _rung
from concent_warp.simulate.warp_program import Buffers, world_bytes

ROWS = np.arange(0, STEPS + 1, 10)


@pytest.fixture(scope="module")
def warp_engine(model):
    return WarpEngine(model, device="cpu")


def assert_same(rollout, reference, atol=0.0):
    for name in ("qpos", "qvel", "sensordata", "body_position", "body_quaternion"):
        np.testing.assert_allclose(getattr(rollout, name), getattr(reference, name), rtol=0, atol=atol, err_msg=name)


def test_engines_agree_where_everything_varies(engine, warp_engine, ctrl, variants):
    assert_agreement(engine, warp_engine, ctrl, variants)


@pytest.mark.gpu
def test_engines_agree_on_a_gpu(model, engine, ctrl, variants):
    assert_agreement(engine, WarpEngine(model, device="cuda:0"), ctrl, variants)


def assert_agreement(engine, warp_engine, ctrl, variants):
    both = np.stack([ctrl, 0.9 * ctrl, 1.1 * ctrl])
    reference = engine.run(variants, both, contacts="all")
    rollout = warp_engine.run(variants, both, contacts="all").numpy()
    np.testing.assert_allclose(rollout.qpos, reference.qpos, atol=1e-4)
    np.testing.assert_allclose(rollout.body_position, reference.body_position, atol=2e-5)
    np.testing.assert_allclose(rollout.body_quaternion, reference.body_quaternion, atol=1e-4)
    smooth = [0, 1, 2, 9, 10]
    np.testing.assert_allclose(rollout.sensordata[..., :3], reference.sensordata[..., :3], atol=2e-5)
    np.testing.assert_allclose(rollout.sensordata[..., smooth], reference.sensordata[..., smooth], atol=5e-3)
    np.testing.assert_array_equal(rollout.time, reference.time)
    assert not rollout.diverged.any()
    log, expected = rollout.contacts, reference.contacts
    wall = engine.compiled.geom_bodyid[expected.geom] == engine.compiled.body("wall").id
    assert wall.any()
    pairs, expected_pairs = (set(zip(x.variant, x.step, *x.geom.T, strict=True)) for x in (log, expected))
    assert len(pairs ^ expected_pairs) <= 0.002 * len(expected_pairs)


def test_contact_log_holds_the_same_rows_in_both_engines(engine, warp_engine, ctrl, variants):
    log = warp_engine.run(variants, ctrl[:60], contacts="all").contacts
    expected = engine.run(variants, ctrl[:60], contacts="all").contacts
    for name in ("variant", "step", "geom"):
        np.testing.assert_array_equal(getattr(log, name), getattr(expected, name))
    np.testing.assert_allclose(log.position, expected.position, atol=1e-5)
    np.testing.assert_allclose(log.normal, expected.normal, atol=1e-3)
    np.testing.assert_allclose(log.distance, expected.distance, atol=1e-6)
    np.testing.assert_allclose(log.force, expected.force, atol=0.02)


def test_geoms_that_touched_are_the_same_in_both_engines(engine, warp_engine, ctrl, variants):
    touched = warp_engine.run(variants, ctrl, contacts="touched", record=[]).touched.numpy()
    np.testing.assert_array_equal(touched, engine.run(variants, ctrl, contacts="touched", record=[]).touched)


def test_record_has_what_follows_from_its_own_state(warp_engine, ctrl):
    rollout = warp_engine.run(Variants(1), ctrl).numpy()
    m = warp_engine.compiled
    for row in (0, 3, 60, 120, STEPS):
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = rollout.qpos[0, row], rollout.qvel[0, row]
        d.ctrl[:] = ctrl[min(row, STEPS - 1)]
        mujoco.mj_forward(m, d)
        position, force = m.sensor("position").adr[0], m.sensor("force").adr[0]
        np.testing.assert_allclose(rollout.sensordata[0, row, position : position + 6], d.sensordata[:6], atol=1e-6)
        np.testing.assert_allclose(rollout.sensordata[0, row, force], d.sensordata[force], atol=1e-4)
        np.testing.assert_allclose(rollout.body_position[0, row], d.xpos, atol=1e-6)


def test_runs_of_one_engine_share_no_memory_and_repeat_exactly(warp_engine, ctrl, variants):
    first = warp_engine.run(variants, ctrl, record=ROWS)
    kept = first.qpos.clone()
    other = warp_engine.run(replace(variants, qvel=2 * variants.qvel), ctrl, record=ROWS)
    assert (first.qpos == kept).all()
    assert (other.qpos != kept).any()
    assert_same(warp_engine.run(variants, ctrl, record=ROWS), first)


def test_runs_of_the_same_shapes_reuse_the_graphs(warp_engine, ctrl, variants):
    warp_engine.run(variants, ctrl, record=ROWS)
    programs = list(warp_engine._programs.values())
    warp_engine.run(replace(variants, sphere_radius=1.01 * variants.sphere_radius), 0.5 * ctrl, record=ROWS)
    assert list(warp_engine._programs.values()) == programs


def test_what_does_not_vary_is_the_models_own_after_a_run_that_varied_it(warp_engine, engine, ctrl, variants):
    warp_engine.run(variants, ctrl, record=ROWS)
    nominal = warp_engine.run(Variants(variants.count), ctrl, record=ROWS)
    np.testing.assert_allclose(nominal.qpos, engine.run(Variants(3), ctrl, record=ROWS).qpos, atol=1e-4)


def test_chunks_of_worlds_equal_one_batch(model, warp_engine, ctrl, variants):
    chunked = WarpEngine(model, device="cpu", max_worlds=2)
    rollout = chunked.run(variants, ctrl[:60], contacts="all")
    whole = warp_engine.run(variants, ctrl[:60], contacts="all")
    assert_same(rollout, whole)
    for name, value in vars(rollout.contacts).items():
        np.testing.assert_array_equal(value, getattr(whole.contacts, name))


def test_commands_repeat_over_the_worlds_of_all_chunks(model, warp_engine, ctrl):
    both, variants = np.stack([ctrl, 0.5 * ctrl]), Variants(6)
    tiled = warp_engine.run(variants, np.tile(both, (3, 1, 1)), record=ROWS).numpy()
    assert np.abs(tiled.qpos[0] - tiled.qpos[1]).max() > 0.01
    for worlds in (1, 3, 6):
        rollout = WarpEngine(model, device="cpu", max_worlds=worlds).run(variants, both, record=ROWS).numpy()
        assert_same(rollout, tiled)


def test_contacts_that_overflow_grow_to_the_same_result(model, warp_engine, ctrl, variants):
    warp_engine.run(variants, ctrl, record=ROWS)
    small = WarpEngine(model, device="cpu", nconmax=4, njmax=warp_engine.buffers.constraints)
    rollout = small.run(variants, ctrl, record=ROWS)
    assert small.repeats > 0
    assert small.buffers.contacts > 4
    assert_same(rollout, warp_engine.run(variants, ctrl, record=ROWS))


def test_constraints_that_overflow_grow_to_the_same_result(model, warp_engine, ctrl, variants):
    reference = warp_engine.run(variants, ctrl, record=ROWS)
    small = WarpEngine(model, device="cpu", njmax=24)
    rollout = small.run(variants, ctrl, record=ROWS)
    assert small.repeats > 0
    assert small.buffers.constraints > 24
    assert_same(rollout, reference, atol=1e-3)


def test_contact_log_that_overflows_is_complete_in_the_end(model, warp_engine, ctrl, variants):
    whole = warp_engine.run(variants, ctrl[:60], contacts="all").contacts
    small = WarpEngine(model, device="cpu")
    small._buffers = replace(warp_engine.buffers, log_rows=10)
    log = small.run(variants, ctrl[:60], contacts="all").contacts
    assert small.repeats == 1
    for name, value in vars(log).items():
        np.testing.assert_array_equal(value, getattr(whole, name))


def test_overflow_beyond_the_memory_is_an_error(model, ctrl):
    with pytest.raises(EngineError, match="max_memory"):
        WarpEngine(model, device="cpu", max_memory=1000).run(Variants(1), ctrl)


def test_growth_beyond_the_memory_says_what_was_needed(model, warp_engine, ctrl, variants):
    warp_engine.run(variants, ctrl, record=ROWS)
    njmax = warp_engine.buffers.constraints
    one = world_bytes(warp_engine.compiled, Buffers(1, njmax))
    small = WarpEngine(model, device="cpu", nconmax=1, njmax=njmax, max_memory=int(1.5 * one) + 12_000)
    with pytest.raises(EngineError, match=r"one variant needs (?!1 )\d+ contacts and \d+ constraint rows"):
        small.run(replace(variants, fields={}), ctrl, record=ROWS)


def test_worlds_that_cannot_be_allocated_name_the_way_out(model, ctrl, monkeypatch):
    def refuse(*_):
        raise RuntimeError("Failed to allocate 1000000 bytes on device 'cuda:0'")

    monkeypatch.setattr(warp_engine_module, "Program", refuse)
    with pytest.raises(EngineError, match="set max_worlds below 3"):
        WarpEngine(model, device="cpu").run(Variants(3), ctrl)


def test_unstable_variant_is_flagged_and_harms_no_other(warp_engine, ctrl, variants):
    qvel = variants.qvel.copy()
    qvel[1, 3] = 1e11
    rollout = warp_engine.run(replace(variants, qvel=qvel), ctrl, record=ROWS)
    assert rollout.diverged.tolist() == [False, True, False]
    assert rollout.qpos[1].isnan().all()
    assert rollout.sensordata[1].isnan().all()
    sane = warp_engine.run(variants, ctrl, record=ROWS)
    assert (rollout.qpos[::2] == sane.qpos[::2]).all()


def test_physics_that_the_model_lacks_can_vary(engine, warp_engine, ctrl):
    damping = np.zeros((2, engine.compiled.nv))
    damping[1, 1:4] = 0.5
    variants = Variants(2, fields={"dof_damping": damping, "opt.viscosity": np.array([0.0, 0.01])})
    rollout = warp_engine.run(variants, ctrl, record=[STEPS])
    np.testing.assert_allclose(rollout.qpos, engine.run(variants, ctrl, record=[STEPS]).qpos, atol=1e-4)
    assert abs(rollout.qpos[0] - rollout.qpos[1]).max() > 1e-3


def test_bodies_that_are_static_can_be_moved(engine, warp_engine, ctrl):
    body_pos = np.tile(engine.compiled.body_pos, (2, 1, 1))
    body_pos[1, engine.compiled.body("wall").id, 0] -= 0.01
    variants = Variants(2, fields={"body_pos": body_pos})
    rollout = warp_engine.run(variants, ctrl, record=[STEPS])
    np.testing.assert_allclose(rollout.qpos, engine.run(variants, ctrl, record=[STEPS]).qpos, atol=1e-4)
    assert abs(rollout.qpos[0] - rollout.qpos[1]).max() > 1e-3


def test_field_that_worlds_share_names_the_other_engine(warp_engine, ctrl):
    fields = {"actuator_damping": np.ones((1, 1))}
    with pytest.raises(EngineError, match="use MujocoEngine"):
        warp_engine.run(Variants(1, fields=fields), ctrl)


def test_model_that_warp_cannot_simulate_names_the_other_engine(model, ctrl):
    unsupported = model.scene.xml.replace('timestep="0.005"', 'timestep="0.005" solver="PGS"')
    with pytest.raises(EngineError, match="use MujocoEngine"):
        WarpEngine(replace(model, scene=replace(model.scene, xml=unsupported)), device="cpu").run(Variants(1), ctrl)


def test_buffer_sizes_come_from_a_short_list():
    assert [_rung(x) for x in (1, 16, 17, 24.5, 33, 49, 96.0, 97)] == [16, 16, 24, 32, 48, 64, 96, 128]


def test_runge_kutta_records_the_state_before_its_stages(ctrl):
    warp_engine = WarpEngine(make_model("RK4"), device="cpu")
    rollout = warp_engine.run(Variants(1), ctrl[:40], bodies=["pusher"])
    np.testing.assert_allclose(rollout.body_position[0, :, 0, 0], -0.06 + rollout.qpos[0, :, 0], atol=1e-6)
