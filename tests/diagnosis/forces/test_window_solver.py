"""Parts of the window solver against independent formulas, on random numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from concent_warp.diagnosis.forces.cfg import LocateForcesCfg, WindowSolverCfg
from concent_warp.diagnosis.forces.window_forces import INSTANT_WEIGHTS, INSTANTS, window_forces, window_length
from concent_warp.diagnosis.forces.window_solver import (
    Readings,
    Simulated,
    WindowSolver,
    _fitted,
    _misfit,
    _response,
    _sliding_damping,
)
from concent_warp.errors import RecordingError
from concent_warp.simulate.engine import ContactLog, Variants

ANY: Any = None


def test_weights_are_those_of_the_average_in_a_window():
    np.testing.assert_allclose(INSTANTS, [0.1, 0.3, 0.5, 0.7, 0.9])
    raw = np.array([0.1 * 0.9, 0.3 * 0.7, 0.5 * 0.5, 0.3 * 0.7, 0.1 * 0.9]) ** 2
    np.testing.assert_allclose(INSTANT_WEIGHTS, raw / raw.sum())


def test_response_is_the_solution_of_its_differential_equation():
    rng, n, length, substeps = np.random.default_rng(0), 3, 0.2, 10
    stiffness, damping = -40 * rng.random((n, n)), -5 * rng.random((n, n))
    response = _response(stiffness, damping, length, substeps)
    assert response.shape == (substeps + 1, 3 * n, 3 * n)
    start = rng.normal(size=3 * n)

    def motion(_, state):
        e, rate, a = state.reshape(3, n)
        return np.concatenate([rate, stiffness @ e + damping @ rate + a, 0 * a])

    time = np.linspace(0, length, substeps + 1)
    expected = solve_ivp(motion, (0, length), start, t_eval=time, rtol=1e-10, atol=1e-12).y.T
    np.testing.assert_allclose(response @ start, expected, rtol=1e-6, atol=1e-9)


def fitted_reference(readings, response, length, groups, errors):
    """Return accelerations and covariance of weighted least squares, row by row."""
    n, substeps = response.shape[1] // 3, len(response) - 1
    rows, owner, targets = [], [], []
    for r in readings:
        for i, t in enumerate(r.clock):
            at = np.stack([[np.interp(t, np.linspace(0, length, substeps + 1), response[:, row, c])
                            for c in range(3 * n)] for row in r.rows])  # fmt: skip
            rows += list(at / r.std)
            owner += [groups[row % n] for row in r.rows]
            targets.append(r.off[:, i] / r.std)
    matrix, target, owner = np.array(rows), np.concatenate(targets, axis=1), np.array(owner)
    found = np.stack([np.linalg.lstsq(matrix, t, rcond=None)[0][2 * n :] for t in target])
    mean = target.mean(axis=0)
    left = mean - matrix @ np.linalg.lstsq(matrix, mean, rcond=None)[0]
    factor = []
    for g in groups:
        mine = owner == g
        freedom = mine.sum() - 3 * (groups == g).sum()
        ratio = (left[mine] ** 2).sum() / freedom
        factor.append(ratio if ratio > 1 + errors * np.sqrt(2 / freedom) else 1.0)
    known = np.linalg.inv(matrix.T @ matrix)[2 * n :, 2 * n :]
    return found, np.sqrt(np.outer(factor, factor)) * known


@pytest.mark.parametrize("grouped", [False, True])
def test_fit_is_weighted_least_squares_with_variances_that_grow_with_the_misfit(grouped):
    rng, length = np.random.default_rng(1), 0.2
    response = _response(-30 * np.eye(2), -np.array([[2.0, 0.5], [0.0, 1.0]]), length, 8)
    groups = np.array([0, 0]) if grouped else np.array([0, 1])
    readings = [
        Readings(np.sort(rng.uniform(0, length, 9)), rng.normal(0, 0.02, (3, 9, 1)), 0.01, np.array([0])),
        Readings(np.sort(rng.uniform(0, length, 11)), rng.normal(0, 0.002, (3, 11, 1)), 0.02, np.array([1])),
        Readings(np.linspace(0, length, 7), rng.normal(0, 0.3, (3, 7, 2)), 0.1, np.array([2, 3])),
    ]
    found, covariance = _fitted(readings, response, length, groups, 1.0)
    expected, known = fitted_reference(readings, response, length, groups, 1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_allclose(covariance, known, rtol=1e-6)


def test_misfit_counts_from_so_many_standard_errors_on():
    bound = 1 + 2.0 * np.sqrt(2 / 8)
    assert _misfit(8 * bound * 0.999, 8, 2.0) == 1.0
    assert _misfit(8 * bound * 1.001, 8, 2.0) == pytest.approx(1.001 * bound)
    assert _misfit(100.0, 1, 2.0) == 100.0
    assert _misfit(100.0, 0, 2.0) == 1.0


TWO = """
<mujoco><option timestep="0.01" gravity="0 0 -9"/><worldbody>
  <body><joint name="a" axis="0 1 0" damping=".2" stiffness="3"/><geom size=".05" mass="1.5" pos=".1 0 0"/>
    <body pos=".2 0 0"><joint name="b" axis="0 1 0" damping=".1"/><geom size=".05" mass=".5" pos=".1 0 0"/></body>
  </body></worldbody><actuator><position joint="a" kp="30" kv="2"/></actuator></mujoco>"""


def solver_of(m: mujoco.MjModel, length: float, *, bodies=(), joints=()) -> WindowSolver:
    """Return a solver of windows of what moves."""
    engine: Any = SimpleNamespace(timestep=m.opt.timestep, compiled=m)
    motion: Any = SimpleNamespace(bodies=bodies, joints=joints)
    return WindowSolver(motion, engine, length, WindowSolverCfg())


def signal(time: np.ndarray, value: np.ndarray, std: float) -> Any:
    """Return readings of a signal."""
    return SimpleNamespace(time=time, value=value, std=std)


def test_readings_are_compared_with_the_simulation_between_its_steps():
    m, rng = mujoco.MjModel.from_xml_string(TWO), np.random.default_rng(2)
    solver, start = solver_of(m, 0.1), 0.5
    path = rng.normal(size=(2, 11, 3))
    time = np.array([0.499, 0.5, 0.5037, 0.55, 0.5999, 0.6, 0.601])
    value = rng.normal(size=(7, 3))
    found = solver._readings(start, signal(time, value, 0.2), path, np.arange(3), turning=False)
    inside = slice(1, 6)
    np.testing.assert_allclose(found.clock, time[inside] - start)
    steps = start + 0.01 * np.arange(11)
    for v in range(2):
        expected = np.stack([np.interp(time[inside], steps, path[v, :, i]) for i in range(3)], axis=1)
        np.testing.assert_allclose(found.off[v], value[inside] - expected, atol=1e-9)
    assert found.std == 0.2
    assert found.rows.tolist() == [0, 1, 2]


def test_orientations_are_compared_by_the_rotation_between_them_in_the_world():
    m, rng = mujoco.MjModel.from_xml_string(TWO), np.random.default_rng(3)
    turns = Rotation.from_rotvec(rng.normal(size=(2, 3)))
    off = Rotation.from_rotvec(rng.normal(0, 0.1, (2, 3)))
    path = np.repeat(turns.as_quat(scalar_first=True)[:1, None], 11, axis=1)
    measured = (off * turns[:1]).as_quat(scalar_first=True)
    reading = signal(np.array([0.02, 0.055]), measured, 0.1)
    found = solver_of(m, 0.1)._readings(0.0, reading, path, np.arange(3, 6), turning=True)
    np.testing.assert_allclose(found.off[0], off.as_rotvec(), atol=1e-9)
    empty = signal(np.array([5.0]), measured[:1], 0.1)
    assert solver_of(m, 0.1)._readings(0.0, empty, path, np.arange(3, 6), turning=True).off.shape[:2] == (1, 0)


def test_drives_pull_back_by_their_gains_over_the_inertia():
    m = mujoco.MjModel.from_xml_string(TWO)
    solver = solver_of(m, 0.1)
    solver.data.qpos[:], solver.data.qvel[:] = [0.3, -0.4], [0.1, 0.2]
    mujoco.mj_forward(solver.model, solver.data)
    joints: Any = [SimpleNamespace(dof=i, qpos=i) for i in range(2)]
    stiffness, damping = solver._drives(joints)
    d = mujoco.MjData(m)

    def acceleration(qpos, qvel):
        d.qpos[:], d.qvel[:] = qpos, qvel
        mujoco.mj_forward(m, d)
        return d.qacc_smooth.copy()

    h = 1e-6
    for k in range(2):
        step = h * np.eye(2)[k]
        q, v = np.array([0.3, -0.4]), np.array([0.1, 0.2])
        np.testing.assert_allclose(
            stiffness[:, k], (acceleration(q + step, v) - acceleration(q - step, v)) / (2 * h), rtol=1e-3, atol=2e-2
        )
        np.testing.assert_allclose(
            damping[:, k], (acceleration(q, v + step) - acceleration(q, v - step)) / (2 * h), rtol=1e-3, atol=2e-2
        )
    np.testing.assert_allclose(solver.data.qpos, [0.3, -0.4], atol=1e-9)


SLIDING = """
<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body name="fixed"><geom size=".1"/></body>
  <body name="link"><joint/><geom size=".1"/></body>
  <body name="block"><freejoint/><geom type="box" size=".1 .1 .1" mass=".4"/></body></worldbody></mujoco>"""


def test_damping_by_sliding_is_the_derivative_of_friction_by_the_motion():
    """Friction of fixed size against the slip, at contacts with the floor or what is fixed to it, on either side."""
    m, rng = mujoco.MjModel.from_xml_string(SLIDING), np.random.default_rng(4)
    steps = 3
    geom = np.array([[0, 3], [1, 3], [2, 3], [0, 1]])
    pose = np.concatenate([rng.normal(0, 0.1, (steps, 3)), Rotation.random(steps, rng).as_quat(scalar_first=True)], 1)
    twist = rng.normal(0, 0.5, (steps, 6))
    normal = rng.normal(size=(4, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    log = ContactLog(
        np.zeros(4, int), np.array([0, 2, 1, 1]), geom, rng.normal(0, 0.2, (4, 3)), normal, np.zeros(4),
        rng.normal(size=(4, 3)),
    )  # fmt: skip
    path = np.concatenate([np.zeros((steps, 1)), pose], axis=1)[None]
    speed = np.concatenate([np.zeros((steps, 1)), twist], axis=1)
    window = Simulated(0.0, path, speed, ANY, ANY, ANY, log)
    body: Any = SimpleNamespace(body=m.body("block").id, qpos=1, dof=1)
    found = _sliding_damping(m, window, body, 1e-3)

    def friction(row: int, move: np.ndarray) -> np.ndarray:
        """Return force and torque about the origin of a contact at another motion, world frame."""
        k, n = log.step[row], log.normal[row]
        spin = Rotation.from_quat(pose[k, 3:], scalar_first=True).apply(twist[k, 3:]) + move[3:]
        arm = log.position[row] - pose[k, :3]
        slip = twist[k, :3] + move[:3] + np.cross(spin, arm)
        slip = slip - n * (n @ slip)
        size = np.linalg.norm(log.force[row] - n * (n @ log.force[row]))
        force = size * slip / np.linalg.norm(slip)
        return np.concatenate([force, np.cross(arm, force)])

    expected, h = np.zeros((6, 6)), 1e-6
    for row in (0, 1):
        for k in range(6):
            step = h * np.eye(6)[k]
            expected[:, k] += (friction(row, step) - friction(row, -step)) / (2 * h)
    np.testing.assert_allclose(found, expected / (steps - 1), rtol=1e-5, atol=1e-7)
    slow = _sliding_damping(m, window, body, 1e3)
    assert 0 < np.abs(slow).max() < 1e-2
    free: Any = SimpleNamespace(body=m.body("link").id, qpos=0, dof=0)
    assert (_sliding_damping(m, Simulated(0.0, path, speed, ANY, ANY, ANY, log), free, 1e-3) == 0).all()


def test_window_of_joints_is_solved_with_their_mass_and_the_scatter_of_the_starts():
    """Readings depart by a constant acceleration: the force is the mass matrix times it."""
    m = mujoco.MjModel.from_xml_string(TWO.replace('stiffness="3"', "").replace('damping=".2"', ""))
    m.opt.gravity[:] = 0
    m.actuator_gainprm[:], m.actuator_biasprm[:] = 0, 0
    m.dof_damping[:] = 0
    time, wanted = 0.01 * np.arange(11), np.array([2.0, -3.0])
    path = np.zeros((3, 11, 2))
    path[1], path[2] = np.outer(time**2, [0.25, 0.5]), np.outer(time**2, [-0.25, -0.5])
    joints = [
        SimpleNamespace(dof=i, qpos=i, velocity=None, position=signal(time, 0.5 * wanted[i] * time[:, None] ** 2, 1e-3))
        for i in range(2)
    ]
    solver = solver_of(m, 0.1, joints=joints)
    qpos = np.array([0.2, 0.4])
    window = Simulated(0.0, path, np.zeros((11, 2)), qpos, np.zeros(2), np.zeros((10, 1)), ANY)
    force, covariance = solver.solve(window)
    d, mass = mujoco.MjData(m), np.zeros((2, 2))
    d.qpos[:] = qpos
    mujoco.mj_forward(m, d)
    mujoco.mj_fullM(m, d, mass)
    np.testing.assert_allclose(force, mass @ wanted, rtol=1e-5)
    alone = solver.solve(Simulated(0.0, path[:1], np.zeros((11, 2)), qpos, np.zeros(2), np.zeros((10, 1)), ANY))[1]
    scatter = np.cov(np.array([[0.0, 0], [-0.5, -1.0], [0.5, 1.0]]), rowvar=False, ddof=1)
    np.testing.assert_allclose(covariance, alone + mass @ scatter @ mass, rtol=1e-4)
    design = np.stack([np.ones(11), time, time**2 / 2], axis=1) / 1e-3
    np.testing.assert_allclose(alone, mass @ mass * np.linalg.inv(design.T @ design)[2, 2], rtol=1e-4)
    few = [SimpleNamespace(**{**vars(j)}) for j in joints]
    few[1].position = signal(time[:4], joints[1].position.value[:4], 1e-3)
    force, covariance = solver_of(m, 0.1, joints=few).solve(window)
    assert np.isnan(force[1])
    assert force[0] == pytest.approx(mass[0, 0] * wanted[0], rel=1e-5)
    assert (covariance[1] == 0).all()
    assert (covariance[:, 1] == 0).all()
    lost = path.copy()
    lost[1, 3, 0] = np.nan
    force, covariance = solver.solve(Simulated(0.0, lost, ANY, qpos, np.zeros(2), np.zeros((10, 1)), ANY))
    assert np.isnan(force).all()
    assert (covariance == 0).all()


def test_velocities_of_joints_add_to_what_is_known():
    m = mujoco.MjModel.from_xml_string(TWO)
    time = 0.01 * np.arange(11)
    joint = SimpleNamespace(dof=0, qpos=0, velocity=None, position=signal(time, np.zeros((11, 1)), 1e-3))
    other = SimpleNamespace(dof=1, qpos=1, velocity=None, position=signal(time, np.zeros((11, 1)), 1e-3))
    window = Simulated(0.0, np.zeros((1, 11, 2)), np.zeros((11, 2)), np.zeros(2), np.zeros(2), np.zeros((10, 1)), ANY)
    both = []
    for velocity in (None, signal(time, np.zeros((11, 1)), 1e-3)):
        other.velocity = velocity
        both.append(solver_of(m, 0.1, joints=[joint, other]).solve(window)[1])
    inverse = np.linalg.inv(_mass(m))
    before, after = (np.diag(inverse @ c @ inverse) for c in both)
    assert after[1] < 0.25 * before[1]
    assert after[0] < before[0]


def _mass(m: mujoco.MjModel) -> np.ndarray:
    """Return the mass matrix at rest, shape (nv, nv)."""
    d, mass = mujoco.MjData(m), np.zeros((m.nv, m.nv))
    mujoco.mj_forward(m, d)
    mujoco.mj_fullM(m, d, mass)
    return mass


@pytest.mark.parametrize("turning", [False, True])
def test_window_of_a_body_gives_force_in_the_world_and_torque_in_the_body(turning):
    m = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep=".01" gravity="0 0 0"/><worldbody><body name="block"><freejoint/>'
        '<geom type="box" size=".1 .05 .02" mass=".4"/></body></worldbody></mujoco>'
    )
    time = 0.01 * np.arange(11)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9])
    push, twist = np.array([1.0, -2.0, 3.0]), np.array([0.4, 0.2, -0.3])
    pose = np.concatenate([np.zeros(3), turn.as_quat(scalar_first=True)])
    path = np.tile(pose, (1, 11, 1))
    position = signal(time, 0.5 * np.outer(time**2, push), 1e-3)
    turned = Rotation.from_rotvec(0.5 * np.outer(time**2, twist)) * turn
    orientation = signal(time, turned.as_quat(scalar_first=True), 1e-2) if turning else None
    body = SimpleNamespace(body=1, qpos=0, dof=0, position=position, orientation=orientation)
    empty = np.zeros(0, int)
    log = ContactLog(empty, empty, np.zeros((0, 2), int), np.zeros((0, 3)), np.zeros((0, 3)), empty, np.zeros((0, 3)))
    window = Simulated(0.0, path, np.zeros((11, 6)), pose, np.zeros(6), np.zeros((10, 0)), log)
    force, covariance = solver_of(m, 0.1, bodies=[body]).solve(window)
    np.testing.assert_allclose(force[:3], 0.4 * push, rtol=1e-6)
    known = np.linalg.inv((d := np.stack([np.ones(11), time, time**2 / 2], axis=1)).T @ d)[2, 2]
    np.testing.assert_allclose(covariance[:3, :3], 0.16e-6 * known * np.eye(3), atol=1e-9)
    if turning:
        np.testing.assert_allclose(force[3:], m.body_inertia[1] * turn.inv().apply(twist), rtol=1e-5)
        expected = 1e-4 * known * np.diag(m.body_inertia[1] ** 2)
        np.testing.assert_allclose(covariance[3:, 3:], expected, rtol=1e-5, atol=1e-12)
    else:
        assert np.isnan(force[3:]).all()
        assert (covariance[3:] == 0).all()
    body.position = signal(time[:4], position.value[:4], 1e-3)
    assert np.isnan(solver_of(m, 0.1, bodies=[body]).solve(window)[0]).all()


def test_default_windows_are_longer_where_readings_are_coarse_or_rare():
    def length(bodies, period):
        motion: Any = SimpleNamespace(bodies=bodies, period=period)
        return window_length(motion)

    assert length((), 0.001) == 0.1
    assert length((1,), 0.001) == 0.12
    assert length((), 0.02) == pytest.approx(0.16)
    assert length((1,), 0.1) == 0.3


class StillEngine:
    """An engine of one joint whose variants stay where they start."""

    timestep = 0.01

    def __init__(self) -> None:
        self.compiled = mujoco.MjModel.from_xml_string(TWO)
        self.runs: list[tuple[Variants, np.ndarray]] = []

    def run(self, variants: Variants, ctrl: np.ndarray, **_: Any) -> Any:
        """Return a rollout that stays."""
        self.runs.append((variants, ctrl))
        count, steps = variants.count, ctrl.shape[-2]
        qpos = np.repeat(np.asarray(variants.qpos)[:, None], steps + 1, axis=1)
        qvel = np.repeat(np.asarray(variants.qvel)[:, None], steps + 1, axis=1)
        empty = np.zeros(0, int)
        log = ContactLog(empty, empty, np.zeros((0, 2), int), np.zeros((0, 3)), np.zeros((0, 3)), empty, empty)
        rollout = SimpleNamespace(qpos=qpos, qvel=qvel, contacts=log, count=count)
        return SimpleNamespace(numpy=lambda: rollout)


class MarkedMotion:
    """A motion whose states are the times."""

    bodies, period = (), 0.001

    def __init__(self, begin: float, end: float) -> None:
        self.span = begin, end
        self.ctrl = 0.01 * np.arange(60.0)[:, None]
        time = 0.01 * np.arange(100)
        self.joints = [
            SimpleNamespace(dof=i, qpos=i, velocity=None, position=signal(time, time[:, None], 1e-3)) for i in range(2)
        ]

    def states(self, time: np.ndarray) -> Any:
        """Return positions that are the time, and velocities that are twice it."""
        time = np.asarray(time)[:, None]
        return SimpleNamespace(qpos=np.repeat(time, 2, 1), qvel=np.repeat(2 * time, 2, 1))

    def sample_states(self, time: np.ndarray, extra: int, _rng: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return states, each further start a hundred later."""
        found = self.states(time)
        shift = 100.0 * np.arange(1 + extra)[:, None, None]
        return found.qpos[None] + shift, found.qvel[None] + shift


@pytest.mark.parametrize("extra", [0, 2])
def test_windows_overlap_by_half_from_the_first_reading_to_the_last(extra):
    engine, motion = StillEngine(), MarkedMotion(0.035, 0.655)
    found = window_forces("d", engine, motion, LocateForcesCfg(length=0.1, extra_starts=extra))  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(found.start, [0.04 + 0.05 * k for k in range(11)])
    assert found.length == pytest.approx(0.1)
    np.testing.assert_allclose(found.time, found.start + 0.05)
    np.testing.assert_allclose(found.qpos, np.repeat(found.time[:, None], 2, 1))
    np.testing.assert_allclose(found.qvel, np.repeat(2 * found.time[:, None], 2, 1))
    np.testing.assert_allclose(found.edge_qvel[0, :, 0], 2 * found.start)
    np.testing.assert_allclose(found.edge_qvel[1, :, 0], 2 * (found.start + 0.1))
    variants, ctrl = engine.runs[0]
    assert variants.count == 11
    steps = 4 + 5 * np.arange(11)[:, None] + np.arange(10)
    np.testing.assert_allclose(ctrl[..., 0], 0.01 * np.minimum(steps, 59))
    assert len(engine.runs) == 1 + (extra > 0)
    if extra:
        again, same = engine.runs[1]
        assert again.count == 22
        np.testing.assert_array_equal(same, ctrl)
        np.testing.assert_allclose(np.asarray(again.qpos)[:, 0], [*(found.start + 100), *(found.start + 200)])
    np.testing.assert_allclose(found.path[:, :, 0], np.repeat(found.start[:, None], 11, 1))
    assert np.isfinite(found.force).all()
    np.testing.assert_allclose(found.std, np.sqrt(found.covariance[:, [0, 1], [0, 1]]))


@pytest.mark.parametrize(("end", "fits"), [(0.151, True), (0.149, False)])
def test_a_demonstration_has_at_least_one_and_a_half_windows(end, fits):
    cfg = LocateForcesCfg(length=0.1, extra_starts=0)
    engine: Any = StillEngine()
    motion: Any = MarkedMotion(0.0, end)
    if fits:
        assert len(window_forces("d", engine, motion, cfg).start) == 2
        return
    with pytest.raises(RecordingError, match=r"too short a time.*d.*at least 0.15 s.*0.149 s"):
        window_forces("d", engine, motion, cfg)


def test_windows_have_at_least_four_steps():
    engine: Any = StillEngine()
    motion: Any = MarkedMotion(0.0, 0.3)
    assert window_forces("d", engine, motion, LocateForcesCfg(length=0.01, extra_starts=0)).length == pytest.approx(
        0.04
    )
