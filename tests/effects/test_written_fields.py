"""What effects do to MJCFs, compiled models, commands and readings, to the last number."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_worlds import BALL, BLOCK, GRIPPER, MOTOR, SLIDER, world

from concent_warp.effects.effect import Effect
from concent_warp.effects.library.contact import (
    Adhesion,
    ContactCompliance,
    PadFriction,
    RollingFriction,
    SlidingFriction,
    TorsionalFriction,
)
from concent_warp.effects.library.drives import (
    ActuatorDelay,
    ActuatorGain,
    ActuatorLag,
    ActuatorSaturation,
    Backlash,
    GravityCompensation,
    GripForce,
    JointCompliance,
)
from concent_warp.effects.library.joints import Armature, JointDamping, JointFriction, JointOffset
from concent_warp.effects.library.objects import CenterOfMass, Inertia, Mass, Size, keep_inertia
from concent_warp.effects.library.world import AirDrag, GravityTilt, Wind

TWO = """
<mujoco><option timestep="0.004" gravity="0 0 -9"/><worldbody>
  <body name="a"><joint name="a" axis="0 1 0" frictionloss=".3" damping=".2" armature=".1" ref="10" springref="4"/>
    <geom size=".05" mass="1.5" pos=".1 0 0"/>
    <body name="b" pos=".2 0 0"><joint name="b" type="slide" axis="1 0 0"/>
      <geom type="box" size=".05 .04 .03" mass=".5" pos=".01 .02 0"/></body></body></worldbody>
<actuator><position name="a" joint="a" kp="30" kv="2" forcerange="-7 4"/>
  <position name="b" joint="b" gear="2" kp="50" kv="4"/><motor name="c" joint="b"/></actuator>
<sensor><jointpos name="qa" joint="a"/><jointpos name="qb" joint="b"/><jointvel name="vb" joint="b"/></sensor>
</mujoco>"""


def compiled(xml: str = TWO) -> mujoco.MjModel:
    """Return a model that may be changed."""
    return mujoco.MjModel.from_xml_string(xml)


def written(effect: Effect, *values: float, xml: str = TWO) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Return a model before and after an effect has set its fields."""
    before, after = compiled(xml), compiled(xml)
    effect.write(after, np.array(values))
    return before, after


@pytest.mark.parametrize(
    ("effect", "field"),
    [(JointFriction, "dof_frictionloss"), (JointDamping, "dof_damping"), (Armature, "dof_armature")],
)
def test_joint_effects_set_the_values_of_their_joints_which_are_not_negative(effect, field):
    before, after = written(effect("b"), 0.7)
    assert getattr(after, field).tolist() == [getattr(before, field)[0], 0.7]
    before, after = written(effect("b", "a"), 0.7, -0.1)
    assert getattr(after, field).tolist() == [0.0, 0.7]


def test_offset_moves_the_zero_and_the_rest_of_the_spring():
    before, after = written(JointOffset("b", "a"), 0.01, 0.2)
    np.testing.assert_allclose(before.qpos0 - after.qpos0, [0.2, 0.01])
    np.testing.assert_allclose(before.qpos_spring - after.qpos_spring, [0.2, 0.01])


def test_dry_friction_holds_stiffly_where_the_joint_has_none_of_its_own():
    m = world(TWO).add(JointFriction("a", "b")).compile()
    plain = compiled()
    np.testing.assert_allclose(m.dof_solref[1], [1.5 * 0.004, 1.0])
    np.testing.assert_allclose(m.dof_solimp[1], [0.99, 0.99, *plain.dof_solimp[1, 2:]])
    np.testing.assert_array_equal(m.dof_solref[0], plain.dof_solref[0])
    np.testing.assert_array_equal(m.dof_solimp[0], plain.dof_solimp[0])


def test_gain_scales_gain_and_bias_of_its_actuators():
    before, after = written(ActuatorGain("b", "a"), 0.5, 3.0)
    for field in ("actuator_gainprm", "actuator_biasprm"):
        factor = np.array([3.0, 0.5, 1.0])[:, None]
        np.testing.assert_allclose(getattr(after, field), getattr(before, field) * factor)
    np.testing.assert_array_equal(after.actuator_forcerange, before.actuator_forcerange)
    assert np.abs(before.actuator_biasprm[:2, 1:3]).min() > 1


def test_grip_force_scales_gain_bias_and_limits_of_all_its_actuators_alike():
    before, after = written(GripForce("a", "b"), 2.0)
    for field in ("actuator_gainprm", "actuator_biasprm"):
        np.testing.assert_allclose(getattr(after, field)[:2], 2 * getattr(before, field)[:2])
    np.testing.assert_allclose(after.actuator_forcerange[0], [-14, 8])
    assert GripForce("a").fields(before) == ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")


def test_saturation_keeps_what_is_tighter_and_prepares_limits_far_away():
    m = world(TWO).add(ActuatorSaturation("a", "b")).compile()
    np.testing.assert_array_equal(m.actuator_forcerange[:2], [[-7, 4], [-1e6, 1e6]])
    assert m.actuator_forcelimited.tolist() == [1, 1, 0]
    # The second one has a gear of 2: MuJoCo's force is that before it.
    for limit, expected in (
        (5.0, [[-5, 4], [-2.5, 2.5]]),
        (3.0, [[-3, 3], [-1.5, 1.5]]),
        (np.inf, [[-7, 4], [-1e6, 1e6]]),
    ):
        tight = world(TWO).add(ActuatorSaturation("a", "b"), [limit]).compile()
        np.testing.assert_array_equal(tight.actuator_forcerange[:2], expected)
    empty = TWO.replace('forcerange="-7 4"', 'forcerange="0 0" forcelimited="false"')
    assert world(empty).add(ActuatorSaturation("a")).compile().actuator_forcerange[0].tolist() == [-1e6, 1e6]


@pytest.mark.parametrize("delay", [0.0, -1.0, 0.003, 0.004, 0.0123, 0.05, 1.0])
def test_delay_interpolates_what_was_commanded_before(delay):
    rng = np.random.default_rng(0)
    ctrl, time = rng.normal(size=(12, 3)), 0.004 * np.arange(12)
    late = ActuatorDelay("c", "a").command(compiled(), ctrl, np.array([delay]))
    for column in (0, 2):
        expected = np.interp(time - max(delay, 0.0), time, ctrl[:, column])
        np.testing.assert_allclose(late[:, column], expected, atol=1e-12)
    np.testing.assert_array_equal(late[:, 1], ctrl[:, 1])
    assert late is not ctrl


def test_delay_and_lag_are_reported_for_their_actuators():
    for values in ([0.02], [-0.02]):
        expected = [max(values[0], 0.0), 0.0, max(values[0], 0.0)]
        delay, none = ActuatorDelay("c", "a").delay_and_lag(compiled(), np.array(values))
        assert (delay.tolist(), none.tolist()) == (expected, [0.0] * 3)
        none, lag = ActuatorLag("c", "a").delay_and_lag(compiled(), np.array(values))
        assert (lag.tolist(), none.tolist()) == (expected, [0.0] * 3)
    assert ActuatorDelay.history == ActuatorDelay("a").parameters(compiled())[0].high


@pytest.mark.parametrize("tau", [2e-5, 0.003, 0.02])
def test_lag_is_the_mean_over_each_step_of_what_follows_the_command_exponentially(tau):
    rng = np.random.default_rng(1)
    ctrl, dt = rng.normal(size=(9, 3)), 0.004
    slow = ActuatorLag("b").command(compiled(), ctrl, np.array([tau]))
    u, y, expected = ctrl[:, 1], ctrl[0, 1], []
    for command in u:
        mean = command + (y - command) * (1 - np.exp(-dt / tau)) * tau / dt
        expected.append(mean)
        y = command + (y - command) * np.exp(-dt / tau)
    np.testing.assert_allclose(slow[:, 1], expected, atol=1e-12)
    np.testing.assert_array_equal(slow[:, [0, 2]], ctrl[:, [0, 2]])
    same = ActuatorLag("b").command(compiled(), ctrl, np.array([0.9e-5]))
    assert same is ctrl


def test_play_makes_room_for_the_lead_of_each_rotor():
    for more, size in (("", 3), ('<size nuserdata="4"/>', 7)):
        model = world(TWO.replace("<worldbody>", f"{more}<worldbody>")).add(Backlash("b"))
        m = model.compile()
        assert m.nuserdata == size
        force = model.effects[0].effect.force_model(m)
        assert force is not None
        assert vars(force)["first"] == size - 3
        assert vars(force)["actuators"].tolist() == [1]


def test_compliance_makes_room_for_rotors_beside_those_with_play_and_adds_one_sensor_a_drive():
    model = world(TWO).add(JointCompliance("b"), [0.02, 1.0]).add(JointCompliance("a"), [0.0, 1.0])
    m = model.compile()
    names = [m.sensor(i).name for i in range(m.nsensor)]
    assert names == ["qa", "qb", "vb", "concent_twist_b", "concent_twist_a"]
    assert m.sensor_type[3] == mujoco.mjtSensor.mjSENS_FRAMEPOS
    assert m.site(m.sensor_objid[3]).name == "concent_twist_b"
    assert m.site_sameframe[m.sensor_objid[3]] not in (
        mujoco.mjtSameFrame.mjSAMEFRAME_BODY,
        mujoco.mjtSameFrame.mjSAMEFRAME_INERTIA,
    )
    again = m.nsensor
    spec = model.scene.spec()
    for _ in range(2):
        JointCompliance("b", "a").prepare(spec)
    assert spec.compile().nsensor == again
    m = world(TWO).add(JointCompliance("b")).add(Backlash("a")).compile()
    elastic, loose = JointCompliance("b").force_model(m), Backlash("a").force_model(m)
    assert (vars(elastic)["first"], vars(loose)["first"]) == (3, 15)
    assert m.nuserdata == 18


def test_encoders_of_a_compliant_joint_read_the_rotor():
    more = """<actuatorpos name="pb" actuator="b"/><actuatorvel name="rb" actuator="b"/>
        <actuatorfrc name="fb" actuator="b"/><jointactuatorfrc name="tb" joint="b"/></sensor>"""
    xml = TWO.replace("</sensor>", more)
    m = world(xml).add(JointCompliance("b", "a")).compile()
    time = np.array([1.0, 2.0])

    def read(sensor, time):
        twist = {"concent_twist_b": [5.0, 6.0, 7.0], "concent_twist_a": [8.0, 9.0, 10.0]}
        return np.array(twist.get(sensor, [1.0])) * time[:, None]

    bent = JointCompliance("b", "a").measure(m, read, np.array([0.02, 0.03, 1.0]))
    gear = m.actuator("b").gear[0]
    expected = {"qb": 1 + 5, "vb": 1 + 6, "qa": 1 + 8, "pb": 1 + 5 * gear, "rb": 1 + 6 * gear, "fb": 7, "tb": 7 * gear}
    for sensor, factor in expected.items():
        np.testing.assert_allclose(bent(sensor, time)[:, 0], factor * time)
    stiff = JointCompliance("b", "a").measure(m, read, np.array([0.0, 0.03, 1.0]))
    np.testing.assert_array_equal(stiff("qb", time), read("qb", time))


def test_gravity_compensation_adds_to_that_of_the_links():
    xml = TWO.replace('<body name="b"', '<body name="b" gravcomp="0.25"')
    before, after = written(GravityCompensation("b", "a"), 0.5, xml=xml)
    np.testing.assert_allclose(after.body_gravcomp, before.body_gravcomp + np.array([0, 0.5, 0.5]))
    model = world(TWO).add(GravityCompensation("a"))
    assert model.compile().body_gravcomp.tolist() == [1, 0, 0]
    assert model.compile().ngravcomp > 0


def test_a_drive_goes_on_compensating_the_weight_that_it_knows_whatever_the_mass():
    xml = TWO.replace('<body name="b"', '<body name="b" gravcomp="0.9"')
    before, after = written(Mass("b"), 3.0, xml=xml)
    np.testing.assert_allclose(after.body_gravcomp * after.body_mass, before.body_gravcomp * before.body_mass)
    assert before.body_gravcomp[2] == 0.9
    assert Mass("b").fields(before) == ("body_mass", "body_inertia", "body_gravcomp")
    heavy = world(xml).add_effect("nominal_mass", ["b"], {"mass[b]": 1.01}).compile()
    np.testing.assert_allclose(heavy.body_gravcomp * heavy.body_mass, before.body_gravcomp * before.body_mass)


def test_mass_and_inertia_are_scaled():
    before, after = written(Mass("b"), 3.0)
    np.testing.assert_allclose(after.body_mass, before.body_mass * [1, 1, 3])
    np.testing.assert_allclose(after.body_inertia, before.body_inertia * [[1], [1], [3]])
    before, after = written(Inertia("b"), 3.0)
    np.testing.assert_array_equal(after.body_mass, before.body_mass)
    np.testing.assert_allclose(after.body_inertia, before.body_inertia * [[1], [1], [3]])
    before, after = written(CenterOfMass("b"), 0.1, 0.2, -0.3)
    np.testing.assert_allclose(after.body_ipos - before.body_ipos, [[0] * 3] * 2 + [[0.1, 0.2, -0.3]])


def test_offset_of_the_centre_of_mass_is_bounded_by_the_radius_of_gyration():
    m = compiled()
    gyration = np.sqrt(m.body_inertia[2].max() / 0.5)
    for p, axis in zip(CenterOfMass("b").parameters(m), "xyz", strict=True):
        assert (p.name, p.unit, p.null) == (axis, "m", 0)
        assert (p.low, p.high, p.scale) == pytest.approx((-3 * gyration, 3 * gyration, 0.3 * gyration))


def test_objects_without_mass_lack_none():
    massless = BLOCK.replace("</worldbody>", '<body name="frame" mocap="true"/></worldbody>')
    assert Mass.targets(compiled(massless)) == (("thing",),)
    assert Mass.targets(compiled()) == (("b",),)
    assert Size.targets(compiled()) == ()


@pytest.mark.parametrize(
    "inertia",
    [
        'fullinertia=".001 .002 .0025 .0001 0 0"',
        'diaginertia=".001 .002 .0025" euler="10 20 30"',
        'diaginertia=".001 .002 .0025"',
    ],
    ids=["full", "turned", "diagonal"],
)
def test_size_scales_capsules_by_their_ends_and_keeps_inertias_however_they_are_given(inertia):
    xml = f"""<mujoco><worldbody><body name="thing"><freejoint/><inertial pos=".01 .02 .03" mass=".4" {inertia}/>
      <geom type="capsule" fromto="0 0 0 .1 0 0" size=".02"/>
      <geom type="box" size=".01 .02 .03" pos=".1 .2 .3"/></body></worldbody></mujoco>"""
    plain, large = (world(xml, Size("thing"), factor).compile() for factor in (1.0, 1.5))
    np.testing.assert_allclose(large.geom_size, 1.5 * plain.geom_size, atol=1e-12)
    np.testing.assert_allclose(large.geom_pos, 1.5 * plain.geom_pos, atol=1e-12)
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_allclose(getattr(large, field), getattr(compiled(xml), field), atol=1e-12)


def test_an_inertia_that_is_kept_is_written_into_the_mjcf():
    spec = world(BLOCK).scene.spec()
    plain = spec.compile()
    keep_inertia(spec.body("thing"), plain)
    spec.geom("thing").size = [0.2, 0.2, 0.2]
    spec.compile()
    text = spec.to_xml()
    assert "<inertial" in text
    np.testing.assert_allclose(compiled(text).body_inertia, plain.body_inertia, rtol=1e-5)


def test_gravity_is_turned_about_x_and_y():
    before, after = written(GravityTilt(), 0.2, -0.1)
    turned = Rotation.from_rotvec([0.2, -0.1, 0]).apply(before.opt.gravity)
    np.testing.assert_allclose(after.opt.gravity, turned)


def test_air_has_the_density_that_is_given_and_wind_at_least_that_of_air():
    assert written(AirDrag("b"), 7.0)[1].opt.density == 7.0
    assert written(AirDrag("b"), -7.0)[1].opt.density == 0.0
    for density, found in ((0.0, 1.2), (1.3, 1.3)):
        xml = TWO.replace("<option", f'<option density="{density}"')
        after = written(Wind("b"), 1.0, -2.0, 3.0, xml=xml)[1]
        assert after.opt.wind.tolist() == [1, -2, 3]
        assert after.opt.density == found
    assert AirDrag("b").parameters(compiled(TWO.replace("<option", '<option density="2"')))[0].null == 2


def test_air_acts_on_drawn_shapes_of_the_target_and_on_specks_of_the_others():
    xml = """<mujoco><worldbody><body name="thing"><freejoint/><geom name="box" type="box" size=".1 .1 .1"/>
      <geom name="ball" size=".1"/><geom name="ours" size=".1" group="3"/></body>
      <body name="spheres"><freejoint/><geom name="only" size=".1" group="3"/></body>
      <body name="other"><freejoint/><geom size=".1"/></body>
      <body name="fluid"><freejoint/><geom size=".1" fluidshape="ellipsoid"/></body></worldbody></mujoco>"""
    plain, m = compiled(xml), world(xml).add(AirDrag("thing", "spheres")).compile()
    fluid = {m.geom(g).name: m.geom_fluid[g] for g in range(m.ngeom) if m.geom(g).name}
    assert fluid["ours"][0] == 0
    assert fluid["box"][0] == fluid["ball"][0] == fluid["only"][0] == 1
    assert fluid["box"][3] > 0
    assert fluid["ball"][3] == fluid["only"][3] == 0
    assert m.ngeom == plain.ngeom + 1
    (speck,) = np.flatnonzero(m.geom_size[:, 0] == 1e-5)
    assert m.geom_bodyid[speck] == m.body("other").id
    assert (m.geom_contype[speck], m.geom_conaffinity[speck], m.geom_fluid[speck, 0]) == (0, 0, 1)
    np.testing.assert_allclose(m.body_mass, plain.body_mass)
    for medium in ('density="1"', 'viscosity="1"'):
        kept = xml.replace("<worldbody>", f"<option {medium}/><worldbody>")
        assert world(kept).add(AirDrag("thing")).compile().ngeom == plain.ngeom


SURFACES = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 .1" friction=".4 .006 .0002" solref=".01 .8"/>
  <geom name="ghost" size=".1" contype="0" conaffinity="0" friction="9 9 9" solref=".5 5"/>
  <body name="thing"><freejoint/>
    <geom name="box" type="box" size=".1 .1 .1" friction=".8 .003 .0004" solref=".02 1.2" condim="{condim}"/>
    <geom name="ball" size=".1" friction=".2 .001 .0001" solref=".04 .6" contype="2" conaffinity="0"/>
    <geom name="drawn" size=".1" contype="0" conaffinity="0" friction="5 5 5"/></body>
  <body name="other" pos="3 0 0"><freejoint/><geom name="other" size=".1" friction="7 7 7"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("effect", "column", "condim"), [(SlidingFriction, 0, 3), (TorsionalFriction, 1, 4), (RollingFriction, 2, 6)]
)
def test_friction_is_set_to_the_largest_and_others_in_proportion(effect, column, condim):
    m = compiled(SURFACES.format(condim=condim))
    before = m.geom_friction.copy()
    found = effect("thing")
    assert found.parameters(m)[0].null == before[:, column][[0, 2, 3]].max()
    found.write(m, np.array([0.05]))
    largest = before[[0, 2, 3], column].max()
    expected = before.copy()
    expected[[0, 2, 3], column] *= 0.05 / largest
    np.testing.assert_allclose(m.geom_friction, np.maximum(expected, 1e-5))
    found.write(m, np.array([0.0]))
    assert (m.geom_friction[[0, 2, 3], column] == 1e-5).all()


def test_friction_of_a_contact_of_too_few_dimensions_is_none():
    m = compiled(SURFACES.format(condim=3))
    assert SlidingFriction("thing").null(m) == 0.8
    assert TorsionalFriction("thing").null(m) == 0.0
    assert RollingFriction("thing").null(m) == 0.0


@pytest.mark.parametrize(
    ("effect", "start", "condims", "frictions"),
    [
        (SlidingFriction, 3, [3, 3], [[0.4, 0.006, 0.0002], [0.8, 0.003, 0.0004]]),
        (SlidingFriction, 1, [3, 3], [[0.4, 0.006, 0.0002], [0.8, 0.003, 0.0004]]),
        (TorsionalFriction, 3, [3, 3], [[0.4, 0.006, 0.0002], [0.8, 0.003, 0.0004]]),  # a force beside the contacts
        (TorsionalFriction, 4, [3, 4], [[0.4, 1e-5, 0.0002], [0.8, 0.003, 0.0004]]),
        (RollingFriction, 4, [3, 4], [[0.4, 0.006, 0.0002], [0.8, 0.003, 0.0004]]),
        (RollingFriction, 6, [3, 6], [[0.4, 1e-5, 1e-5], [0.8, 0.003, 0.0004]]),
    ],
)
def test_friction_that_comes_anew_begins_next_to_nothing(effect, start, condims, frictions):
    m = world(SURFACES.format(condim=start)).compile()
    spec = world(SURFACES.format(condim=start)).scene.spec()
    effect("thing").prepare(spec)
    after = spec.compile()
    ids = [m.geom("floor").id, m.geom("box").id]
    assert after.geom_condim[ids].tolist() == condims
    np.testing.assert_allclose(after.geom_friction[ids], frictions)
    ghost = m.geom("ghost").id
    np.testing.assert_array_equal(after.geom_friction[ghost], m.geom_friction[ghost])
    assert after.geom_condim[m.geom("drawn").id] == 3


def test_nothing_is_prepared_where_all_contacts_have_the_dimension():
    every = SURFACES.format(condim=6).replace('solref=".04 .6"', 'solref=".04 .6" condim="6"')
    m, spec = world(every).compile(), world(every).scene.spec()
    RollingFriction("thing").prepare(spec)
    np.testing.assert_array_equal(spec.compile().geom_friction, m.geom_friction)


def test_compliance_is_the_mean_of_the_sides_and_scales_both():
    m = compiled(SURFACES.format(condim=3))
    effect = ContactCompliance("thing")
    mean = np.mean([[0.01, 0.8], np.mean([[0.02, 1.2], [0.04, 0.6]], axis=0)], axis=0)
    np.testing.assert_allclose(effect.mean(m), mean)
    time, ratio = effect.parameters(m)
    assert (time.null, time.low, time.high, time.scale) == pytest.approx((mean[0], 0.004, 0.2, 0.5 * mean[0]))
    assert ratio.scan == pytest.approx((0.1 * mean[1], 0.3 * mean[1], 0.6 * mean[1]))
    m.opt.timestep = 0.1
    assert effect.parameters(m)[0].low == pytest.approx(mean[0])
    before = m.geom_solref.copy()
    effect.write(m, np.array([0.03, 0.5]))
    np.testing.assert_allclose(m.geom_solref[[0, 2, 3]], before[[0, 2, 3]] * [0.03, 0.5] / mean)
    np.testing.assert_array_equal(m.geom_solref[[1, 4, 5]], before[[1, 4, 5]])
    alone = compiled(BLOCK.replace('type="plane"', 'type="plane" contype="0" conaffinity="0"'))
    np.testing.assert_allclose(ContactCompliance("thing").mean(alone), [0.02, 1.0])


def test_compliance_tries_damping_ratios_with_the_stiffness_of_the_model_within_the_bounds():
    m = compiled(SURFACES.format(condim=3))
    time, ratio = ContactCompliance("thing").parameters(m)
    rebound, damped = time.scan_together
    for line, sign in ((rebound, 1), (damped, -1)):
        assert (np.diff([row[0] for row in line]) * sign > 0).all()
        for row in line:
            assert row[0] * row[1] == pytest.approx(time.null * ratio.null)
            assert time.low <= row[0] <= time.high
    assert len(rebound) == 4
    assert len(damped) == 2  # the third has a time constant of less than two time steps


def test_compliance_needs_contacts_that_are_damped():
    m = compiled(SURFACES.format(condim=3))
    assert ContactCompliance.targets(m) == (("thing",), ("other",))
    for stiff in ('solref=".01 .8"', 'solref=".04 .6"'):
        undamped = compiled(SURFACES.format(condim=3).replace(stiff, 'solref="-100 0"'))
        assert ContactCompliance.targets(undamped) == ((("other",),) if ".04" in stiff else ())
    assert not ContactCompliance("thing").applies_to(compiled(SLIDER.format(joint="", actuator=MOTOR)), 1)


def test_compliance_of_stiffness_and_damping_that_are_given_directly_stays_so():
    xml = SURFACES.format(condim=3).replace('solref=".04 .6"', 'solref="-5000 -40"')
    m, effect = compiled(xml), ContactCompliance("thing")
    np.testing.assert_allclose(effect.mean(m), [2 / 40, 40 / (2 * np.sqrt(5000))])
    before = m.geom_solref.copy()
    effect.write(m, effect.mean(m))
    np.testing.assert_allclose(m.geom_solref, before)
    effect.write(m, np.array([2 / 20, 20 / (2 * np.sqrt(8000))]))
    (direct,) = np.flatnonzero(before[:, 0] < 0)
    np.testing.assert_allclose(m.geom_solref[direct], [-8000, -20])
    np.testing.assert_allclose(effect.mean(m), [2 / 20, 20 / (2 * np.sqrt(8000))])


def test_adhesion_is_scaled_by_the_weight_and_acts_on_all_that_moves_with_the_body():
    xml = BALL.replace('friction="0.3" /></body>', '/><body name="fixed"><geom size=".01" mass=".1"/></body></body>')
    m = compiled(xml)
    parameter = Adhesion("thing").parameters(m)[0]
    weight = 0.4 * 9.81
    assert (parameter.high, parameter.scale) == pytest.approx((30 * weight, 0.3 * weight))
    assert parameter.scan == pytest.approx([weight * x for x in (0.1, 0.3, 1.0, 3.0)])
    force = Adhesion("thing").force_model(m)
    assert sorted(set(vars(force)["geom"])) == [1, 2]
    assert vars(force)["gap"] == 0.001


def test_pads_get_priority_and_what_the_contact_had():
    xml = GRIPPER.replace('mass="0.1" friction="0.5"', 'mass="0.1" friction="0.7 .02 .003" condim="4" solref=".04 1.6"')
    xml = xml.replace('name="left" type="box"', 'name="left" type="box" priority="2" solref=".02 1"')
    plain, m = compiled(xml), world(xml).add(PadFriction("left")).compile()
    left, right = m.geom("left").id, m.geom("right").id
    assert m.geom_priority[[left, right]].tolist() == [3, 0]
    np.testing.assert_allclose(m.geom_friction[left], np.maximum(plain.geom_friction[left], [0.7, 0.02, 0.003]))
    assert m.geom_condim[[left, right]].tolist() == [4, 3]
    np.testing.assert_allclose(m.geom_solref[left], [0.03, 1.3])
    np.testing.assert_allclose(m.geom_solimp[left], plain.geom_solimp[left])
    lone = GRIPPER.replace("<freejoint/>", "")
    alone = world(lone).add(PadFriction("left")).compile()
    np.testing.assert_array_equal(alone.geom_solref[left], compiled(lone).geom_solref[left])
    m.geom_friction[left, 0] = 0.5
    PadFriction("left", "right").write(m, np.array([0.9]))
    assert m.geom_friction[[left, right], 0].tolist() == [0.9, 0.9]
    PadFriction("left").write(m, np.array([-1.0]))
    assert m.geom_friction[[left, right], 0].tolist() == [1e-5, 0.9]


def test_null_friction_of_pads_is_the_largest_of_pads_and_objects():
    for pads, block, null in ((0.5, 0.7, 0.7), (0.9, 0.7, 0.9)):
        xml = GRIPPER.replace('mass="0.1" friction="0.5"', f'mass="0.1" friction="{block}"')
        xml = xml.replace('mass="0.05" friction="0.5"', f'mass="0.05" friction="{pads}"')
        ghost = '<geom size=".001" friction="3" contype="0" conaffinity="0"/></body>\n</worldbody>'
        m = compiled(xml.replace("</body>\n</worldbody>", ghost))
        parameter = PadFriction("left", "right").parameters(m)[0]
        assert parameter.null == null
        assert parameter.scale == pytest.approx(0.3 * null)
        assert (min(parameter.scan), max(parameter.scan)) == pytest.approx((0.2 * null, 3 * null))
