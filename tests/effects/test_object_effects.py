from copy import copy

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from small_worlds import BALL, BLOCK, FLOOR, MOTOR, PENDULUM, SLIDER, G, move, world

from concent_warp.effects.library.objects import AXES, CenterOfMass, Inertia, Mass, Size
from concent_warp.errors import ModelError

CART = SLIDER.format(joint="", actuator=MOTOR)


def test_heavier_cart_is_accelerated_less_by_the_same_force():
    cart = move(world(CART, Mass("cart"), 1.6), 0.5, ctrl=3.0)
    assert cart.qvel[-1, 0] == pytest.approx(0.5 * 3.0 / (2 * 1.6), rel=1e-6)


def test_mass_leaves_the_period_of_a_pendulum():
    plain, heavy = (move(world(PENDULUM, Mass("link"), f), 0.5, qpos=[0.3]) for f in (1.0, 2.0))
    np.testing.assert_allclose(plain.qpos, heavy.qpos, atol=1e-9)


def test_pendulum_hangs_with_its_shifted_centre_of_mass_below_the_hinge():
    shifted = world(PENDULUM, CenterOfMass("link"), 0.05, 0.0, 0.02)
    rest = np.arctan2(0.05, 0.2 - 0.02)
    np.testing.assert_allclose(move(shifted, 0.5, qpos=[rest]).qpos, rest, atol=1e-9)


@pytest.mark.parametrize(("radius", "high"), [(0.001, 0.36), (0.5, 3 * 0.5 * np.sqrt(0.4))])
def test_a_bob_may_be_off_by_a_share_of_its_cable_or_by_its_size(radius, high):
    m = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body name="bob"><joint axis="0 1 0" pos="0 0.3 0"/>
        <geom type="sphere" size="{radius}" pos="0 0 -0.6"/></body></worldbody></mujoco>"""
    )
    assert [p.high for p in CenterOfMass("bob").parameters(m)] == pytest.approx(3 * [high])


@pytest.mark.parametrize(("offset", "tips"), [(0.045, False), (0.055, True)])
def test_block_tips_over_the_edge_that_its_centre_of_mass_lies_beyond(offset, tips):
    block = move(world(BLOCK, CenterOfMass("thing"), offset, 0.0, 0.0), 0.5)
    upright = 1 - 2 * (block.qpos[-1, 4] ** 2 + block.qpos[-1, 5] ** 2)
    assert (upright < 0.9) == tips


def test_thrown_body_turns_about_its_shifted_centre_of_mass():
    ball = move(world(BALL, CenterOfMass("thing"), 0.02, 0.0, 0.0), 0.2, qpos=[0, 0, 1, 1, 0, 0, 0], qvel=[0] * 5 + [5])
    angle = 5 * ball.time
    speed = np.array([0, 5 * 0.02])
    centre = np.array([0.02, 0.0]) + speed * ball.time[:, None]
    np.testing.assert_allclose(
        ball.qpos[:, :2], centre - 0.02 * np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=1e-4
    )


ARM = """<mujoco><option timestep="0.001"/><compiler angle="radian"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.8"/>
  <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 0 1" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.4"/>{load}
  </body></body></worldbody></mujoco>"""


def test_a_load_in_a_point_is_a_small_heavy_body_there():
    start = [0.3, -0.4]
    load = '<geom type="sphere" size="1e-4" pos="0.25 0.03 -0.05" mass="0.3"/>'
    carried = move(world(ARM.format(load=load)), 1.0, qpos=start)
    plain = world(ARM.format(load=""))
    added = move(plain.add(Mass("lower", "point"), [0.3, 0.25, 0.03, -0.05]), 1.0, qpos=start)
    np.testing.assert_allclose(added.qpos, carried.qpos, atol=1e-6)
    without = move(plain.add(Mass("lower", "point"), [0.0, 0.25, 0.03, -0.05]), 1.0, qpos=start)
    np.testing.assert_array_equal(without.qpos, move(plain, 1.0, qpos=start).qpos)
    assert np.abs(without.qpos - carried.qpos).max() > 0.1
    weighed = world(ARM.format(load=load)).add(Mass("lower", "point"), [-0.3, 0.25, 0.03, -0.05])
    np.testing.assert_allclose(move(weighed, 1.0, qpos=start).qpos, without.qpos, atol=1e-6)


def test_several_links_may_carry_the_same_load_in_a_point():
    m = world(ARM.format(load="")).add(Mass("upper", "lower", "point"), [0.3, 0.2, 0.0, 0.0]).compile()
    np.testing.assert_allclose(m.body_mass[1:], [0.8 + 0.3, 0.4 + 0.3])


def test_what_a_mass_that_is_taken_away_leaves_may_be_a_body():
    plain = world(ARM.format(load=""))
    before = plain.compile()
    after = plain.add(Mass("lower", "point"), [-0.15, 0.2, 0.1, 0.0]).compile()
    body = before.body("lower").id
    assert after.body_mass[body] == pytest.approx(0.25)
    assert (after.body_inertia[body] > 0).all()


def test_loads_in_a_point_are_those_of_links_that_turn():
    m = world(ARM.format(load='<body name="tool"><geom size="0.01" mass="0.1"/></body>')).compile()
    assert Mass.single_targets(m) == (("upper", "point"), ("lower", "point"))
    own, usual = m.body("lower").mass[0], m.body("lower").mass[0]
    mass, x, *_ = Mass("lower", "point").parameters(m)
    assert (mass.null, mass.unit, mass.low, mass.high) == (0.0, "kg", -0.5 * own, 10 * usual)
    assert x.null == pytest.approx(0.1)
    assert x.high > 0.3
    assert Mass.single_targets(world(CART).compile()) == ()
    assert Mass.single_targets(world(BALL).compile()) == ()
    with pytest.raises(ModelError, match="cannot act on these"):
        world(BALL).add(Mass("thing", "point"))
    assert Mass("lower", "point").has_as_special_case(Mass("lower"))
    assert not Mass("lower").has_as_special_case(Mass("lower", "point"))
    assert Mass("lower", "point").has_as_special_case(Mass("tool"))
    assert not Mass("lower", "point").has_as_special_case(Mass("upper", "point"))


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_pendulum_of_another_inertia_swings_with_another_period(factor):
    swing = move(world(PENDULUM, Inertia("link"), factor), 2.0, qpos=[0.02]).qpos[:, 0]
    falls = np.flatnonzero((swing[:-1] > 0) & (swing[1:] <= 0))
    period = np.diff(falls)[0] * 0.001
    assert period == pytest.approx(2 * np.pi * np.sqrt((0.004 * factor + 0.5 * 0.2**2) / (0.5 * G * 0.2)), abs=0.002)


SPINNING = """
<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body name="thing" pos="0 0 1"><freejoint/>
  <inertial pos="0 0 0" mass="0.4" diaginertia="4e-4 9e-4 12e-4" {turned}/>
  <geom size="0.05" contype="0" conaffinity="0" mass="0"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("turned", ["", 'quat="0.5 0.5 0.5 0.5"', 'quat="0.7 0.1 0.05 0.7"'])
def test_each_principal_axis_has_its_moment_named_by_the_nearest_axis_of_the_body(turned):
    m = mujoco.MjModel.from_xml_string(SPINNING.format(turned=turned))
    effect = Inertia("thing", "axes")
    assert [p.name for p in effect.parameters(m)] == ["x", "y", "z"]
    before, after = full_inertia(m), copy(m)
    effect.write(after, np.array([1.0, 1.5, 1.0]))
    nearest = np.argmax(np.abs(principal_axes(m)), axis=0)
    np.testing.assert_allclose(after.body_inertia[1], m.body_inertia[1] * np.where(nearest == 1, 1.5, 1.0))
    effect.write(m, np.full(3, 2.0))
    np.testing.assert_allclose(full_inertia(m), 2 * before)


def principal_axes(m):
    """Return the principal axes of the body in its frame, one a column."""
    found = np.empty(9)
    mujoco.mju_quat2Mat(found, m.body_iquat[1])
    return found.reshape(3, 3)


def full_inertia(m):
    """Return the inertia of the body in its frame."""
    return principal_axes(m) @ np.diag(m.body_inertia[1]) @ principal_axes(m).T


def test_moments_of_inertia_are_candidates_by_axis_of_bodies_that_turn_about_several_axes():
    gimbal = """<mujoco><worldbody><body name="outer"><joint axis="0 0 1"/><geom size="0.1"/>
      <body name="inner"><joint axis="{axis}"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
    several = mujoco.MjModel.from_xml_string(gimbal.format(axis="0 1 0"))
    assert Inertia.targets(several) == (("inner",), *(("inner", part) for part in AXES))
    assert Inertia.targets(mujoco.MjModel.from_xml_string(gimbal.format(axis="0 0 1"))) == (("inner",),)
    assert Inertia.targets(mujoco.MjModel.from_xml_string(BALL)) == (("thing",), *(("thing", part) for part in AXES))
    effect = Inertia("thing", "axes")
    assert all(effect.has_as_special_case(Inertia("thing", *part)) for part in ((), ("axis_x",)))
    assert not effect.has_as_special_case(effect)
    assert not effect.has_as_special_case(Inertia("other"))
    assert not Inertia("thing", "axis_x").has_as_special_case(Inertia("thing"))
    assert effect.is_part
    assert effect.elements == ("thing",)
    with pytest.raises(ModelError, match="several axes"):
        world(PENDULUM, Inertia("link", "axes"))


@pytest.mark.parametrize(("part", "factors"), [(("axes",), (1.5, 1.0, 1.0)), (("axis_x",), (1.5,))])
def test_a_body_with_one_moment_off_spins_as_eulers_equations_say(part, factors):
    moments = np.array([6e-4, 9e-4, 12e-4])
    body = world(SPINNING.format(turned=""), Inertia("thing", *part), *factors)
    spin = np.array([2.0, 5.0, -1.0])
    found = move(body, 1.0, qpos=[0, 0, 1, 1, 0, 0, 0], qvel=[0, 0, 0, *spin])
    euler = solve_ivp(lambda _, w: np.cross(moments * w, w) / moments, (0, 1), spin, rtol=1e-9)
    np.testing.assert_allclose(found.qvel[-1, 3:], euler.y[:, -1], atol=0.02)


@pytest.mark.parametrize(("shape", "size", "half"), [("box", "0.05 0.04 0.02", 0.02), ("sphere", "0.05", 0.05)])
def test_larger_body_rests_higher_in_proportion(shape, size, half):
    xml = FLOOR.format(type=shape, size=size, height=half, floor="", geom="")
    plain, large = (
        move(world(xml, Size("thing"), factor), 1.0, qpos=[0, 0, factor * half, 1, 0, 0, 0]) for factor in (1.0, 1.2)
    )
    assert large.qpos[-1, 2] - plain.qpos[-1, 2] == pytest.approx(0.2 * half, abs=2e-5)


MESH = """
<mujoco><asset><mesh name="wedge" scale="2 1 1" vertex="-.02 -.02 -.02 .02 -.02 -.02 0 .02 -.02 0 0 .02"/></asset>
<worldbody><body name="thing"><freejoint/><geom name="a" type="mesh" mesh="wedge" pos="0.1 0 0" mass="0.3"/>
<geom name="b" type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" mass="0.1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("xml", [BLOCK, MESH], ids=["box", "mesh and capsule"])
def test_size_scales_shapes_and_places_and_leaves_mass_and_inertia(xml):
    plain, large = world(xml).compile(), world(xml, Size("thing"), 1.25).compile()
    for name in ("body_mass", "body_inertia", "body_ipos"):
        np.testing.assert_allclose(getattr(large, name), getattr(plain, name), atol=1e-9)
    mine = plain.geom_bodyid == plain.body("thing").id
    for name in ("geom_pos", "geom_rbound"):
        np.testing.assert_allclose(getattr(large, name)[mine], 1.25 * getattr(plain, name)[mine], atol=1e-9)
    np.testing.assert_allclose(large.geom_aabb[mine], 1.25 * plain.geom_aabb[mine], atol=1e-9)


TOOL = """<mujoco><worldbody><body name="link"><joint name="hinge" axis="0 1 0"/><geom size="0.05" mass="1"/>
<body name="frame"><body name="tool" pos="0 0 -0.1"><geom size="0.03" mass="0.5"/><site name="wrist"/></body></body>
</body><body name="object" pos="1 0 0"><freejoint/><geom size="0.02"/>
<body name="marker"><geom size="0.01"/></body></body>
</worldbody><sensor><force name="load" site="wrist"/></sensor></mujoco>"""


def test_what_is_fixed_to_a_link_may_be_heavier_than_the_model():
    m = mujoco.MjModel.from_xml_string(TOOL)
    assert Mass.targets(m) == (("object",), ("marker",), ("link",), ("tool",))
    heavy = move(world(TOOL, Mass("tool"), 1.4), 0.1)
    assert heavy.sensor["load"][-1, 2] == pytest.approx(1.4 * 0.5 * G, rel=1e-3)
