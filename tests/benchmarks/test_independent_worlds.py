"""Data sets of the benchmark on independent worlds: the split, the recordings, and that truth does not fit exactly."""

import json
import time
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from concent_warp.recording.validation.validate import validate


@pytest.fixture
def worlds(script):
    return script("benchmarks.independent.worlds")


@pytest.fixture
def split(script):
    return script("benchmarks.independent.split")


def named(worlds, name):
    (case,) = (c for c in worlds.all_sets() if c.name == name)
    return case


def test_the_locked_sets_are_those_of_the_rule(worlds, split):
    written = json.loads(split.PATH.read_text())
    by_rule = split.by_rule(worlds.all_sets())
    assert written == by_rule
    assert len(written["locked_rigs"]) == 2
    assert not set(written["locked"]) & set(written["development"])


def test_about_a_quarter_of_effects_and_rigs_is_locked_and_sets_of_one_key_stay_together(worlds, split):
    cases = [c for c in worlds.all_sets() if c.world == "mujoco" and c.rig not in split.locked_rigs()]
    keys = {c.key: split.locked_by_rule(c) for c in cases if c.kind != "null"}
    assert 0.15 < np.mean(list(keys.values())) < 0.35
    assert all(keys[c.key] == split.locked_by_rule(c) for c in cases if c.kind != "null")


def test_there_are_enough_sets_of_every_kind(worlds):
    cases = [c for c in worlds.all_sets() if c.world == "mujoco"]
    count = {kind: sum(c.kind == kind for c in cases) for kind in ("null", "single", "outside", "pair", "geometry")}
    assert count["null"] >= 30
    assert count["outside"] >= 24
    assert count["pair"] >= 24
    assert count["geometry"] >= 12
    assert len({c.name for c in cases}) == len(cases)
    assert 0.4 < np.mean([c.noise_stated for c in cases]) < 0.6
    assert {c.rig for c in cases if c.kind == "null"} == {c.rig for c in cases}


def test_locked_sets_are_chosen_only_when_asked_for(script, worlds):
    program = script("benchmarks.independent.__main__")
    locked = script("benchmarks.independent.split").locked_names()
    cases = worlds.all_sets()
    chosen = {c.name for c in cases if program.wanted(c, program.Args())}
    assert chosen
    assert not chosen & locked
    assert {c.name for c in cases if program.wanted(c, program.Args(locked=True))} == locked


@pytest.mark.parametrize("name", ["drop-null-0", "tumble-null-0"])
def test_recordings_are_valid_repeat_themselves_and_state_noise_as_they_should(worlds, name):
    case = named(worlds, name)
    for stated in (True, False):
        data = worlds.make(replace(case, noise_stated=stated))
        validate(data.recording)
        assert all(
            (c.noise_std is not None) == stated for d in data.recording.demonstrations for c in d.measured.values()
        )
        assert all(c.noise_std for d in data.held_out.demonstrations for c in d.measured.values())
    again = worlds.make(replace(case, noise_stated=False))
    for first, second in zip(data.recording.demonstrations, again.recording.demonstrations, strict=True):
        for channel in first.measured:
            assert np.array_equal(first.measured[channel].value, second.measured[channel].value, equal_nan=True)
    assert not np.array_equal(data.recording[0].qpos, data.held_out[0].qpos)


def test_recordings_made_elsewhere_are_those_made_here(worlds, script, tmp_path):
    kept, program = script("benchmarks.independent.kept_data"), script("benchmarks.independent.data_sets")
    cases = [replace(named(worlds, name), noise_stated=False) for name in ("drop-null-0", "drop-air_drag-large")]
    program.save_all(cases, tmp_path)
    for case in cases:
        assert kept.is_kept(case, tmp_path)
        there, here = kept.load(case, tmp_path), worlds.make(case)
        assert there.truth == here.truth
        assert there.scene.xml == here.scene.xml
        for a, b in ((there.recording, here.recording), (there.held_out, here.held_out)):
            assert len(a.demonstrations) == len(b.demonstrations)
            for first, second in zip(a.demonstrations, b.demonstrations, strict=True):
                assert first.measured.keys() == second.measured.keys()
                for name, channel in first.measured.items():
                    other = second.measured[name]
                    assert np.array_equal(channel.value, other.value, equal_nan=True)
                    assert np.array_equal(channel.time, other.time)
                    assert channel.noise_std == other.noise_std
    assert not kept.is_kept(cases[0], tmp_path / "other")


def test_a_world_that_is_not_installed_is_diagnosed_from_recordings_only(script, worlds, tmp_path, monkeypatch):
    program, kept = script("benchmarks.independent.__main__"), script("benchmarks.independent.kept_data")
    case = named(worlds, "drake-launch-null-1")
    monkeypatch.setattr(program, "find_spec", lambda _: None)
    ended = {"truth": [], "error": "time-out", "seconds": 1.0}
    monkeypatch.setattr(program, "in_process", lambda case, *_: (program.described(case) | ended, 1.0))
    with pytest.raises(SystemExit, match="needs the package drake"):
        program.run([case], program.Args(out=tmp_path))
    kept.save(case, worlds.make(replace(named(worlds, "drop-null-0"), noise_stated=False)), tmp_path)
    program.run([case], program.Args(out=tmp_path, recordings=tmp_path))


def test_instruments_quantise_lose_readings_and_are_late(script):
    instruments = script("benchmarks.independent.instruments")
    encoder = instruments.Instrument(200.0, 0.0, step=0.01, latency=0.02, lost=0.1, occlusions=1.0)
    time = np.arange(0, 20.0, 1e-3)
    channel = encoder.read(time, time[:, None], np.random.default_rng(0))
    seen = np.isfinite(channel.value[:, 0])
    assert np.allclose(channel.value[seen] / 0.01, np.round(channel.value[seen] / 0.01))
    assert 0.85 < len(channel.time) / 4000 < 0.95
    assert 0.01 < 1 - seen.mean() < 0.2
    lag = (channel.time - channel.value[:, 0])[seen][50:]
    assert lag.mean() == pytest.approx(0.02, abs=1e-3)
    assert encoder.std == pytest.approx(0.01 / np.sqrt(12))


def test_noise_has_the_stated_std(script):
    instrument = script("benchmarks.independent.instruments").Instrument(100.0, 3e-3, 1e-3, step=4e-3)
    time = np.arange(0, 400.0, 0.01)
    channel = instrument.read(time, np.full((len(time), 3), 0.2345), np.random.default_rng(0))
    assert (channel.value - 0.2345).std() == pytest.approx(instrument.std, rel=0.03)


def test_tolerances_are_within_a_hundredth_and_differ_between_seeds(script):
    rigs = script("benchmarks.independent.mujoco_rigs")
    nominal = rigs.EXPERIMENTS["push"].rig.scene
    worlds = []
    for seed in (0, 1):
        spec = nominal.spec()
        rigs.draw_tolerances(spec, seed)
        worlds.append(spec.compile())
    m = nominal.model
    block = m.body("block").id
    for world in worlds:
        for field in ("body_mass", "geom_size", "actuator_gainprm"):
            a, b = getattr(m, field), getattr(world, field)
            ratio = b[a > 0] / a[a > 0]
            assert np.abs(ratio - 1).max() <= 0.01 + 1e-9
        assert world.body_mass[block] != m.body_mass[block]
        size = 2 * (world.geom_size[m.body_geomadr[block]] - m.geom_size[m.body_geomadr[block]])
        assert 0 < np.abs(size).max() <= 3e-4
    assert worlds[0].body_mass[block] != worlds[1].body_mass[block]


def test_the_world_has_another_step_integrator_and_contacts_and_no_compensation(script):
    rigs = script("benchmarks.independent.mujoco_rigs")
    for name, experiment in rigs.EXPERIMENTS.items():
        assert not experiment.rig.physics.lead, name
        assert not experiment.rig.physics.armature, name
        if experiment.rig.recorder is not None:
            continue
        nominal = experiment.rig.scene.model
        world = experiment.world(0, experiment.contact, []).compile()
        assert world.opt.timestep < nominal.opt.timestep
        assert world.opt.integrator != nominal.opt.integrator
        if nominal.ngeom and experiment.rig.surface:
            assert experiment.contact is not None or not np.array_equal(world.geom_solref, nominal.geom_solref)


def test_bristles_hold_below_their_level_and_slip_above_it(script):
    lugre = script("benchmarks.independent.lugre")
    xml = """<mujoco><option timestep="2.5e-4" gravity="0 0 0"/><worldbody><body>
    <joint name="hinge" axis="0 1 0"/><geom size="0.05" mass="1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)

    def end(torque):
        data = mujoco.MjData(model)
        friction = lugre.bristles({"hinge": [lugre.constant(0.1)]})
        for _ in range(4000):
            data.qfrc_applied[:] = torque
            friction(model, data)
            mujoco.mj_step(model, data)
        return data

    held, slipping = end(0.08), end(0.12)
    assert 0 < held.qpos[0] < 5 * lugre.PRESLIDING["hinge"]
    assert abs(held.qvel[0]) < 1e-6
    inertia = float(model.dof_M0[0])
    assert slipping.qvel[0] == pytest.approx(0.02 / inertia, rel=0.05)


def test_a_ball_rebounds_alike_from_every_height_on_the_plane(script):
    contact = script("benchmarks.independent.mujoco_rigs").EXPERIMENTS["drop"].contact
    xml = """<mujoco><option timestep="1e-4" integrator="RK4"/><worldbody><body name="ball" pos="0 0 0.04"><freejoint/>
    <geom size="0.04" mass="0.4" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    rebounds = []
    for speed in (3.0, 5.0):
        data = mujoco.MjData(model)
        data.qvel[2] = -speed
        force = contact.force("ball")
        while data.qpos[2] <= 0.04:
            data.xfrc_applied[:] = 0
            force(model, data)
            mujoco.mj_step(model, data)
        rebounds.append(data.qvel[2] / speed)
    assert 0.5 < rebounds[0] < 0.65
    assert rebounds[0] == pytest.approx(rebounds[1], rel=0.02)


@pytest.mark.parametrize(
    ("name", "most"),  # the first one stands for the others
    [
        ("pendulum-joint_friction-middle", 4.0),
        pytest.param("pendulum-backlash-large", 6.0, marks=pytest.mark.slow),
        pytest.param("slide-gravity_tilt-large", 2.0, marks=pytest.mark.slow),
        pytest.param("tumble-inertia-large", 2.0, marks=pytest.mark.slow),
    ],
)
def test_truth_explains_the_data_but_not_exactly(script, worlds, monkeypatch, name, most):
    """The library's effect at its true value leaves a residual that is not the noise: nothing is adjusted to agree."""
    data_sets, case = script("benchmarks.independent.data_sets"), replace(named(worlds, name), demonstrations=1)
    experiments = script("benchmarks.independent.mujoco_rigs").EXPERIMENTS
    rig = experiments[case.rig].rig
    few = replace(experiments[case.rig], rig=replace(rig, throws=min(rig.throws, 3)))
    monkeypatch.setitem(experiments, case.rig, few)
    nominal, truth = data_sets.residual_ratios(worlds.make(case))
    assert max(truth.values()) > 1.01
    assert max(truth.values()) < min(most, 0.85 * max(nominal.values()))


@pytest.mark.slow
def test_the_model_as_given_is_off_by_more_than_noise_where_nothing_is_hidden(script, worlds):
    data_sets = script("benchmarks.independent.data_sets")
    ratios = [
        max(data_sets.residual_ratios(worlds.make(named(worlds, name)))[0].values())
        for name in ("pendulum-null-0", "drop-null-0", "spin-null-0")
    ]
    assert min(ratios) > 1.05
    assert max(ratios) < 3.0


def test_true_values_have_the_errors_of_the_nominal_model(worlds):
    case = named(worlds, "pendulum-actuator_gain-middle")
    gain = worlds.make(case).truth[0].parameters["gain[servo]"]
    assert gain != case.magnitudes["actuator_gain"]
    assert gain == pytest.approx(case.magnitudes["actuator_gain"], rel=0.0101)


def test_a_study_that_takes_too_long_ends_as_time_out(script):
    study = script("benchmarks.independent.study")
    with pytest.raises(study.TimeOut), study.limited(0.05):  # noqa: PT012
        while True:
            sum(range(1000))
    with pytest.raises(study.TimeOut), study.limited(0.05):
        time.sleep(5)
    with study.limited(30.0):
        pass


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"names": ("pendulum-nul-0",)}, "--names has no pendulum-nul-0"),
        ({"rigs": ("arm", "leg")}, "--rigs has no leg"),
        ({"cores": 0}, "--cores must be a positive number; found 0"),
        ({"limit": -3.0}, "--limit must be a positive number; found -3"),
        ({"limit": float("nan")}, "--limit must be a positive number; found nan"),
        ({"earlier": Path("nothere.jsonl")}, "--earlier nothere.jsonl: no such file"),
    ],
)
def test_what_there_is_not_is_refused_before_anything_is_written(script, tmp_path, asked, said):
    program = script("benchmarks.independent.__main__")
    with pytest.raises(SystemExit, match=said):
        program.main(program.Args(out=tmp_path / "results", **asked))
    assert not (tmp_path / "results").exists()


def test_remaining_time_follows_the_sets_that_are_done(script, worlds):
    program = script("benchmarks.independent.__main__")
    cases = [c for c in worlds.all_sets() if c.rig in ("pendulum", "arm") and c.kind == "null"]
    arms = sum(c.rig == "arm" for c in cases)
    pendulums = len(cases) - arms
    guess = program.EXPECTED_SECONDS
    assert program.remaining(cases, {}, 1) == pytest.approx(arms * guess["arm"] + pendulums * guess["pendulum"])
    done = {"pendulum": [2 * guess["pendulum"]]}
    twice = 2 * (arms * guess["arm"] + pendulums * guess["pendulum"])
    assert program.remaining(cases, done, 1) == pytest.approx(twice)
    assert program.remaining(cases, done, 1000) == pytest.approx(2 * guess["arm"])
    assert program.remaining([], done, 2) == 0.0
