import numpy as np
import pytest
from small_worlds import BALL, BLOCK, G, move, world

from concent_warp.effects.library.world import AirDrag, GravityTilt, Wind
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

MASS, RADIUS = 0.4, 0.05
AREA = np.pi * RADIUS**2
BLUNT = 0.5
"""MuJoCo's coefficient of blunt drag: F = BLUNT density area v^2, which for a sphere is a drag factor of 1."""
HIGH = [0, 0, 50, 1, 0, 0, 0]


@pytest.mark.parametrize(("tilt", "direction"), [((0.05, 0), (0, 1)), ((0, 0.05), (-1, 0))])
def test_block_without_friction_slides_down_a_tilted_table(tilt, direction):
    model = world(BLOCK.replace('friction="0.3"', 'friction="0"'), GravityTilt(), *tilt)
    block = move(model, 0.5)
    np.testing.assert_allclose(block.qvel[-1, :2], 0.5 * G * np.sin(0.05) * np.array(direction), atol=2e-3)


def test_block_with_friction_slides_once_the_tilt_is_beyond_the_angle_of_friction():
    for tilt, slides in ((0.28, False), (0.30, True)):
        block = move(world(BLOCK, GravityTilt(), tilt, 0.0), 1.0)
        assert (block.qpos[-1, 1] > 0.02) == slides, tilt


def test_falling_ball_nears_its_terminal_velocity_as_the_hyperbolic_tangent():
    density = 60.0
    ball = move(world(BALL, AirDrag("thing"), density), 3.0, qpos=HIGH)
    terminal = np.sqrt(MASS * G / (density * AREA * BLUNT))
    expected = -terminal * np.tanh(G * ball.time / terminal)
    np.testing.assert_allclose(ball.qvel[:, 2], expected, rtol=0.01, atol=0.01)


def test_wind_takes_a_weightless_ball_along():
    xml = BALL.replace('timestep="0.001"', 'timestep="0.001" gravity="0 0 0"')
    ball = move(world(xml, Wind("thing"), 20.0, 0.0, 0.0), 2.0, qpos=HIGH)
    rate = 1.2 * AREA * BLUNT * 20 / MASS
    np.testing.assert_allclose(ball.qvel[:, 0], 20 - 20 / (1 + rate * ball.time), atol=0.005)


def test_wind_blows_with_the_density_that_drag_has_found():
    xml = BALL.replace('timestep="0.001"', 'timestep="0.001" gravity="0 0 0"')
    model = world(xml, AirDrag("thing"), 30.0).add(Wind("thing"), [0.0, -3.0, 0.0])
    ball = move(model, 1.0, qpos=HIGH)
    rate = 30.0 * AREA * BLUNT * 3 / MASS
    assert ball.qvel[-1, 1] == pytest.approx(-3 + 3 / (1 + rate), abs=0.01)


def test_air_acts_on_the_free_body_alone():
    arm = """<mujoco><option timestep="0.001"/><worldbody>
      <body name="arm" pos="0 0 1"><joint name="j" axis="0 1 0"/><geom size="0.05" pos="0.3 0 0" mass="0.1"/></body>
      <body name="thing" pos="0 0 20"><freejoint/><geom size="0.05" mass="0.4"/></body></worldbody></mujoco>"""
    plain, air = move(world(arm), 0.5), move(world(arm, AirDrag("thing"), 100.0), 0.5)
    np.testing.assert_allclose(air.qpos[:, 0], plain.qpos[:, 0], atol=1e-9)
    assert air.qpos[-1, 3] > plain.qpos[-1, 3] + 0.05


def test_air_meets_the_shape_of_the_scene_and_not_the_spheres_of_its_contacts():
    spheres = ContactGeometry(
        bodies=("thing",),
        body=np.zeros(20, dtype=int),
        position=np.random.default_rng(0).normal(0, 0.02, (20, 3)),
        radius=np.full(20, 0.02),
        mass=np.full(20, MASS / 20),
        friction=np.full(20, 0.3),
    )
    drawn = move(world(BALL, AirDrag("thing"), 60.0), 0.5, qpos=HIGH)
    covered = move(world(BALL).with_geometry(spheres).add(AirDrag("thing"), [60.0]), 0.5, qpos=HIGH)
    np.testing.assert_allclose(covered.qpos, drawn.qpos, atol=1e-9)


def test_model_in_a_medium_keeps_its_fluid_model():
    medium = BALL.replace('timestep="0.001"', 'timestep="0.001" density="40"')
    plain, null = move(world(medium), 0.5, qpos=HIGH), move(world(medium).add(AirDrag("thing")), 0.5, qpos=HIGH)
    np.testing.assert_array_equal(null.qpos, plain.qpos)
