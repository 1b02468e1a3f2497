"""Machines with joints of the foreign logs: their equations of motion against laws that they were not written from."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.foreign.jointed import Hidden, Machine, Motion
from benchmarks.foreign.machines import (
    corexy,
    double_pendulum,
    elastic_elbow,
    leg,
    reaction_wheel,
    six_axis,
    vertical_arm,
    yaw_arm,
)

STEP = 2e-4
"""Time step of the laboratory's model in these tests [s]."""
FREE = Motion(2.0, {}, np.array([1.9, -0.7, 0.0, 0.0]))


def simulated(machine: Machine, motion: Motion, start: np.ndarray, stamps: dict[str, np.ndarray]) -> np.ndarray:
    """Return all readings of the laboratory's model, without friction, shape (steps, readings)."""
    m = mujoco.MjModel.from_xml_string(machine.model)
    m.opt.timestep = STEP
    m.dof_frictionloss[:] = 0
    d = mujoco.MjData(m)
    d.qpos[:] = start[: m.nq]
    found = np.empty((1 + round(max(t[-1] for t in stamps.values()) / m.opt.timestep), m.nsensordata))
    for k in range(len(found)):
        for name, held in motion.commands.items():
            at = np.searchsorted(held.time, k * m.opt.timestep + 1e-9, side="right") - 1
            d.ctrl[m.actuator(name).id] = held.value[at]
        mujoco.mj_forward(m, d)
        found[k] = d.sensordata
        mujoco.mj_step(m, d)
    return found


def both(machine: Machine) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return readings of the laboratory's model and of the equations of motion, by sensor, without friction."""
    values = machine.nominal._replace(**{name: 0.0 for name in machine.nominal._fields if "friction" in name})
    motion = machine.motions(np.random.default_rng(3))[0]
    first = np.array([motion.commands[name].value[0] for name in machine.actuators])
    start = machine.rest(values, first) if motion.initial is None else motion.initial
    motion = motion._replace(duration=1.5, initial=start)
    stamps = machine.stamps(motion.duration)
    found = simulated(machine, motion, start, stamps)
    expected = machine.readings(motion, values, Hidden(), stamps)
    m = mujoco.MjModel.from_xml_string(machine.model)
    pairs = []
    for name, t in stamps.items():
        sensor = m.sensor(name)
        columns = slice(sensor.adr[0], sensor.adr[0] + sensor.dim[0])
        pairs.append((name, found[np.round(t / STEP).astype(int), columns], expected[name]))
    return pairs


@pytest.mark.parametrize(
    "machine",
    [
        double_pendulum.MACHINE,
        yaw_arm.MACHINE,
        corexy.MACHINE,
        pytest.param(six_axis.MACHINE, marks=pytest.mark.slow),
    ],
    ids=lambda machine: machine.name,
)
def test_without_friction_the_equations_agree_with_the_model_in_the_log_to_half_a_milliradian(machine):
    for name, found, expected in both(machine):
        np.testing.assert_allclose(found, expected, atol=5e-4, err_msg=name)


@pytest.mark.parametrize(
    "machine",
    [leg.MACHINE, reaction_wheel.MACHINE, elastic_elbow.MACHINE],
    ids=lambda machine: machine.name,
)
def test_without_friction_speeds_and_torques_agree_with_the_model_in_the_log_to_half_a_percent(machine):
    for name, found, expected in both(machine):
        np.testing.assert_allclose(found, expected, atol=5e-3 * np.ptp(expected), err_msg=name)


def test_a_chain_of_links_has_the_acceleration_of_the_model_in_the_log():
    m = mujoco.MjModel.from_xml_string(six_axis.MACHINE.model)
    m.dof_frictionloss[:] = 0
    d = mujoco.MjData(m)
    rng = np.random.default_rng(0)
    p = six_axis.Values(**{f"friction{k}": 0.0 for k in range(1, 7)})
    for _ in range(5):
        d.qpos[:], d.qvel[:] = rng.uniform(-1, 1, 6), rng.uniform(-2, 2, 6)
        d.ctrl[:] = rng.uniform(-1, 1, 6)
        mujoco.mj_forward(m, d)
        rate = np.empty(12)
        six_axis.derivative(0.0, np.concatenate([d.qpos, d.qvel]), d.ctrl.copy(), p, rate)
        np.testing.assert_allclose(rate[6:], d.qacc, rtol=1e-9)


def test_a_double_pendulum_without_damping_keeps_its_energy():
    p = double_pendulum.Values(damping1=0.0, damping2=0.0)
    machine = double_pendulum.MACHINE
    t = np.linspace(0, 2, 4001)
    seen = machine.readings(FREE, p, Hidden(), {"knee": t, "tip": t})
    upper = seen["knee"] - [0, 0, 0.9]
    lower = seen["tip"] - seen["knee"]
    bodies = (
        (p.mass1, p.inertia1, upper * p.centre1 / p.length1, upper),
        (p.mass2, p.inertia2, upper + lower * p.centre2 / p.tip, lower),
    )
    energy = np.zeros(len(t))
    for mass, inertia, centre, link in bodies:
        speed = np.gradient(centre, t, axis=0, edge_order=2)
        turn = np.gradient(np.unwrap(np.arctan2(link[:, 0], -link[:, 2])), t, edge_order=2)
        energy += mass * 9.81 * centre[:, 2] + 0.5 * mass * (speed**2).sum(axis=1) + 0.5 * inertia * turn**2
    assert np.ptp(energy[2:-2]) < 1e-4
    assert np.ptp(seen["tip"][:, 2]) > 0.3


def test_a_two_link_arm_sags_until_its_servos_carry_its_weight():
    p = vertical_arm.Values(friction1=0.0, friction2=0.0)
    machine = vertical_arm.MACHINE
    motion = machine.motions(np.random.default_rng(0))[0]._replace(duration=0.05)
    seen = machine.readings(motion, p, Hidden(), machine.stamps(motion.duration))
    q1, q2 = seen["shoulder_angle"][0, 0], seen["elbow_angle"][0, 0]
    centres = [(p.mass1, p.centre1, 0.0), (p.mass2, p.length1, p.centre2), (p.mass3, p.length1, 0.3)]
    about_shoulder = sum(9.81 * mass * (a * np.cos(q1) + b * np.cos(q1 + q2)) for mass, a, b in centres)
    about_elbow = sum(9.81 * mass * b * np.cos(q1 + q2) for mass, _, b in centres)
    u1, u2 = (motion.commands[name].value[0] for name in machine.actuators)
    assert p.kp1 * (u1 - q1) == pytest.approx(about_shoulder, rel=1e-4)
    assert p.kp2 * (u2 - q2) == pytest.approx(about_elbow, rel=1e-4)
    assert seen["marker"][0, 2] < 0.8 + 0.3 * np.sin(u1) + 0.33 * np.sin(u1 + u2)


def test_a_log_is_the_same_each_time():
    case = yaw_arm.CASES[-1]
    one, other = case.make(), case.make()
    assert one.model == other.model
    for a, b in zip(one.motions, other.motions, strict=True):
        for name, table in a.measured.items():
            for column, values in table.columns.items():
                np.testing.assert_array_equal(values, b.measured[name].columns[column])
