"""Machines with contacts: their equations keep laws that they do not state, and agree with MuJoCo."""

from __future__ import annotations

from math import radians

import mujoco
import numpy as np
import pytest

from benchmarks.foreign import integrate as accurate
from benchmarks.foreign.contact import GRAVITY, Slab, integrate
from benchmarks.foreign.jointed import Hidden
from benchmarks.foreign.machines import (
    air_puck,
    ball_beam,
    bowling_ball,
    disc_push,
    door_push,
    gripper_lift,
    off_centre_push,
    press,
    push_box,
    squat_leg,
    tossed_block,
    vee_roller,
    wiper,
)
from benchmarks.foreign.readings import Command, command_times, conjugate, turned


def stopping_distance():
    """Return how far a pushed box slides on once it is free, and v^2 / (2 mu g)."""
    bench = push_box.Bench()
    path = push_box.push(bench, push_box.stroke(*push_box.STROKES[1]))
    gap = path[2] - bench.half_length - push_box.TIP - path[0]
    free = np.argmax((gap > 1e-4) & (path.time > 0.4))
    return path[2][-1] - path[2][free], path[3][free] ** 2 / (2 * bench.friction * GRAVITY)


def speed_of_rolling():
    """Return the speed at which a ball that slid without turning rolls, and 5/7 of that at the beginning."""
    lane = bowling_ball.Lane(rolling=0.0)
    path = bowling_ball.roll(lane, (0.0, 0.0, 1.2, 0.0, 0.0, 0.0, 0.0, 1.0))
    return path[2][-1], 5 / 7 * 1.2


def turn_of_a_spinning_ball():
    """Return the angle at which a spinning ball stops, and its kinetic energy by the torque of friction."""
    lane = bowling_ball.Lane()
    path = bowling_ball.roll(lane, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 12.0, 1.6))
    angle = np.sum(path[6]) * (path.time[1] - path.time[0])
    return angle, lane.inertia * 12.0**2 / 2 / (lane.torsion * lane.mass * GRAVITY)


def turn_of_a_spinning_disc():
    """Return the angle at which a disc that spins on its rim stops, and its energy by the torque of friction."""
    p = disc_push.Values()
    far = accurate.Held(np.zeros(1), np.zeros(1))
    start = np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 12.0])
    time = np.array([0.0, 1.0])
    state = accurate.integrate(disc_push.derivative, p, start, (far, far), (0.0, 0.0), time, 0.0)
    torque = p.friction * p.mass * GRAVITY * disc_push.RADIUS
    return state[-1, 6], p.inertia * 12.0**2 / 2 / torque


def force_of_a_held_press():
    """Return what the force cell reads while a pad is held pressed, and the pad's force less the foot's weight."""
    p = press.Values()
    machine = press.MACHINE
    motion = machine.motions(np.random.default_rng(0))[0]
    seen = machine.readings(motion, p, Hidden(), {s.name: np.array([3.6]) for s in machine.sensors})
    return seen["force_cell"][0, 2], p.pad * seen["gauge"][0, 0] + p.foot * GRAVITY


def work_of_friction_on_a_slab():
    """Return the energy that a box loses while it slides and turns, and the work of friction on it."""
    slab, mass, moment = Slab(0.05, 0.03, 0.02), 0.4, 5e-4

    def rate(_, s):
        fx, fy, torque = slab.friction(s[2], (s[3], s[4], s[5]), mass * GRAVITY, lambda *_: (0.2, 0.2))
        power = fx * s[3] + fy * s[4] + torque * s[5]
        return s[3], s[4], s[5], fx / mass, fy / mass, torque / moment, power

    path = integrate(rate, (0, 0, 0, 0.8, -0.3, 5.0, 0), 0.25, step=2e-4)
    energy = mass * (path[3] ** 2 + path[4] ** 2) / 2 + moment * path[5] ** 2 / 2
    return energy[-1] - energy[0], path[6][-1]


@pytest.mark.parametrize(
    ("law", "share"),
    [
        (stopping_distance, 0.01),
        (speed_of_rolling, 1e-3),
        (turn_of_a_spinning_ball, 0.01),
        pytest.param(turn_of_a_spinning_disc, 0.01, marks=pytest.mark.slow),
        (force_of_a_held_press, 1e-3),
        (work_of_friction_on_a_slab, 1e-3),
    ],
)
def test_motion_keeps_a_law_that_the_equations_do_not_state(law, share):
    found, expected = law()
    assert found == pytest.approx(expected, rel=share)


def test_angular_momentum_and_energy_of_a_thrown_block_stay():
    block = tossed_block.Block(wheel=(0.0, 0.006, 0.003))
    path = tossed_block.fly(block, tossed_block.THROWS[3])
    moments = np.array([block.inertia_x, block.inertia_y, block.inertia_z])
    turn = path.state[:, 4:]
    momentum = turned(path.state[:, :4], moments * turn + np.array(block.wheel))
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(turn), 1)), atol=1e-8)
    energy = turn**2 @ moments / 2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)


def replayed(model, commands, duration, read, start=None):
    """Return what MuJoCo says of a model under commands, at each of its steps."""
    m = mujoco.MjModel.from_xml_string(model)
    d = mujoco.MjData(m)
    if start is not None:
        start(d)
    rows = []
    for k in range(round(duration / m.opt.timestep)):
        d.ctrl[:] = [command(k * m.opt.timestep) for command in commands]
        mujoco.mj_step(m, d)
        rows.append(read(d))
    return np.array(rows)


def push_box_case():
    command = push_box.stroke(*push_box.STROKES[0])
    path = push_box.push(push_box.Bench(), command)
    simulated = replayed(push_box.MODEL, [command], push_box.DURATION, lambda d: d.qpos[:2].copy())
    return simulated, path.state[10::10, [0, 2]]


def ball_beam_case():
    t = command_times(2.0, 200.0)
    command = Command(t, 0.08 * np.sin(2 * np.pi * 0.8 * t))
    path = ball_beam.run(ball_beam.Beam(), 0.05, command, duration=2.0)

    def place(d):
        d.qpos[1] = 0.05

    simulated = replayed(ball_beam.MODEL, [command], 2.0, lambda d: d.qpos[:2].copy(), place)
    x = path[0] * np.cos(path[2]) + 0.03 * np.sin(path[2])
    return simulated, np.stack([path[2], x], axis=1)[5::5]


def door_push_case():
    t = command_times(door_push.DURATION)
    command = Command(t, 0.2 * np.clip((t - 0.2) / 0.8, 0, 1))
    path = door_push.swing(door_push.Door(), command, duration=2.5)
    simulated = replayed(door_push.MODEL, [command], 2.5, lambda d: d.qpos[[1, 0]].copy())
    return simulated, path.state[10::10, [0, 2]]


def gripper_lift_case():
    height, force = gripper_lift.commands(gripper_lift.RUNS[0])
    path = gripper_lift.lift(gripper_lift.Gripper(), height, force, duration=2.5)
    commands = [height, force, force]
    simulated = replayed(gripper_lift.MODEL, commands, 2.5, lambda d: d.qpos[[0, 5]] - [0.0, 0.03])
    return simulated, path.state[10::10, [0, 2]]


def air_puck_case():
    shot = air_puck.SHOTS[0]
    _, state = air_puck.glide(air_puck.Values(), shot)

    def throw(d):
        d.qpos[:], d.qvel[:] = shot[:3], shot[3:6]

    return replayed(air_puck.MODEL, [], shot[6], lambda d: d.qpos[:2].copy(), throw), state[1:, :2]


def off_centre_push_case():
    run = off_centre_push.PUSHES[0]
    held, _, path = off_centre_push.push(off_centre_push.Values(), run)
    command = Command(held.time, held.value)

    def place(d):
        d.qpos[1:3] = run[:2]
        d.qpos[4:] = [np.cos(run[2] / 2), 0.0, 0.0, np.sin(run[2] / 2)]

    duration = off_centre_push.DURATION
    simulated = replayed(off_centre_push.MODEL, [command], duration, lambda d: d.qpos[:3].copy(), place)
    return simulated, path[1:, :3]


def vee_roller_case():
    x = vee_roller.STARTS[1]
    _, state = vee_roller.roll(vee_roller.Values(), x)
    low = np.array([-0.3, vee_roller.height(-0.3)])

    def place(d):
        d.qpos[:2] = [x, vee_roller.height(x)] - low

    simulated = replayed(vee_roller.MODEL, [], vee_roller.DURATION, lambda d: d.qpos[:2] + low, place)
    return simulated, state[1:, :2]


def disc_push_case():
    stands, strokes = disc_push.RUNS[1]
    commands = disc_push.set_points(strokes)
    _, state = disc_push.push(disc_push.Values(), stands, commands)

    def place(d):
        d.qpos[2:4] = stands[:2]
        d.qpos[5:9] = [np.cos(stands[2] / 2), 0.0, 0.0, np.sin(stands[2] / 2)]

    told = [Command(c.time, c.value) for c in commands]
    simulated = replayed(disc_push.MODEL, told, disc_push.DURATION, lambda d: d.qpos[:4].copy(), place)
    return simulated, state[1:, [0, 1, 4, 5]]


def press_case():
    p, machine = press.Values(), press.MACHINE
    motion = machine.motions(np.random.default_rng(0))[1]
    held = motion.commands["screw"]
    time = np.arange(1, round(motion.duration / 5e-4) + 1) * 5e-4
    seen = machine.readings(motion, p, Hidden(), dict.fromkeys(("scale", "gauge", "force_cell"), time))

    def lower(d):
        d.qpos[1] = press.rest(p, held.value)[1]

    command = Command(held.time, held.value)
    simulated = replayed(press.MODEL, [command], motion.duration, lambda d: d.qpos[[1, 0]].copy(), lower)
    return simulated, np.concatenate([seen["scale"], seen["gauge"]], axis=1)


@pytest.mark.parametrize(
    ("case", "tolerance"),
    [
        (push_box_case, 1e-3),
        (ball_beam_case, 1e-3),
        (door_push_case, 5e-3),
        (gripper_lift_case, 1e-3),
        (air_puck_case, 5e-3),
        pytest.param(off_centre_push_case, 3e-3, marks=pytest.mark.slow),
        (vee_roller_case, 3e-3),
        (disc_push_case, 1e-3),
        (press_case, 2e-5),
    ],
)
def test_equations_with_nominal_values_agree_with_mujoco(case, tolerance):
    simulated, written = case()
    assert np.sqrt(np.mean((simulated - written) ** 2, axis=0)).max() < tolerance


@pytest.mark.parametrize(("machine", "motion"), [(squat_leg.MACHINE, 0), (squat_leg.MACHINE, 3), (wiper.MACHINE, 0)])
def test_readings_of_a_leg_and_a_wiper_agree_with_mujoco_to_a_fiftieth_of_their_range(machine, motion):
    m = mujoco.MjModel.from_xml_string(machine.model)
    steps = round(1 / m.opt.timestep)  # in a second
    run = machine.motions(np.random.default_rng(3))[motion]
    stamps = {s.name: np.arange(round(run.duration * steps)) / steps for s in machine.sensors}
    expected = np.hstack(list(machine.readings(run, machine.nominal, Hidden(), stamps).values()))
    d = mujoco.MjData(m)
    d.qpos[:] = expected[0, : m.nq]
    found = np.empty_like(expected)
    for k in range(-steps, len(found)):  # the first commands act for a second before the motion, as in the log
        now = max(k, 0) / steps + 1e-9
        for name, held in run.commands.items():
            d.ctrl[m.actuator(name).id] = held.value[np.searchsorted(held.time, now, side="right") - 1]
        mujoco.mj_step(m, d)
        if k >= 0:
            found[k] = d.sensordata  # of the beginning of the step
    assert np.all(np.sqrt(np.mean((found - expected) ** 2, axis=0)) < 0.02 * np.ptp(expected, axis=0))


def test_a_leg_in_the_air_has_the_acceleration_of_the_model_in_the_log():
    m = mujoco.MjModel.from_xml_string(squat_leg.MODEL)
    m.dof_frictionloss[:] = 0
    d = mujoco.MjData(m)
    rng = np.random.default_rng(0)
    p = squat_leg.Values(friction0=0.0, friction1=0.0, friction2=0.0)
    for _ in range(5):
        d.qpos[:] = rng.uniform([0.1, -1.0, -2.0], [0.5, 1.0, 0.0])
        d.qvel[:], d.ctrl[:] = rng.uniform(-3, 3, 3), rng.uniform([-1, -2], [1, 0])
        mujoco.mj_forward(m, d)
        rate = np.empty(7)
        squat_leg.derivative(0.0, np.concatenate([d.qpos, d.qvel, [0.0]]), d.ctrl.copy(), p, rate)
        assert d.ncon == 0
        np.testing.assert_allclose(rate[3:6], d.qacc, rtol=1e-9)


def test_a_case_is_the_same_whenever_it_is_made():
    first, second = (tossed_block.CASES[1].make() for _ in range(2))
    for one, other in zip(first.motions, second.motions, strict=True):
        for name, table in one.measured.items():
            for column, values in table.columns.items():
                np.testing.assert_array_equal(values, other.measured[name].columns[column])


def test_a_turn_and_its_inverse_leave_a_vector():
    half = radians(20)
    q = np.array([np.cos(half), 0.0, np.sin(half), 0.0])
    np.testing.assert_allclose(turned(conjugate(q), turned(q, np.array([1.0, 2.0, 3.0]))), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(turned(q, np.array([1.0, 0.0, 0.0])), [np.cos(2 * half), 0.0, -np.sin(2 * half)])
