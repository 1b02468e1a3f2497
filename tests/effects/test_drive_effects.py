import numpy as np
import pytest
from small_worlds import GRIPPER, MOTOR, SLIDER, G, move, world

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
from concent_warp.errors import ModelError

MASS, KP = 2.0, 400.0
CART = SLIDER.format(joint="", actuator=MOTOR)
SERVO = SLIDER.format(joint="", actuator=f'<position name="drive" joint="rail" kp="{KP}" kv="40"/>')
WEIGHT = SERVO.replace('gravity="0 0 0"', f'gravity="{-G} 0 0"')
"""The cart hangs on its drive, which pulls it along +x."""
LOAD = MASS * G


def test_gain_scales_what_a_motor_does_and_how_far_a_servo_sags():
    assert move(world(CART, ActuatorGain("drive"), 0.7), 0.5, ctrl=3.0).qvel[-1, 0] == pytest.approx(
        0.7 * 0.5 * 3.0 / MASS, rel=1e-6
    )
    sag = move(world(WEIGHT, ActuatorGain("drive"), 0.7), 3.0, ctrl=0.1).qpos[-1, 0] - 0.1
    assert sag == pytest.approx(-LOAD / (0.7 * KP), rel=1e-4)


ROTORS = """
<mujoco><option timestep="0.002"/><worldbody><body name="drone"><freejoint/><geom size="0.1" mass="2"/>
  <site name="left" pos="-0.2 0 0"/><site name="right" pos="0.2 0 0"/></body></worldbody>
<actuator><motor name="left" site="left" gear="0 0 1 0 0 0"/><motor name="right" site="right" gear="0 0 1 0 0 0"/>
</actuator></mujoco>"""


def test_rotors_may_lack_a_gain_a_delay_and_a_lag_where_no_joints_are_driven():
    m, both = world(ROTORS).compile(), ("left", "right")
    for effect in (ActuatorGain, ActuatorDelay, ActuatorLag):
        assert effect.targets(m) == (both,)
    for effect in (ActuatorSaturation, Backlash, JointCompliance, GripForce):
        assert effect.targets(m) == ()
    fallen = -G * 0.5 + 2 * 5.0 * 0.9 * 0.5 / MASS
    assert move(world(ROTORS, ActuatorGain(*both), 0.9, 0.9), 0.5, ctrl=5.0).qvel[-1, 2] == pytest.approx(fallen)
    sticky = ROTORS.replace("</actuator>", "<adhesion name='pull' body='drone' ctrlrange='0 1'/></actuator>")
    with pytest.raises(ModelError, match="or of sites"):
        world(sticky, ActuatorDelay("pull"), 0.1)


@pytest.mark.parametrize(("part", "kp", "kv"), [("kp", 0.7, 1.0), ("kv", 1.0, 0.7)])
def test_one_gain_of_a_servo_is_scaled_and_nothing_else(part, kp, kv):
    plain, changed = world(SERVO).compile(), world(SERVO, ActuatorGain("drive", part), 0.7).compile()
    assert changed.actuator_gainprm[0, 0] == pytest.approx(kp * KP)
    np.testing.assert_allclose(changed.actuator_biasprm[0, :3], [0, -kp * KP, -kv * 40])
    (parameter,) = ActuatorGain("drive", part).parameters(plain)
    assert parameter.name == f"{part}[drive]"


def test_single_gains_are_candidates_of_servos_that_have_both():
    assert ActuatorGain.targets(world(SERVO).compile()) == (("drive",),)
    assert ActuatorGain.single_targets(world(SERVO).compile()) == (("drive", "kp"), ("drive", "kv"))
    for xml in (CART, SERVO.replace(' kv="40"', "")):
        assert ActuatorGain.single_targets(world(xml).compile()) == ()
    with pytest.raises(ModelError, match="position servos that have both gains"):
        world(CART, ActuatorGain("drive", "kp"), 0.7)


def test_one_gain_of_a_gripper_leaves_the_limit_of_its_force():
    xml = GRIPPER.replace("<motor", '<position kp="100" kv="5" forcerange="-9 9"')
    fingers = ("left", "right")
    assert {names[-1] for names in GripForce.single_targets(world(xml).compile())} == {"kp", "kv"}
    plain, changed = world(xml).compile(), world(xml, GripForce(*fingers, "kp"), 0.5).compile()
    for name in ("actuator_forcerange", "actuator_biasprm"):
        of = getattr(plain, name).copy()
        if name == "actuator_biasprm":
            of[[plain.actuator(n).id for n in fingers], 1] *= 0.5
        np.testing.assert_allclose(getattr(changed, name), of)


def test_saturated_drive_accelerates_by_its_limit():
    cart = move(world(SERVO, ActuatorSaturation("drive"), 5.0), 0.2, ctrl=0.5)
    assert cart.qvel[-1, 0] == pytest.approx(0.2 * 5.0 / MASS, rel=1e-6)


@pytest.mark.parametrize("drive", ['joint="rail" gear="40"', 'joint="rail" gear="-40"', 'tendon="belt" gear="8"'])
def test_a_limit_is_that_of_the_force_behind_the_gear(drive):
    tendon = '<tendon><fixed name="belt"><joint joint="rail" coef="-5"/></fixed></tendon>'
    xml = CART.replace("<actuator>", f"{tendon}<actuator>").replace(
        'joint="rail"/></actuator>', f"{drive}/></actuator>"
    )
    assert drive in xml
    limit = world(xml, ActuatorSaturation("drive"), 6.0).compile().actuator_forcerange
    np.testing.assert_allclose(limit, [[-0.15, 0.15]])


def test_saturation_keeps_a_limit_that_the_model_has():
    xml = CART.replace('joint="rail"/></actuator>', 'joint="rail" forcerange="-2 2"/></actuator>')
    m = world(xml, ActuatorSaturation("drive"), 3.0).compile()
    np.testing.assert_array_equal(m.actuator_forcerange, [[-2, 2]])


@pytest.mark.parametrize("delay", [0.02, 0.0154])
def test_a_delayed_drive_follows_its_commands_later(delay):
    ramp = np.minimum(np.arange(400) * 0.002, 0.3)[:, None] ** 2
    late = move(world(SERVO, ActuatorDelay("drive"), delay), 0.4, ctrl=ramp)
    plain = move(world(SERVO), 0.4, ctrl=ramp)
    expected = np.interp(late.time - delay, plain.time, plain.qpos[:, 0])
    np.testing.assert_allclose(late.qpos[:, 0], expected, atol=2e-6)


def test_lagging_drive_reaches_63_percent_of_a_step_after_its_time_constant():
    step = np.concatenate([np.zeros(1), np.ones(499)])[:, None]
    late = ActuatorLag("drive").command(world(CART).compile(), step, np.array([0.1]))
    assert late[100, 0] == pytest.approx(1 - np.exp(-1), abs=0.004)
    cart = move(world(CART, ActuatorLag("drive"), 0.1), 0.5, ctrl=step)
    t = 0.499
    expected = (t**2 / 2 - 0.1 * t + 0.1**2 * (1 - np.exp(-t / 0.1))) / MASS
    assert cart.qpos[-1, 0] == pytest.approx(expected, rel=0.005)


def test_lag_shorter_than_a_time_step_loses_the_time_constant_times_the_step_of_the_command():
    """Whatever the steps, the area between command and set point is theirs."""
    model = world(SERVO, ActuatorLag("drive"), 0.0004)
    u = np.where(np.arange(50) < 10, 0.0, 0.3)[:, None]
    lagged = model.effects[0].effect.command(model.compile(), u, np.array([0.0004]))
    assert (u - lagged).sum() * 0.001 == pytest.approx(0.0004 * 0.3, rel=1e-9)


def test_weight_hangs_half_the_play_below_a_drive_with_backlash_and_above_it_when_pulled_up():
    for xml, side in ((WEIGHT, -1), (WEIGHT.replace(f"{-G} 0 0", f"{G} 0 0"), 1)):
        rest = move(world(xml, Backlash("drive"), 0.01), 3.0, ctrl=0.1).qpos[-1, 0]
        assert rest == pytest.approx(0.1 + side * (LOAD / KP + 0.005), abs=1e-5)


def test_backlash_with_friction_makes_a_loop_as_wide_as_the_play():
    xml = SERVO.replace('axis="1 0 0"', 'axis="1 0 0" frictionloss="2" solreffriction="0.0015 1"')
    time = np.arange(4000) * 0.001
    command = 0.05 * np.abs((time / 2 + 0.5) % 2 - 1) * 2 - 0.05
    q = move(world(xml, Backlash("drive"), 0.01), 4.0, ctrl=command[:, None]).qpos[:-1, 0]
    speed, half = 0.05, 0.005 + 2 / KP
    down, up = (time > 0.7) & (time < 0.95), (time > 2.7) & (time < 2.95)
    drag = 40 * speed / KP
    np.testing.assert_allclose(q[down] - command[down], half + drag, atol=2e-4)
    np.testing.assert_allclose(q[up] - command[up], -half - drag, atol=2e-4)


def test_link_waits_until_the_rotor_has_crossed_its_half_of_the_play():
    """The rotor goes to a command of 0.02 as 1 - exp(-t kp / kv), and has to go 0.005."""
    command = np.where(np.arange(200) < 10, 0.0, 0.02)[:, None]
    cart = move(world(SERVO, Backlash("drive"), 0.01), 0.2, ctrl=command)
    arrival = 0.01 + 40 / KP * np.log(0.02 / 0.015)
    np.testing.assert_array_equal(cart.qpos[cart.time < arrival - 0.001, 0], 0)
    later = cart.time > arrival
    start = KP * 0.015 / MASS
    np.testing.assert_allclose(cart.qvel[later, 0][:5], start * (cart.time[later][:5] - arrival), rtol=0.1)


def test_link_flies_freely_within_the_play_undamped_by_the_drive():
    cart = move(world(SERVO, Backlash("drive"), 0.05), 0.4, qvel=[0.05])
    np.testing.assert_allclose(cart.qvel[:, 0], 0.05, atol=1e-12)


def test_compliant_joint_sags_by_spring_and_drive_and_its_encoder_shows_the_drive_alone():
    c = 0.001
    model = world(WEIGHT, JointCompliance("drive"), c, 1.0)
    cart = move(model, 5.0, ctrl=0.1)
    assert cart.qpos[-1, 0] == pytest.approx(0.1 - LOAD / KP - LOAD * c, abs=1e-6)
    read = model.effects[0].effect.measure(model.compile(), cart.read, np.array([c, 1.0]))
    assert read("encoder", cart.time[-1:])[0, 0] == pytest.approx(0.1 - LOAD / KP, abs=1e-6)


def test_compliant_joint_without_damping_swings_at_the_frequency_of_both_springs_in_series():
    xml = SERVO.replace('kv="40"', "")
    c = 0.002
    x = move(world(xml, JointCompliance("drive"), c, 1.0), 1.0, qpos=[0.01]).qpos[:, 0]
    k = 1 / (1 / KP + c)
    np.testing.assert_allclose(x, 0.01 * np.cos(np.sqrt(k / MASS) * np.arange(1001) * 0.001), atol=2e-4)


@pytest.mark.parametrize("share", [0.4, 1.0, -0.3])
def test_gravity_compensation_carries_its_share_of_the_weight(share):
    xml = CART.replace('gravity="0 0 0"', f'gravity="{-G} 0 0"')
    cart = move(world(xml, GravityCompensation("cart"), share), 0.5)
    assert cart.qvel[-1, 0] == pytest.approx(-G * (1 - share) * 0.5, abs=1e-6)


@pytest.mark.parametrize(("gain", "holds"), [(0.9, False), (1.1, True)])
def test_gripper_drops_the_block_below_a_force_of_half_the_weight_over_mu(gain, holds):
    needed = 0.1 * G / (2 * 0.5)
    drop = move(world(GRIPPER, GripForce("left", "right"), gain), 0.4, ctrl=[0, needed, needed]).sensor["block"][:, 2]
    assert (drop[0] - drop[-1] < 0.003) == holds


def test_grip_force_scales_the_limits_too():
    xml = GRIPPER.replace('joint="left"/>', 'joint="left" forcerange="-2 2"/>')
    m = world(xml, GripForce("left", "right"), 3.0).compile()
    np.testing.assert_allclose(m.actuator_forcerange[m.actuator("left").id], [-6, 6])


def test_backlash_leaves_the_limits_of_a_drive_as_they_are():
    """Error 0.1 beyond the play at kp 400 would be 38 N; the limit of 5 N holds with and without play."""
    xml = SERVO.replace('kp="400.0"', 'kp="400.0" forcerange="-5 5" ctrlrange="-0.2 0.2"')
    cart = move(world(xml, Backlash("drive"), 0.01), 0.1, ctrl=7.0)
    assert cart.qvel[-1, 0] == pytest.approx(0.1 * 5.0 / MASS, rel=1e-6)
    rest = move(world(xml, Backlash("drive"), 0.01), 4.0, ctrl=7.0, qpos=[0.15])
    assert rest.qpos[-1, 0] == pytest.approx(0.2, abs=0.00501)
