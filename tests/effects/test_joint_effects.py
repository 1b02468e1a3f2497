import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from small_worlds import MOTOR, PENDULUM, SLIDER, G, move, world

from concent_warp.effects.library.joints import (
    Armature,
    JointDamping,
    JointFriction,
    JointOffset,
    JointStiffness,
    LoadDependentFriction,
    Stribeck,
)

MASS = 2.0
CART = SLIDER.format(joint="", actuator=MOTOR)
SPRUNG = SLIDER.format(joint='stiffness="50"', actuator=MOTOR)


def test_dry_friction_stops_a_cart_after_the_distance_that_its_energy_lasts():
    cart = move(world(CART, JointFriction("rail"), 1.5), 2.0, qvel=[0.6])
    assert cart.qpos[-1, 0] == pytest.approx(MASS * 0.6**2 / (2 * 1.5), rel=0.01)
    assert abs(cart.qvel[-1, 0]) < 1e-6


def test_dry_friction_takes_four_f_over_k_off_the_amplitude_in_each_period():
    cart = move(world(SPRUNG, JointFriction("rail"), 0.4), 2.1 * 2 * np.pi * np.sqrt(MASS / 50), qpos=[0.1])
    x = cart.qpos[:, 0]
    peaks = x[1:-1][(x[1:-1] > x[:-2]) & (x[1:-1] > x[2:])]
    np.testing.assert_allclose(peaks[:2], [0.1 - 4 * 0.4 / 50, 0.1 - 8 * 0.4 / 50], atol=5e-4)


@pytest.mark.parametrize(("force", "moves"), [(1.4, False), (1.6, True)])
def test_dry_friction_holds_up_to_its_size(force, moves):
    cart = move(world(CART, JointFriction("rail"), 1.5), 1.0, ctrl=force)
    assert cart.qpos[-1, 0] == pytest.approx(0.5 * 0.1 / MASS if moves else 0.0, abs=5e-4)


def test_joint_that_friction_holds_does_not_creep():
    cart = move(world(CART, JointFriction("rail"), 2.0), 1.0, ctrl=1.8)
    assert abs(cart.qpos[-1, 0]) < 2e-5


def test_viscous_friction_lets_the_amplitude_decay_exponentially():
    cart = move(world(SPRUNG, JointDamping("rail"), 1.2), 2.0, qpos=[0.1])
    rate = 1.2 / (2 * MASS)
    swing = np.sqrt(50 / MASS - rate**2)
    envelope = np.exp(-rate * cart.time)
    expected = 0.1 * envelope * (np.cos(swing * cart.time) + rate / swing * np.sin(swing * cart.time))
    np.testing.assert_allclose(cart.qpos[:, 0], expected, atol=5e-4)


def test_stribeck_friction_holds_at_rest_and_fades_with_speed():
    xml = SLIDER.format(joint='frictionloss="1" solreffriction="0.0015 1"', actuator=MOTOR)
    model = world(xml, Stribeck("rail"), 0.8, 0.1)
    assert abs(move(model, 0.5, ctrl=1.7).qpos[-1, 0]) < 1e-4
    cart = move(model, 0.5, ctrl=1.7, qvel=[0.15])

    def acceleration(_, state):
        return [state[1], (1.7 - 1.0 - 0.8 * np.exp(-((state[1] / 0.1) ** 2))) / MASS]

    expected = solve_ivp(acceleration, (0, 0.5), [0, 0.15], t_eval=[0.5], rtol=1e-8).y[:, -1]
    np.testing.assert_allclose([cart.qpos[-1, 0], cart.qvel[-1, 0]], expected, rtol=1e-3)


def test_stribeck_friction_slows_a_cart_as_its_formula_predicts_and_not_with_a_lag():
    """Where friction falls with speed, a lag of half a step grows from slip to slip."""
    cart = move(world(CART, Stribeck("rail"), 4.0, 0.3), 0.12, qvel=[0.3])

    def acceleration(_, speed):
        return -4.0 * np.exp(-((speed / 0.3) ** 2)) / MASS

    expected = solve_ivp(acceleration, (0, 0.12), [0.3], t_eval=cart.time, rtol=1e-9, atol=1e-12).y[0]
    np.testing.assert_allclose(cart.qvel[:, 0], expected, atol=1e-5)


def test_load_friction_takes_its_share_of_half_the_drive_of_a_cart_that_nothing_else_loads():
    cart = move(world(CART, LoadDependentFriction("rail"), 0.4), 0.5, ctrl=3.0)
    assert cart.qvel[-1, 0] == pytest.approx(0.5 * 3.0 * (1 - 0.4 / 2) / MASS, rel=0.01)


@pytest.mark.parametrize(("share", "held"), [(0.84, True), (0.80, False), (1.20, True), (1.25, False)])
def test_load_friction_holds_a_weight_within_a_band_around_the_torque_that_carries_it(share, held):
    """|tau - w| <= c (tau + w) / 2, so tau / w between (2 - c) / (2 + c) and its inverse: 0.818 to 1.222 at c = 0.2."""
    weight = 0.5 * G * 0.2
    pendulum = move(world(PENDULUM, LoadDependentFriction("hinge"), 0.2), 0.2, ctrl=-share * weight, qpos=[-np.pi / 2])
    assert (abs(pendulum.qpos[-1, 0] + np.pi / 2) < 2e-3) == held


def test_armature_adds_to_what_a_drive_accelerates():
    cart = move(world(CART, Armature("rail"), 0.5), 0.5, ctrl=3.0)
    assert cart.qvel[-1, 0] == pytest.approx(0.5 * 3.0 / (MASS + 0.5), rel=1e-6)


def test_offset_pendulum_hangs_where_its_encoder_reads_less_by_the_offset():
    model = world(PENDULUM, JointOffset("hinge"), 0.2)
    np.testing.assert_allclose(move(model, 1.0, qpos=[-0.2]).qpos, -0.2, atol=1e-9)
    swing = move(model, 0.3, qpos=[0.1])
    plain = move(world(PENDULUM), 0.3, qpos=[0.3])
    np.testing.assert_allclose(swing.qpos + 0.2, plain.qpos, atol=1e-9)


def test_offset_leaves_the_springs_of_a_joint_where_they_are_in_space():
    cart = move(world(SPRUNG, JointOffset("rail"), 0.03), 0.2, qpos=[-0.03])
    np.testing.assert_allclose(cart.qpos, -0.03, atol=1e-9)


def test_a_rotor_as_heavy_as_its_link_is_typical():
    m = world(CART).compile()
    (inertia,) = Armature("rail").parameters(m)
    assert inertia.typical == pytest.approx(m.dof_M0[0])
    assert inertia.scale < inertia.typical


SOCKET = """<mujoco><option gravity="0 0 0" timestep="0.001"/><worldbody><body name="bob">
<joint name="socket" type="ball" damping="0.001"/><geom size="0.1" mass="2"/></body>
<body name="other" pos="1 0 0"><joint name="hinge"/><geom size="0.1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("effect", "value", "left"),
    [(JointDamping, 0.004, 3.0 * np.exp(-0.004 * 0.5 / 0.008)), (JointFriction, 0.01, 3.0 - (0.01 * 0.5) / 0.008)],
)
def test_bearings_of_ball_joints_brake_about_every_axis(effect, value, left):
    m = mujoco.MjModel.from_xml_string(SOCKET)
    assert ("socket",) in effect.targets(m)
    assert ("socket",) not in JointOffset.targets(m)
    model = world(SOCKET.replace('damping="0.001"', ""), effect("hinge", "socket"), 0.0, value)
    for axis in range(3):
        qvel = [0.0] * 4
        qvel[axis] = 3.0
        moved = move(model, 0.5, qvel=qvel)
        assert moved.qvel[-1, axis] == pytest.approx(left, rel=2e-3)
        assert moved.qvel[-1, 3] == 0.0


def test_spring_swings_a_cart_about_where_it_rests():
    cart = move(world(CART, JointStiffness("rail"), 50.0, 50.0 * 0.04), 1.0, qpos=[0.1])
    expected = 0.04 + 0.06 * np.cos(np.sqrt(50 / MASS) * cart.time)
    np.testing.assert_allclose(cart.qpos[:, 0], expected, atol=2e-4)


def test_preload_without_stiffness_is_a_constant_force():
    cart = move(world(CART, JointStiffness("rail"), 0.0, 3.0), 0.5)
    assert cart.qpos[-1, 0] == pytest.approx(0.5 * 3.0 / MASS * 0.5**2, rel=3e-3)


def test_spring_values_are_those_of_the_whole_spring_and_its_null_values_the_models_own():
    model = world(SLIDER.format(joint='stiffness="50" springref="0.02"', actuator=MOTOR))
    stiffness, preload = JointStiffness("rail").parameters(model.compile())
    assert (stiffness.null, preload.null) == (50.0, 1.0)
    assert stiffness.low == 0
    stronger = model.add(JointStiffness("rail"), {"stiffness[rail]": 80.0}).compile()
    assert stronger.jnt_stiffness[0] == 80.0
    assert stronger.qpos_spring[0] == pytest.approx(1.0 / 80.0)


def test_null_values_of_a_spring_leave_the_rest_position_of_a_joint_without_stiffness():
    model = world(SLIDER.format(joint='springref="0.02"', actuator=MOTOR)).add(JointStiffness("rail"))
    assert model.compile().qpos_spring[0] == pytest.approx(0.02)
