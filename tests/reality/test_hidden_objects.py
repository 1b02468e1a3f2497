"""Hidden effects on objects, contacts, air and instruments have the size that is asked for."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.reality.hidden.registry import hidden
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.reality.rigs.rig import RigTrial, perform, record_rig

SLIDE, DROP, SPIN = RIGS["slide"], RIGS["drop"], RIGS["spin"]
FLAT = [0.01 - 1e-5, 1, 0, 0, 0]


def stopping_distance(velocity: tuple[float, float], name: str, magnitude: float, x: float = 0.0) -> float:
    """Launch the block [m/s] from (x, 0) and return how far it gets [m]."""
    made = hidden(name, magnitude, SLIDE)
    model = SLIDE.world([made.effect]).compile()
    trial = RigTrial(
        0.8, qpos={"block_joint": [x, 0.0, *FLAT]}, qvel={"block_joint": [*velocity, 0, 0, 0, 0]}, settling_time=0.1
    )
    motion, _, _ = perform(model, trial, [made.effect], SLIDE.physics)
    return float(np.linalg.norm(motion.sensordata[-1, :2] - motion.sensordata[0, :2]))


@pytest.mark.parametrize("coefficient", [0.2, 0.45])
def test_hidden_friction_stops_the_block_after_v_squared_over_2_mu_g(coefficient: float):
    distance = stopping_distance((0.8, 0.0), "sliding_friction", coefficient)
    assert distance == pytest.approx(0.8**2 / (2 * coefficient * 9.81), rel=0.02)


def test_grain_acts_along_y_only():
    along = stopping_distance((0.8, 0.0), "anisotropic_friction", 1.5)
    across = stopping_distance((0.0, 0.8), "anisotropic_friction", 1.5)
    assert along == pytest.approx(0.8**2 / (2 * 0.3 * 9.81), rel=0.02)
    assert along / across == pytest.approx(1.5, rel=0.02)


def test_patch_is_rough_where_it_is_and_nowhere_else():
    plain, rough = (stopping_distance((0.8, 0.0), "patch", 0.3, x) for x in (-0.5, -0.1))
    assert plain == pytest.approx(0.8**2 / (2 * 0.3 * 9.81), rel=0.02)
    assert rough < 0.95 * plain


def flight(name: str, magnitude: float, velocity: tuple[float, float, float], duration: float = 0.3) -> np.ndarray:
    """Throw the ball from 5 m and return where it is after a while against where it would be in the void [m]."""
    made = hidden(name, magnitude, DROP)
    model = DROP.world([made.effect]).compile()
    start = [0, 0, 5.0, 1, 0, 0, 0]
    trial = RigTrial(duration, qpos={"ball_joint": start}, qvel={"ball_joint": [*velocity, 0, 0, 0]})
    seen, _, _ = perform(model, trial, [made.effect], DROP.physics)
    void, _, _ = perform(DROP.world().compile(), trial, [], DROP.physics)
    return seen.sensordata[-1, :3] - void.sensordata[-1, :3]


def test_drag_slows_by_half_rho_a_v_squared():
    density, speed, duration = 2.0, 4.0, 0.2
    slowed = flight("air_drag", density, (speed, 0.0, 0.0), duration)
    rate = 0.5 * density * np.pi * 0.04**2 / 0.4
    # x'' = -rate v x' with v near the launch's, falling adds little in this time.
    assert -slowed[0] == pytest.approx(0.5 * rate * speed**2 * duration**2, rel=0.06)


def test_wind_carries_a_ball_that_was_only_let_go():
    way = flight("wind", 4.0, (0.0, 0.0, 0.0))
    assert way[0] < 0 < way[1]
    assert way[1] == pytest.approx(-0.5 * way[0], rel=0.02)


def test_tilt_pushes_to_the_side_by_its_angle():
    way = flight("gravity_tilt", 0.02, (0.0, 0.0, 0.0))
    fall = 0.5 * 9.81 * 0.3**2
    assert way[1] == pytest.approx(fall * 0.02, rel=0.01)
    assert way[0] == pytest.approx(fall * 0.012, rel=0.01)


def test_torsional_friction_stops_a_spin_after_its_torque():
    coefficient, spin = 0.0006, 6.0
    made = hidden("torsional_friction", coefficient, SPIN)
    model = SPIN.world([made.effect]).compile()
    start = [0, 0, 0.03 - 1e-4, 1, 0, 0, 0]
    trial = RigTrial(0.2, qpos={"ball_joint": start}, qvel={"ball_joint": [0, 0, 0, 0, 0, spin]}, settling_time=0.2)
    motion, _, _ = perform(model, trial, [made.effect], SPIN.physics)
    turned = 2 * np.arctan2(motion.sensordata[-1, 6], motion.sensordata[-1, 3])
    slowing = coefficient * 9.81 / (0.4 * 0.03**2)
    assert turned == pytest.approx(spin * 0.2 - 0.5 * slowing * 0.2**2, rel=0.02)


@pytest.mark.parametrize(("name", "factor"), [("mass", 1.4), ("inertia", 1.4)])
def test_mass_and_inertia_scale_what_they_name(name: str, factor: float):
    rig = RIGS["tumble"]
    drawn, world = rig.world().compile(), rig.world([hidden(name, factor, rig).effect]).compile()
    box = drawn.body("box").id
    heavier = factor if name == "mass" else 1.0
    assert world.body_mass[box] == pytest.approx(heavier * drawn.body_mass[box])
    np.testing.assert_allclose(world.body_inertia[box], factor * drawn.body_inertia[box])


def test_worn_box_keeps_mass_and_inertia_and_reaches_farther_at_one_corner():
    rig = RIGS["push"]
    world = rig.world([hidden("contact_geometry", 0.003, rig).effect]).compile()
    block = world.body("block").id
    np.testing.assert_allclose(world.body_inertia[block], rig.world().compile().body_inertia[block])
    geom = int(world.body_geomadr[block])
    vertices = world.mesh_vert[world.mesh_vertadr[world.geom_dataid[geom]] :][: world.mesh_vertnum[0]]
    placed = Rotation.from_quat(world.geom_quat[geom], scalar_first=True).apply(vertices) + world.geom_pos[geom]
    assert placed[:, 0].max() == pytest.approx(0.043, abs=1e-6)
    assert placed[:, 0].min() == pytest.approx(-0.04, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "magnitude"), [("time_base", 0.01), ("latency", 0.02), ("length_scale", 0.02), ("frame_offset", 0.01)]
)
def test_instruments_distort_what_is_written_and_nothing_else(name: str, magnitude: float):
    made = hidden(name, magnitude, DROP)
    true, seen = (record_rig(DROP, effects)[0].measured["ball_position"] for effects in ([], [made.effect]))
    shift = np.array([made.truth.get(axis, 0.0) for axis in "xyz"])
    turn = Rotation.from_rotvec([made.truth.get(axis, 0.0) for axis in ("rx", "ry", "rz")])
    scale = made.truth.get("scale", 0.0)
    time = true.time * (1 + scale) if name == "time_base" else true.time + made.truth.get("delay", 0.0)
    value = true.value * (1 + scale) if name == "length_scale" else turn.apply(true.value) + shift
    np.testing.assert_allclose(seen.time, time)
    np.testing.assert_allclose(seen.value, value)


def test_weak_grip_lets_the_block_go():
    rig = RIGS["grasp"]
    made = hidden("grip_force", 0.3, rig)
    assert made.target == ("gripper",)
    height = record_rig(rig, [made.effect])[0].measured["block_position"].value[:, 2]
    assert height.max() < 0.06


def test_slosh_keeps_the_mass():
    rig = RIGS["tumble"]
    world = rig.world([hidden("slosh", 0.3, rig).effect]).compile()
    assert mujoco.mj_getTotalmass(world) == pytest.approx(mujoco.mj_getTotalmass(rig.scene.model))
