import numpy as np
import pytest
from scipy.integrate import solve_ivp
from small_worlds import BALL, BLOCK, FLOOR, GRIPPER, G, move, world

from concent_warp.effects.library.contact import (
    Adhesion,
    AnisotropicFriction,
    ContactCompliance,
    PadFriction,
    RollingFriction,
    SlidingFriction,
    TorsionalFriction,
)
from concent_warp.effects.library.drives import GripForce

MASS, RADIUS = 0.4, 0.05
UPRIGHT = [1, 0, 0, 0]


@pytest.mark.parametrize("mu", [0.15, 0.6])
def test_block_slides_until_friction_has_taken_its_energy(mu):
    block = move(world(BLOCK, SlidingFriction("thing"), mu), 1.2, qvel=[0.8, 0, 0, 0, 0, 0])
    assert block.qpos[-1, 0] == pytest.approx(0.8**2 / (2 * mu * G), rel=0.02)


def test_grain_makes_sliding_along_y_shorter_than_along_x():
    model = world(BLOCK, AnisotropicFriction("thing"), 2.0)
    x = move(model, 0.6, qvel=[0.8, 0, 0, 0, 0, 0]).qpos[-1]
    y = move(model, 0.6, qvel=[0, 0.8, 0, 0, 0, 0]).qpos[-1]
    assert x[0] == pytest.approx(0.8**2 / (2 * 0.3 * G), rel=0.02)
    assert y[1] == pytest.approx(0.8**2 / (2 * 2.0 * 0.3 * G), rel=0.02)
    np.testing.assert_allclose([x[1], y[0]], 0, atol=1e-4)


def test_grain_holds_less_along_y_where_its_ratio_is_below_one():
    block = move(world(BLOCK, AnisotropicFriction("thing"), 0.5), 1.0, qvel=[0, 0.8, 0, 0, 0, 0])
    assert block.qpos[-1, 1] == pytest.approx(0.8**2 / (2 * 0.5 * 0.3 * G), rel=0.02)


def test_anisotropy_of_a_contact_without_friction_has_no_effect():
    slippery = BLOCK.replace('friction="0.3"', 'friction="0.3" condim="1"')
    block = move(world(slippery, AnisotropicFriction("thing"), 2.0), 0.3, qvel=[0, 0.8, 0, 0, 0, 0])
    assert block.qvel[-1, 1] == pytest.approx(0.8, abs=1e-6)


@pytest.mark.parametrize("mu", [0.002, 0.008])
def test_spinning_ball_stands_still_once_torsional_friction_has_taken_its_spin(mu):
    inertia = 0.4 * MASS * RADIUS**2
    seconds = inertia * 10 / (mu * MASS * G)
    ball = move(world(BALL, TorsionalFriction("thing"), mu), 1.3 * seconds, qvel=[0, 0, 0, 0, 0, 10])
    half = np.searchsorted(ball.time, 0.5 * seconds)
    assert ball.qvel[half, 5] == pytest.approx(5, rel=0.02)
    assert abs(ball.qvel[-1, 5]) < 0.05


@pytest.mark.parametrize("mu", [0.0005, 0.002])
def test_rolling_ball_slows_down_at_the_rate_that_rolling_friction_gives(mu):
    ball = move(world(BALL, RollingFriction("thing"), mu), 1.0, qvel=[0.5, 0, 0, 0, 0.5 / RADIUS, 0])
    slower = mu * G / (1.4 * RADIUS)
    left = max(0.5 - slower, 0.0)
    assert ball.qvel[-1, 0] == pytest.approx(left, abs=0.01)
    assert ball.qpos[-1, 0] == pytest.approx((0.5**2 - left**2) / (2 * slower), rel=0.02)


@pytest.mark.parametrize(
    ("effect", "mu", "slower"), [(TorsionalFriction, 2e-4, 1 / 0.4), (RollingFriction, 3e-4, 1 / 1.4)]
)
@pytest.mark.parametrize("cones", ["", 'cone="elliptic"'])
def test_small_friction_against_rotation_is_constant_whatever_cones_the_model_has(effect, mu, slower, cones):
    scene = BALL.replace('cone="elliptic" impratio="10"', cones)
    spin, axis = 5.0, 5 if effect is TorsionalFriction else 4
    speed = [spin * RADIUS if axis == 4 else 0, 0, 0, 0, 0, 0]
    speed[axis] = spin
    ball = move(world(scene, effect("thing"), mu), 0.8, qvel=speed)
    left = spin - mu * G * slower / RADIUS**2 * ball.time
    np.testing.assert_allclose(ball.qvel[:, axis], left, atol=0.03 * (spin - left[-1]))


@pytest.mark.parametrize("effect", [TorsionalFriction, RollingFriction])
def test_friction_of_more_dimensions_does_not_change_sliding(effect):
    plain = move(world(BLOCK), 0.4, qvel=[0.8, 0.3, 0, 0, 0, 0])
    null = move(world(BLOCK).add(effect("thing")), 0.4, qvel=[0.8, 0.3, 0, 0, 0, 0])
    np.testing.assert_allclose(null.qpos, plain.qpos, atol=1e-9)


def bounce(time_constant: float, damping: float, speed: float) -> float:
    """Return the height after an impact on MuJoCo's contact: (1 - d) of free fall, spring and damper until it pulls."""
    d = 0.9
    spring, damper = 1 / (time_constant * damping) ** 2, 2 / time_constant

    def motion(_, state):
        return [state[1], -(1 - d) * G - damper * state[1] - spring * state[0]]

    def lifts(_, state):
        return motion(0, state)[1] + G

    def leaves(_, state):
        return state[0]

    for event, direction in ((lifts, -1), (leaves, 1)):
        vars(event).update(terminal=True, direction=direction)
    found = solve_ivp(motion, (0, 1), [0, -speed], events=[lifts, leaves], max_step=1e-4, rtol=1e-9)
    depth, rebound = found.y[:, -1]
    return depth + rebound**2 / (2 * G)


@pytest.mark.parametrize(("time_constant", "damping"), [(0.02, 0.2), (0.01, 0.5)])
def test_ball_rebounds_as_a_mass_on_the_spring_and_damper_of_its_contact(time_constant, damping):
    xml = BALL.replace('timestep="0.001"', 'timestep="0.0002"').replace("<geom ", '<geom solimp="0.9 0.9 0.001" ')
    start = RADIUS + 1.0**2 / (2 * G)
    model = world(xml, ContactCompliance("thing"), time_constant, damping)
    ball = move(model, 0.7, qpos=[0, 0, start, *UPRIGHT])
    rises = np.argmax(ball.qvel[:, 2] > 0)
    assert ball.qpos[rises:, 2].max() - RADIUS == pytest.approx(bounce(time_constant, damping, 1.0), rel=0.02)


def test_contact_with_stiffness_and_damping_given_directly_rebounds_as_with_its_time_constant():
    fine = BALL.replace('timestep="0.001"', 'timestep="0.0002"')
    direct = fine.replace("<geom ", '<geom solref="-40000 -100" ', 1)
    values = (2 / 60, 60 / (2 * np.sqrt(20000)))
    start = {"qpos": [0, 0, 0.1, *UPRIGHT]}
    one = move(world(direct, ContactCompliance("thing"), *values), 0.5, **start)
    other = move(world(fine, ContactCompliance("thing"), *values), 0.5, **start)
    np.testing.assert_allclose(one.qpos, other.qpos, atol=1e-9)


def test_ball_at_rest_sinks_into_a_softer_contact_by_its_static_sag():
    xml = BALL.replace("<geom ", '<geom solimp="0.9 0.9 0.001" ')
    ball = move(world(xml, ContactCompliance("thing"), 0.05, 1.0), 2.0)
    assert RADIUS - ball.qpos[-1, 2] == pytest.approx((1 - 0.9) * G * 0.05**2, rel=0.01)


def test_contacts_stiffer_than_the_time_step_allows_stay_so_at_the_null_value():
    stiff = BLOCK.replace("<geom ", '<geom solref="0.0005 1" ', 1)
    start = {"qpos": [0, 0, 0.05, 0.9, 0.3, 0.2, 0.1], "qvel": [0.5, 0, -1, 3, 2, 1]}
    plain, null = move(world(stiff), 0.3, **start), move(world(stiff).add(ContactCompliance("thing")), 0.3, **start)
    np.testing.assert_allclose(null.qpos, plain.qpos, atol=1e-9)


@pytest.mark.parametrize(("share", "holds"), [(0.9, False), (1.1, True)])
def test_ball_hangs_from_a_ceiling_that_sticks_with_more_than_its_weight(share, holds):
    ceiling = FLOOR.format(type="sphere", size="0.05", height=-0.0499, floor='euler="180 0 0"', geom="")
    ball = move(world(ceiling, Adhesion("thing"), share * MASS * G), 0.5)
    assert (ball.qpos[-1, 2] > -0.06) == holds


def test_adhesion_holds_a_block_against_a_push_of_mu_times_weight_and_adhesion():
    tilted = BALL.replace("<mujoco>", '<mujoco><compiler angle="radian"/>').replace('type="sphere"', 'type="box"')
    tilted = tilted.replace('size="0.05"', 'size="0.05 0.05 0.05"')
    for pull, holds in ((0.8, False), (1.4, True)):
        gravity = f'timestep="0.001" gravity="{0.3 * 2.0 * G} 0 {-G}"'
        model = world(tilted.replace('timestep="0.001"', gravity), Adhesion("thing"), pull * MASS * G / 4)
        assert (move(model, 0.3).qpos[-1, 0] < 0.01) == holds


def test_adhesion_adds_to_what_a_sliding_block_rubs_with_whatever_has_priority():
    for xml in (BLOCK, BLOCK.replace('friction="0.3" ', 'friction="0.3" priority="1" ', 1)):
        block = move(world(xml, Adhesion("thing"), MASS * G / 4), 0.4, qvel=[0.5, 0, 0, 0, 0, 0])
        assert block.qpos[-1, 0] == pytest.approx(0.5**2 / (2 * 0.3 * 2 * G), rel=0.03)


@pytest.mark.parametrize("floor", ['type="plane" size="5 5 0.1"', 'type="box" pos="0 0 -0.5" size="1 1 0.5"'])
@pytest.mark.parametrize(("height", "pulled"), [(0.0009, True), (0.0011, False)])
def test_adhesion_reaches_over_a_gap_of_a_millimetre_and_no_farther(floor, height, pulled):
    xml = BLOCK.replace('type="plane" size="5 5 0.1"', floor).replace(
        'name="thing" pos', 'name="thing" gravcomp="1" pos'
    )
    block = move(world(xml, Adhesion("thing"), 0.1), 0.02, qpos=[0, 0, 0.02 + height, *UPRIGHT])
    expected = -4 * 0.1 / MASS * (0.02 - 0.001) if pulled else 0.0
    np.testing.assert_allclose(block.qvel[-1], [0, 0, expected, 0, 0, 0], atol=1e-9)


def test_adhesion_without_force_changes_no_motion():
    start = {"qpos": [0, 0, 0.1, 0.9, 0.3, 0.2, 0.1], "qvel": [0.5, 0, -1, 3, 2, 1]}
    plain, null = move(world(BLOCK), 0.5, **start), move(world(BLOCK).add(Adhesion("thing")), 0.5, **start)
    np.testing.assert_allclose(null.qpos, plain.qpos, atol=1e-6)


@pytest.mark.parametrize(("mu", "holds"), [(0.4, False), (0.6, True), (1.5, True)])
def test_pads_hold_a_block_up_to_twice_mu_times_the_force(mu, holds):
    force = 0.1 * G / (2 * 0.5)
    block = move(world(GRIPPER, PadFriction("left", "right"), mu), 0.4, ctrl=[0, force, force]).sensor["block"][:, 2]
    assert (block[0] - block[-1] < 0.003) == holds


def test_only_the_product_of_pad_friction_and_grip_force_decides_whether_the_block_slips():
    force = 0.1 * G / (2 * 0.5)
    model = world(GRIPPER, PadFriction("left", "right"), 0.3).add(GripForce("left", "right"), [2.0])
    block = move(model, 0.4, ctrl=[0, force, force]).sensor["block"][:, 2]
    assert block[0] - block[-1] < 0.003
