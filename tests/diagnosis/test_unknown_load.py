"""A load that a robot carries unknown to its model."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.integrate import solve_ivp

import concent_warp as cw
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.parallel import limit_simulations

LENGTHS, MASSES, CENTRES, MOMENTS = (0.35, 0.25), (1.8, 0.8), (0.16, 0.1), (0.02, 0.005)
"""Of two links [m], [kg], of their centres of mass [m], and their inertia about these [kg m^2]."""
ARMATURE, DAMPING, KP, KV = (0.04, 0.02), (0.4, 0.2), (220.0, 90.0), (10.0, 4.0)
LOAD, PLACE = 0.35, 0.24
"""Mass of the load [kg], and where it is on the second link [m]."""
ARM = f"""<mujoco><option timestep="0.001"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 -1 0" armature="{ARMATURE[0]}" damping="{DAMPING[0]}"/>
  <inertial pos="{CENTRES[0]} 0 0" mass="{MASSES[0]}" diaginertia="0.001 {MOMENTS[0]} {MOMENTS[0]}"/>
  <body name="lower" pos="{LENGTHS[0]} 0 0">
    <joint name="elbow" axis="0 -1 0" armature="{ARMATURE[1]}" damping="{DAMPING[1]}"/>
    <inertial pos="{CENTRES[1]} 0 0" mass="{MASSES[1]}" diaginertia="0.001 {MOMENTS[1]} {MOMENTS[1]}"/></body></body>
</worldbody><actuator>
<position name="shoulder" joint="shoulder" kp="{KP[0]}" kv="{KV[0]}"/>
<position name="elbow" joint="elbow" kp="{KP[1]}" kv="{KV[1]}"/></actuator>
<sensor><jointpos name="q1" joint="shoulder"/><jointpos name="q2" joint="elbow"/></sensor></mujoco>"""
NOISE = 2e-4


def commanded(t: np.ndarray | float) -> np.ndarray:
    """Return the commands of both servos at some times [s], shape (..., 2) [rad]."""
    t = np.asarray(t)
    return np.stack([0.5 * np.sin(2.1 * t) + 0.3 * np.sin(5.3 * t), 0.7 * np.sin(3.1 * t + 1.0)], axis=-1)


def accelerations(q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the accelerations of the joints with the load: equations of motion of a double pendulum, (2,)."""
    (l1, _), (m1, m2), (c1, c2), (i1, i2) = LENGTHS, MASSES, CENTRES, MOMENTS
    first = m2 * c2 + LOAD * PLACE
    second = i2 + m2 * c2**2 + LOAD * PLACE**2
    carried = m2 + LOAD
    cos, sin = np.cos(q[1]), np.sin(q[1])
    coupled = second + l1 * first * cos
    mass = np.array(
        [[i1 + m1 * c1**2 + carried * l1**2 + second + 2 * l1 * first * cos + ARMATURE[0], coupled],
         [coupled, second + ARMATURE[1]]]
    )  # fmt: skip
    swirl = l1 * first * sin * np.array([v[1] * (2 * v[0] + v[1]), -(v[0] ** 2)])
    whole = first * np.cos(q[0] + q[1])
    weight = 9.81 * np.array([(m1 * c1 + carried * l1) * np.cos(q[0]) + whole, whole])
    torque = np.array(KP) * (u - q) - np.array(KV) * v - np.array(DAMPING) * v
    return np.linalg.solve(mass, torque + swirl - weight)


def moved(seconds: float = 6.0) -> Recording:
    """Return a recording of the loaded arm at 100 Hz."""
    clock = np.arange(0, seconds, 0.01)
    state, rows = np.array([*commanded(0.0), 0.0, 0.0]), []
    for t in clock:
        rows.append(state[:2])
        held = commanded(t)
        found = solve_ivp(
            lambda _, y, u=held: np.concatenate([y[2:], accelerations(y[:2], y[2:], u)]),
            (0.0, 0.01), state, rtol=1e-8, atol=1e-10,
        )  # fmt: skip
        state = found.y[:, -1]
    read = np.array(rows) + np.random.default_rng(0).normal(0, NOISE, (len(clock), 2))
    channels = {name: Channel(clock, read[:, [k]]) for k, name in enumerate(("q1", "q2"))}
    actions = {name: Channel(clock, commanded(clock)[:, [k]]) for k, name in enumerate(("shoulder", "elbow"))}
    return Recording(ARM, (Demonstration("demo_0", action=actions, measured=channels, qvel=np.zeros(2)),))


def test_the_equations_are_those_of_the_model_without_the_load(monkeypatch):
    monkeypatch.setitem(globals(), "LOAD", 0.0)
    m = mujoco.MjModel.from_xml_string(ARM)
    d = mujoco.MjData(m)
    state = q, v, u = np.array([0.4, -0.7]), np.array([0.8, -1.1]), np.array([0.2, 0.5])
    d.qpos[:], d.qvel[:], d.ctrl[:] = state
    mujoco.mj_forward(m, d)
    expected = accelerations(q, v, u)
    np.testing.assert_allclose(d.qacc, expected, rtol=1e-6)


def test_a_load_off_the_centre_of_mass_is_named_with_its_mass_and_place():
    """Gains of all drives explain most of it, three effects of a body together the rest."""
    with limit_simulations(1):
        found = cw.diagnose(Model(Scene(ARM)), moved(), cw.DiagnoseCfg(jobs=1, explain=False))
    assert found.verdict == "effect"
    (effect,) = found.accepted
    assert (effect.name, effect.target) == ("mass(lower, point)", ("lower", "point"))
    mass, x, _, z = effect.parameters
    assert (mass.unit, x.unit) == ("kg", "m")
    for parameter, true in ((mass, LOAD), (x, PLACE), (z, 0.0)):
        assert parameter.low <= true <= parameter.high
    assert 0.9 * LOAD < mass.value < 1.1 * LOAD
