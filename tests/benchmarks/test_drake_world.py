"""The world on Drake obeys physics that are known, and hidden effects show; where Drake is installed."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.independent.drake.rigs import DRAKE_RIGS
from benchmarks.independent.drake_world import DRAKE, OUTSIDES, SINGLES
from benchmarks.independent.foreign.rig import ForeignTrial
from benchmarks.independent.foreign.world import true_model
from tests.benchmarks.foreign_worlds import (
    check_that_an_effect_of_no_size_changes_nothing,
    check_that_an_effect_shows,
    check_that_noise_is_stated_as_the_set_says,
    check_that_sets_are_reproducible_and_do_not_depend_on_one_another,
    nominal_physics,
)

pytest.importorskip("pydrake")


def simulated(rig, physics, trial):
    """Return the true motion."""
    from benchmarks.independent.drake.simulation import simulate

    return simulate(rig, physics, trial)


def test_a_ball_in_free_flight_falls_with_g_and_keeps_its_horizontal_speed():
    rig = DRAKE_RIGS["bounce"]
    trial = ForeignTrial(0.3, pose=(0, 0, 2, 1, 0, 0, 0), velocity=(1.0, -0.5, 0.4, 0, 0, 0), before=0.0)
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
    trial = ForeignTrial(3.0, {"servo": (np.array([0.0]), np.array([1.2]))}, before=0.0)
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
    motion = simulated(rig, physics, ForeignTrial(0.6, pose=(0, 0, 1, 1, 0, 0, 0), velocity=(0, 0, 2, 1.0, 6.0, -3.0)))
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
    trial = ForeignTrial(0.25, pose=(0, 0, 0, 1, 0, 0, 0), velocity=(0.9, 0, 0, 0, 0, 0))
    motion = simulated(rig, nominal_physics(rig), trial)
    speed = np.interp([0.02, 0.22], motion.time, np.gradient(motion.poses["block"][:, 0], motion.time))
    assert speed[0] - speed[1] == pytest.approx(0.2 * rig.values["friction"] * 9.81, rel=0.002)
    assert motion.poses["block"][-1, 2] == pytest.approx(rig.values["half_z"], abs=1e-4)


def test_a_ball_rebounds_as_a_mass_on_a_spring_and_damper():
    rig = DRAKE_RIGS["bounce"]
    trial = ForeignTrial(0.55, pose=(0, 0, 0.4, 1, 0, 0, 0), before=0.0)
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
    trial = ForeignTrial(1.0, pose=(0, 0, 0, 1, 0, 0, 0), velocity=(0.8, 0, 0, 0, 0, 0), before=0.0)
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
    check_that_an_effect_shows(simulated, DRAKE_RIGS[name], effect, magnitude)


@pytest.mark.parametrize(("name", "effect"), [(r, e) for r, e, _ in CASES if e != "wind"], ids=lambda x: str(x))
def test_an_effect_of_no_size_changes_nothing(name, effect):
    check_that_an_effect_of_no_size_changes_nothing(simulated, DRAKE_RIGS[name], effect)


def test_data_sets_are_reproducible_and_do_not_depend_on_one_another():
    check_that_sets_are_reproducible_and_do_not_depend_on_one_another(DRAKE, "drake-launch-null-0", "block_position")


def test_noise_is_stated_as_the_data_set_says_and_always_held_out():
    check_that_noise_is_stated_as_the_set_says(DRAKE, "drake-launch-null-0")


@pytest.mark.parametrize("effect", ["joint_friction-large", "joint_damping-middle"])
def test_the_library_does_not_reproduce_the_world_exactly_but_comes_nearer(effect):
    from benchmarks.diagnose.hidden_effects_residual import ratios
    from concent_warp.model import Model

    (case,) = (c for c in DRAKE.sets() if c.name == f"drake-swing-{effect}")
    recording, scene, truth = DRAKE.with_starts(case)
    model = true_model(scene, truth)
    assert model is not None
    nominal, true = (ratios(m, recording)["axle_encoder"] for m in (Model(scene), model))
    assert true > 1.2
    assert nominal > 1.5 * true
