"""The world on Drake obeys physics that are known, and hidden effects show; where Drake is installed."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from benchmarks.independent.drake.hidden import INSIDE
from benchmarks.independent.drake.outside import OUTSIDE
from benchmarks.independent.drake.rig import DrakeTrial, DriveState, Friction, Physics, true_physics
from benchmarks.independent.drake.rigs import DRAKE_RIGS
from benchmarks.independent.drake_world import OUTSIDES, SINGLES, drake_sets, make_drake, true_model, with_starts

pytest.importorskip("pydrake")
NULL = {
    **{"actuator_gain": 1.0, "actuator_saturation": 1e6, "mass": 1.0, "inertia": 1.0, "size": 1.0},
    **{"joint_compliance": 0.0},
}
"""Magnitudes at which an effect does nothing, where they are not 0."""
SETTERS = {"sliding_friction": "friction", "contact_compliance": "damping_ratio"}
"""Effects whose magnitude replaces a value of the world."""


def nominal_physics(rig):
    """Return the world with nominal values."""
    v = dict(rig.values)
    return Physics(
        v,
        {d.actuator: DriveState(armature=v[d.armature]) for d in rig.drives},
        {joint: Friction(v[name]) for joint, name in rig.friction.items()},
        {joint: v[name] for joint, name in rig.damping.items()},
    )


def simulated(rig, physics, trial):
    """Return the true motion."""
    from benchmarks.independent.drake.simulation import simulate

    return simulate(rig, physics, trial)


def brief(rig, seconds=1.0, seed=3):
    """Return a motion of a rig, cut off."""
    trial = rig.plan(np.random.default_rng(seed))
    return replace(trial, duration=min(seconds, trial.duration))


def seen(rig, physics, trial):
    """Return what there is to see of all sensors, without instruments but with hidden measurement effects."""
    from benchmarks.independent.drake.recording import truth_of

    motion = simulated(rig, physics, trial)
    found = {}
    for s in rig.sensors:
        time, value = motion.time, truth_of(rig, physics, s, motion)
        for measure in physics.measures:
            time, value = measure(s.name, time, value)
        found[s.name] = np.column_stack([time, value])
    return found


def test_a_ball_in_free_flight_falls_with_g_and_keeps_its_horizontal_speed():
    rig = DRAKE_RIGS["bounce"]
    trial = DrakeTrial(0.3, pose=(0, 0, 2, 1, 0, 0, 0), velocity=(1.0, -0.5, 0.4, 0, 0, 0), before=0.0)
    motion = simulated(rig, nominal_physics(rig), trial)
    t, position = motion.time, motion.poses["ball"][:, :3]
    drop = 2 + 0.4 * t - 0.5 * 9.81 * t**2
    assert position[:, 2] == pytest.approx(drop, abs=9.81 * t[-1] * rig.step)
    assert position[:, :2] == pytest.approx(np.outer(t, [1.0, -0.5]), abs=1e-9)


def test_a_swinging_weight_without_drive_and_friction_keeps_its_energy():
    rig = DRAKE_RIGS["swing"]
    physics = nominal_physics(rig)
    v = physics.values
    physics.friction.clear()
    physics.damping["axle"] = 0.0
    v["kp"] = v["kv"] = 0.0
    trial = DrakeTrial(3.0, {"servo": (np.array([0.0]), np.array([1.2]))}, before=0.0)
    motion = simulated(rig, physics, trial)
    angle = motion.joints["axle"]
    speed = np.gradient(angle, motion.time)
    whole = v["inertia"] + v["mass"] * v["center"] ** 2 + v["armature"]
    energy = 0.5 * whole * speed**2 - v["mass"] * 9.81 * v["center"] * np.cos(angle)
    assert np.ptp(energy[2:-2]) < 0.01 * v["mass"] * 9.81 * v["center"]
    assert angle.max() == pytest.approx(1.2, abs=2e-3)


def test_a_spinning_brick_keeps_its_angular_momentum():
    rig = DRAKE_RIGS["toss"]
    physics = nominal_physics(rig)
    motion = simulated(rig, physics, DrakeTrial(0.6, pose=(0, 0, 1, 1, 0, 0, 0), velocity=(0, 0, 2, 1.0, 6.0, -3.0)))
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(motion.poses["brick"][:, 3:], scalar_first=True)
    span = 4
    rate = (turn[:-span].inv() * turn[span:]).as_rotvec() / (motion.time[span] - motion.time[0])
    middle = turn[span // 2 : -(span // 2)]
    inertia = np.array([physics.values[f"inertia_{axis}"] for axis in "xyz"])
    momentum = middle.apply(inertia * rate)
    assert np.ptp(momentum, axis=0).max() < 2e-3 * np.linalg.norm(momentum[0])


def test_coulomb_friction_slows_a_block_down():
    rig = DRAKE_RIGS["launch"]
    trial = DrakeTrial(0.25, pose=(0, 0, 0, 1, 0, 0, 0), velocity=(0.9, 0, 0, 0, 0, 0))
    motion = simulated(rig, nominal_physics(rig), trial)
    speed = np.interp([0.02, 0.22], motion.time, np.gradient(motion.poses["block"][:, 0], motion.time))
    assert speed[0] - speed[1] == pytest.approx(0.2 * rig.values["friction"] * 9.81, rel=0.002)
    assert motion.poses["block"][-1, 2] == pytest.approx(rig.values["half_z"], abs=1e-4)


def test_a_ball_rebounds_as_a_mass_on_a_spring_and_damper():
    rig = DRAKE_RIGS["bounce"]
    trial = DrakeTrial(0.55, pose=(0, 0, 0.4, 1, 0, 0, 0), before=0.0)
    motion = simulated(rig, nominal_physics(rig), trial)
    height = motion.poses["ball"][:, 2] - rig.values["radius"]
    lowest = int(np.argmin(height))
    ratio = rig.values["damping_ratio"]
    damped = np.sqrt(1 - ratio**2)
    # The ball leaves when the force is 0, before the spring is at rest.
    restitution = np.exp(-ratio / damped * np.arctan2(2 * ratio * damped, 2 * ratio**2 - 1))
    rebound = np.sqrt(height[lowest:].max() / height[0])
    assert rebound == pytest.approx(restitution, abs=0.01)


def test_a_ball_skids_until_it_rolls():
    rig = DRAKE_RIGS["roll"]
    trial = DrakeTrial(1.0, pose=(0, 0, 0, 1, 0, 0, 0), velocity=(0.8, 0, 0, 0, 0, 0), before=0.0)
    motion = simulated(rig, nominal_physics(rig), trial)
    speed = np.gradient(motion.poses["ball"][:, 0], motion.time)
    assert speed[-10] == pytest.approx(0.8 * 5 / 7, rel=0.01)


@pytest.mark.parametrize("name", DRAKE_RIGS)
def test_masses_of_the_world_are_those_of_the_scene(name):
    from benchmarks.independent.drake.simulation import build

    rig = DRAKE_RIGS[name]
    world = build(rig, nominal_physics(rig))
    model = rig.scene.model
    for b in range(1, model.nbody):
        body = world.plant.GetBodyByName(model.body(b).name)
        inertia = body.default_spatial_inertia()
        assert inertia.get_mass() == pytest.approx(model.body_mass[b])
        assert inertia.get_com() == pytest.approx(model.body_ipos[b], abs=1e-9)
        central = inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[b])
        axes = turn.reshape(3, 3)
        assert central == pytest.approx(axes @ np.diag(model.body_inertia[b]) @ axes.T, abs=1e-9)


CASES = [(rig, effect, values[1]) for rig, effects in SINGLES.items() for effect, values in effects.items()]


@pytest.mark.parametrize(("name", "effect", "magnitude"), [*CASES, *OUTSIDES], ids=lambda x: str(x))
def test_a_hidden_effect_shows(name, effect, magnitude):
    rig = DRAKE_RIGS[name]
    seconds = 3.0 if rig.drives and effect in OUTSIDE else 2.0
    noise = {"angle": 6e-4, "fine_angle": 4e-4, "travel": 1e-4, "marker": 4e-4, "position": 9e-4, "orientation": 9e-3}
    kinds = {s.name: s.kind for s in rig.sensors}
    plain, changed = true_physics(rig, 1), true_physics(rig, 1)
    (INSIDE | OUTSIDE)[effect](rig, changed, magnitude)
    if effect == "latency":
        assert changed.sensor_delay == magnitude
        return
    largest = 0.0
    for seed in range(min(rig.throws, 3)):
        trial = brief(rig, seconds, seed)
        before, after = seen(rig, plain, trial), seen(rig, changed, trial)
        largest = max(largest, *(np.abs(after[n] - before[n]).max() / noise[kinds[n]] for n in before))
    assert largest > 3


@pytest.mark.parametrize(("name", "effect"), [(r, e) for r, e, _ in CASES if e != "wind"], ids=lambda x: str(x))
def test_an_effect_of_no_size_changes_nothing(name, effect):
    rig = DRAKE_RIGS[name]
    trial = brief(rig, 0.4)
    plain, changed = true_physics(rig, 1), true_physics(rig, 1)
    magnitude = changed.values[SETTERS[effect]] if effect in SETTERS else NULL.get(effect, 0.0)
    if effect == "gravity_tilt":
        magnitude = 1e-15
    INSIDE[effect](rig, changed, magnitude)
    before, after = seen(rig, plain, trial), seen(rig, changed, trial)
    for sensor in before:
        assert after[sensor] == pytest.approx(before[sensor], abs=1e-9)


def test_data_sets_are_reproducible_and_do_not_depend_on_one_another():
    (case,) = (c for c in drake_sets() if c.name == "drake-launch-null-0")
    first, again = make_drake(case), make_drake(case)
    other = make_drake(replace(case, seed=7))
    for a, b, c in zip(
        first.recording.demonstrations, again.recording.demonstrations, other.recording.demonstrations, strict=True
    ):
        for name in a.measured:
            np.testing.assert_array_equal(a.measured[name].value, b.measured[name].value)
            np.testing.assert_array_equal(a.measured[name].time, b.measured[name].time)
            assert not np.array_equal(a.measured[name].time[:5], c.measured[name].time[:5])
    held = first.held_out.demonstrations[0].measured["block_position"]
    assert not np.array_equal(held.time[:5], first.recording.demonstrations[0].measured["block_position"].time[:5])


def test_noise_is_stated_as_the_data_set_says_and_always_held_out():
    (case,) = (c for c in drake_sets() if c.name == "drake-launch-null-0")
    for told in (True, False):
        made = make_drake(replace(case, noise_stated=told))
        channels = [c for d in made.recording.demonstrations for c in d.measured.values()]
        assert all((c.noise_std is not None) == told for c in channels)
        assert all(c.noise_std is not None for d in made.held_out.demonstrations for c in d.measured.values())


@pytest.mark.parametrize("effect", ["joint_friction-large", "joint_damping-middle"])
def test_the_library_does_not_reproduce_the_world_exactly_but_comes_nearer(effect):
    from benchmarks.diagnose.hidden_effects_residual import ratios
    from concent_warp.model import Model

    (case,) = (c for c in drake_sets() if c.name == f"drake-swing-{effect}")
    recording, scene, truth = with_starts(case)
    model = true_model(scene, truth)
    assert model is not None
    nominal, true = (ratios(m, recording)["axle_encoder"] for m in (Model(scene), model))
    assert true > 1.2
    assert nominal > 1.5 * true
