"""The unexplained force in one window, from departures of the readings from the model's simulation.

Departures e respond to their own start and to an unexplained acceleration a,

    e'' = Aq e + Av e' + a,

where Aq and Av are stiffness and damping over inertia: of drives and springs for joints, of sliding friction for a free
body (friction keeps its size but turns with the velocity, which damps velocities across it by its size over the speed).
Solved by the matrix exponential, and by least squares for e and e' at the start and for a.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from concent_warp.diagnosis.forces.cfg import WindowSolverCfg

if TYPE_CHECKING:
    from concent_warp.estimation.signals import MeasuredBody, MeasuredJoint
    from concent_warp.estimation.signals import Readings as SignalReadings
    from concent_warp.estimation.state_estimator import StateEstimator
    from concent_warp.simulate.engine import ContactLog, Engine


@dataclass(frozen=True)
class Simulated:
    """The model's simulation of one window."""

    start: float
    """[s]."""
    path: np.ndarray
    """Positions from each starting state, shape (V, S + 1, nq), the smoothed state first."""
    speed: np.ndarray
    """Velocities from the smoothed state, shape (S + 1, nv)."""
    qpos: np.ndarray
    """Measured state in the middle, shape (nq,)."""
    qvel: np.ndarray
    """Shape (nv,)."""
    ctrl: np.ndarray
    """Commands, shape (S, nu)."""
    contacts: ContactLog
    """Of the simulation from the smoothed state."""


@dataclass(frozen=True)
class Readings:
    """Readings of one signal in a window."""

    clock: np.ndarray
    """Since the start [s], shape (n,)."""
    off: np.ndarray
    """Measured less simulated, shape (V, n, dim)."""
    std: float
    rows: np.ndarray
    """Rows of the state of departures that it shows, shape (dim,)."""


class WindowSolver:
    """Turns departures from simulated windows into forces."""

    def __init__(self, motion: StateEstimator, engine: Engine, length: float, cfg: WindowSolverCfg) -> None:
        """Prepare to solve windows of a length [s] of a motion."""
        self.motion = motion
        self.timestep = engine.timestep
        self.length, self.cfg = length, cfg
        self.model = copy.copy(engine.compiled)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self.data = mujoco.MjData(self.model)

    def solve(self, window: Simulated) -> tuple[np.ndarray, np.ndarray]:
        """Return the unexplained generalised force (nv,), NaN where not known, and its covariance (nv, nv)."""
        m, d = self.model, self.data
        acceleration = np.zeros((len(window.path), m.nv))
        noise = np.zeros((m.nv, m.nv))
        known = np.ones(m.nv, dtype=bool)
        if not np.isfinite(window.path).all():
            return np.full(m.nv, np.nan), noise
        d.qpos[:], d.qvel[:] = window.qpos, window.qvel
        if m.nu:
            d.ctrl[:] = window.ctrl[len(window.ctrl) // 2]
        mujoco.mj_forward(m, d)
        mass = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, mass)
        for body in self.motion.bodies:
            self._body(window, body, mass, acceleration, noise, known)
        self._joints(window, acceleration, noise, known)
        acceleration[:, ~known] = 0
        noise[~known], noise[:, ~known] = 0, 0
        if len(acceleration) > 1:
            noise += np.cov(acceleration, rowvar=False, ddof=1).reshape(m.nv, m.nv)
        force = mass @ acceleration.mean(axis=0)
        covariance = mass @ noise @ mass
        force[~known] = np.nan
        covariance[~known], covariance[:, ~known] = 0, 0
        return force, covariance

    def _body(
        self,
        window: Simulated,
        body: MeasuredBody,
        mass: np.ndarray,
        acceleration: np.ndarray,
        noise: np.ndarray,
        known: np.ndarray,
    ) -> None:
        """Write the acceleration of a free body, in the frames of its generalised velocity."""
        count = 3 if body.orientation is None else 6
        position = window.path[:, :, body.qpos : body.qpos + 3]
        readings = [self._readings(window.start, body.position, position, np.arange(3), turning=False)]
        if body.orientation is not None:
            quaternion = window.path[:, :, body.qpos + 3 : body.qpos + 7]
            readings.append(self._readings(window.start, body.orientation, quaternion, np.arange(3, 6), turning=True))
        known[body.dof + count : body.dof + 6] = False
        if min(len(r.clock) for r in readings) < self.cfg.min_readings:
            known[body.dof : body.dof + 6] = False
            return
        # World frame for both: the error of an angular velocity turns with the body, but not in the world.
        frame = np.eye(6)
        frame[3:, 3:] = Rotation.from_quat(window.qpos[body.qpos + 3 : body.qpos + 7], scalar_first=True).as_matrix()
        inertia = frame @ mass[body.dof : body.dof + 6, body.dof : body.dof + 6] @ frame.T
        damping = _sliding_damping(self.model, window, body, self.cfg.min_sliding_speed)
        rate = -np.linalg.solve(inertia, damping)[:count, :count]
        groups = np.repeat([0, 1], 3)[:count]
        response = _response(np.zeros((count, count)), rate, self.length, self.cfg.substeps)
        found, covariance = _fitted(readings, response, self.length, groups, self.cfg.misfit_standard_errors)
        back = frame[:count, :count]
        dofs = slice(body.dof, body.dof + count)
        acceleration[:, dofs] = found @ back
        noise[dofs, dofs] = back.T @ covariance @ back

    def _joints(self, window: Simulated, acceleration: np.ndarray, noise: np.ndarray, known: np.ndarray) -> None:
        """Write the accelerations of the joints, solved together since they are coupled."""
        joints: list[MeasuredJoint] = []
        readings: list[Readings] = []
        for joint in self.motion.joints:
            path = window.path[:, :, joint.qpos, None]
            found = self._readings(window.start, joint.position, path, np.array([len(joints)]), turning=False)
            known[joint.dof] = len(found.clock) >= self.cfg.min_readings
            if known[joint.dof]:
                joints.append(joint)
                readings.append(found)
        if not joints:
            return
        count, dofs = len(joints), np.array([j.dof for j in joints])
        for i, joint in enumerate(joints):
            if joint.velocity is not None:
                path = np.broadcast_to(window.speed[:, joint.dof, None], (len(window.path), len(window.speed), 1))
                readings.append(
                    self._readings(window.start, joint.velocity, path, np.array([count + i]), turning=False)
                )
        response = _response(*self._drives(joints), self.length, self.cfg.substeps)
        groups = np.arange(count)
        found, covariance = _fitted(readings, response, self.length, groups, self.cfg.misfit_standard_errors)
        acceleration[:, dofs] = found
        noise[np.ix_(dofs, dofs)] = covariance

    def _drives(self, joints: list[MeasuredJoint]) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives of joint accelerations by positions and velocities, without constraints, (n, n) each."""
        m, d = self.model, self.data
        dofs = [j.dof for j in joints]
        base, step = d.qacc_smooth[dofs].copy(), 1e-5
        columns = []
        for array, address in [(d.qpos, j.qpos) for j in joints] + [(d.qvel, j.dof) for j in joints]:
            array[address] += step
            mujoco.mj_forward(m, d)
            array[address] -= step
            columns.append((d.qacc_smooth[dofs] - base) / step)
        both = np.stack(columns, axis=1)
        return both[:, : len(joints)], both[:, len(joints) :]

    def _readings(
        self, start: float, signal: SignalReadings, path: np.ndarray, rows: np.ndarray, *, turning: bool
    ) -> Readings:
        """Return the readings of a signal in a window against what was simulated, `path` (V, S + 1, dim)."""
        chosen = np.flatnonzero((signal.time >= start) & (signal.time <= start + self.length))
        clock = signal.time[chosen] - start
        place = clock / self.timestep
        step = np.clip(place.astype(int), 0, path.shape[1] - 2)
        share = np.clip(place - step, 0.0, 1.0)[:, None]
        predicted = path[:, step] * (1 - share) + path[:, step + 1] * share
        if turning and len(chosen):
            measured = Rotation.from_quat(signal.value[chosen], scalar_first=True)
            off = np.stack([(measured * Rotation.from_quat(p, scalar_first=True).inv()).as_rotvec() for p in predicted])
        else:
            off = signal.value[chosen] - predicted
        return Readings(clock, off, signal.std, rows)


def _sliding_damping(m: mujoco.MjModel, window: Simulated, body: MeasuredBody, min_speed: float) -> np.ndarray:
    """Return the damping of a body's motion (world frame, about its origin) by sliding on what is fixed, shape (6, 6).

    Friction f against the slip v, |f| fixed: df/dv = -|f| / |v| (1 - n n' - v v' / |v|^2), n the normal; |v| counts as
    `min_speed` [m/s] at least.
    """
    log = window.contacts
    owner = m.geom_bodyid[log.geom]
    second = np.asarray(owner[:, 1] == body.body)
    other = np.where(second, owner[:, 0], owner[:, 1])
    rows = np.flatnonzero((second | np.asarray(owner[:, 0] == body.body)) & (m.body_weldid[other] == 0))
    if not len(rows):
        return np.zeros((6, 6))
    step = log.step[rows]
    pose = window.path[0, step, body.qpos : body.qpos + 7]
    twist = window.speed[step, body.dof : body.dof + 6]
    spin = Rotation.from_quat(pose[:, 3:], scalar_first=True).apply(twist[:, 3:])
    arm = log.position[rows] - pose[:, :3]
    normal = log.normal[rows]
    slip = twist[:, :3] + np.cross(spin, arm)
    slip -= normal * (slip * normal).sum(axis=1, keepdims=True)
    speed = np.linalg.norm(slip, axis=1)
    force = log.force[rows]
    friction = np.linalg.norm(force - normal * (force * normal).sum(axis=1, keepdims=True), axis=1)
    along = slip / np.maximum(speed, 1e-9)[:, None]
    across = np.eye(3) - normal[:, :, None] * normal[:, None] - along[:, :, None] * along[:, None]
    local = (friction / np.maximum(speed, min_speed))[:, None, None] * across
    # Velocity at the contact is v + w x r = [1, -r x] [v, w].
    zero = np.zeros(len(rows))
    x, y, z = arm.T
    cross = np.stack([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    carry = np.concatenate([np.tile(np.eye(3), (len(rows), 1, 1)), -cross], axis=2)
    return np.einsum("cki,ckl,clj->ij", carry, local, carry) / (window.path.shape[1] - 1)


def _response(stiffness: np.ndarray, damping: np.ndarray, length: float, substeps: int) -> np.ndarray:
    """Return the response of departures to their start and to a constant acceleration, shape (substeps + 1, 3n, 3n).

    Rows are position, velocity and acceleration of the departures, columns what they are at the start.

    Args:
        stiffness: Aq, shape (n, n).
        damping: Av, shape (n, n).
        length: Length of the window [s].
        substeps: Instants at which the response is tabulated, besides the start.
    """
    n = len(stiffness)
    generator = np.zeros((3 * n, 3 * n))
    generator[:n, n : 2 * n] = np.eye(n)
    generator[n : 2 * n] = np.concatenate([stiffness, damping, np.eye(n)], axis=1)
    transition = expm(generator * length / substeps)
    response = np.empty((substeps + 1, 3 * n, 3 * n))
    response[0] = np.eye(3 * n)
    for k in range(substeps):
        response[k + 1] = transition @ response[k]
    return response


def _fitted(
    readings: list[Readings], response: np.ndarray, length: float, groups: np.ndarray, standard_errors: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the accelerations (V, n) that fit readings best, and the covariance (n, n) that their noise leaves.

    Args:
        readings: Of positions, and of velocities.
        response: See `_response`.
        length: Length of the window [s].
        groups: Which degrees of freedom share their misfit, shape (n,).
        standard_errors: See `WindowSolverCfg.misfit_standard_errors`.
    """
    n, substeps = response.shape[1] // 3, len(response) - 1
    design, off, group = [], [], []
    for r in readings:
        place = r.clock / length * substeps
        lower = np.clip(place.astype(int), 0, substeps - 1)
        part = (place - lower)[:, None, None]
        shown = response[lower][:, r.rows] * (1 - part) + response[lower + 1][:, r.rows] * part
        design.append(shown.reshape(-1, 3 * n) / r.std)
        off.append(r.off.reshape(len(r.off), -1) / r.std)
        group.append(np.tile(groups[r.rows % n], len(r.clock)))
    matrix, target, owner = np.concatenate(design), np.concatenate(off, axis=1), np.concatenate(group)
    size = np.repeat([1.0, 1 / length, 1 / length**2], n)
    inverse = size[:, None] * np.linalg.pinv(matrix * size)
    left = target.mean(axis=0) - matrix @ (inverse @ target.mean(axis=0))
    freedom = {g: int((owner == g).sum()) - 3 * int((groups == g).sum()) for g in np.unique(groups)}
    scale = np.array([_misfit(float((left[owner == g] ** 2).sum()), freedom[g], standard_errors) for g in groups])
    inverse = inverse[2 * n :]
    return target @ inverse.T, np.sqrt(scale[:, None] * scale) * (inverse @ inverse.T)


def _misfit(square: float, freedom: int, standard_errors: float) -> float:
    """Return the factor on variances for a window's misfit: its mean square where that is significant, else 1.

    Args:
        square: Sum of squared residuals, in noise standard deviations.
        freedom: Readings less fitted unknowns.
        standard_errors: Standard errors above 1 from which on a mean square is significant.
    """
    if freedom < 1:
        return 1.0
    mean = square / freedom
    return mean if mean > 1 + standard_errors * np.sqrt(2 / freedom) else 1.0
