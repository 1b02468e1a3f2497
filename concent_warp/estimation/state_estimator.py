"""States of a scene over a demonstration: joint and body positions, velocities and accelerations with standard errors.

Each joint and each free body is estimated from its own readings at their own times, by local polynomials or by
smoothing splines. What was not measured is taken from a simulation of the demonstration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.estimation.ball_signals import BALL, ball_signals
from concent_warp.estimation.body_signals import polynomial_bodies, spline_bodies
from concent_warp.estimation.joint_signals import (
    HINGE_OR_SLIDE,
    MIN_SINGULAR,
    CoupledJoints,
    coupled_joints,
    joint_signals,
)
from concent_warp.estimation.local_polynomial import LocalPolynomialCfg
from concent_warp.estimation.signals import (
    MeasuredBall,
    MeasuredBody,
    MeasuredJoint,
    OrientationSignal,
    Signal,
    worst_scatter,
)
from concent_warp.estimation.smoothing_spline import SmoothingSplineCfg
from concent_warp.simulate.replay import acting_commands, initial_state, interpolate, replay, step_count

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration
    from concent_warp.scene.scene import Scene
    from concent_warp.simulate.engine import Engine


@dataclass(frozen=True)
class StateEstimatorCfg:
    """Settings of the estimation of states."""

    method: Literal["local_polynomial", "smoothing_spline"] = "local_polynomial"
    """How readings are smoothed. "local_polynomial": polynomials through the few readings around a time, which do not
    average over an impact and need no noise level; "smoothing_spline": one spline for the whole demonstration, which
    has the smaller errors where motion is smooth."""
    polynomial: LocalPolynomialCfg = field(default_factory=LocalPolynomialCfg)
    """Settings of local polynomials."""
    spline: SmoothingSplineCfg = field(default_factory=SmoothingSplineCfg)
    """Settings of smoothing splines."""
    min_singular: float = MIN_SINGULAR
    """Local polynomials: smallest singular value of the equations (sensors of joints and tendons, equalities) that
    determine the joints; below it some joint counts as not measured."""
    support_share: float = 0.3
    """A body is in contact while its acceleration differs from free fall by more than this share of gravity, or of
    9.81 m/s^2 in a scene without gravity."""


@dataclass(frozen=True)
class MeasuredStates:
    """Estimated states of a scene at T times."""

    qpos: np.ndarray
    """Shape (T, nq) [m, rad]; quaternions wxyz of unit length."""
    qvel: np.ndarray
    """Shape (T, nv) [m/s, rad/s]; angular velocities of free bodies in the body frame."""
    qacc: np.ndarray
    """Shape (T, nv) [m/s^2, rad/s^2]; 0 where nothing was measured."""


@dataclass(frozen=True)
class StateErrors:
    """Standard errors of estimated states at T times; NaN where nothing was measured."""

    position: np.ndarray
    """Shape (T, nv) [m, rad]; of orientations the components of the rotation vector."""
    velocity: np.ndarray
    """Shape (T, nv) [m/s, rad/s]."""
    acceleration: np.ndarray
    """Shape (T, nv) [m/s^2, rad/s^2]."""


@dataclass(frozen=True)
class SimulatedTrajectory:
    """A model's simulation of a demonstration, R states."""

    time: np.ndarray
    """Shape (R,) [s]."""
    qpos: np.ndarray
    """Shape (R, nq)."""
    qvel: np.ndarray
    """Shape (R, nv)."""
    ctrl: np.ndarray
    """Commands as they act on each time step from time 0 on, shape (S, nu)."""


@dataclass(frozen=True)
class StateEstimator:
    """States of a scene over one demonstration, estimated from its measurements."""

    cfg: StateEstimatorCfg
    compiled: mujoco.MjModel
    joints: tuple[MeasuredJoint, ...]
    """Hinges and slides whose position a sensor measured."""
    bodies: tuple[MeasuredBody, ...]
    """Free bodies whose position was measured."""
    coupled: CoupledJoints | None
    """All hinges and slides, with those that follow from tendons and equalities; None for smoothing splines."""
    simulated: SimulatedTrajectory | None
    """States of what was not measured; None if everything was."""
    balls: tuple[MeasuredBall, ...] = ()
    """Ball joints whose rotation was measured."""

    @staticmethod
    def of(
        model: Model,
        demonstration: Demonstration,
        cfg: StateEstimatorCfg | None = None,
        *,
        engine: Engine | None = None,
    ) -> StateEstimator:
        """Return the estimator of a demonstration.

        Local polynomials require that all joints and free bodies were measured; joints without a sensor may follow from
        the tendons and equalities that couple them to others. Smoothing splines take the sensors' own joints and
        bodies, and everything else from a simulation of the demonstration.

        Args:
            model: The model that is to follow the demonstration.
            demonstration: What was commanded and measured.
            cfg: Settings.
            engine: Simulates what was not measured; needed for smoothing splines only.

        Raises:
            RecordingError: A joint or a free body was not measured and is not simulated, or nothing was measured.
        """
        cfg = cfg or StateEstimatorCfg()
        if cfg.method == "local_polynomial":
            return _by_polynomials(model.scene, demonstration, cfg)
        return _by_splines(model, demonstration, cfg, engine)

    @property
    def ctrl(self) -> np.ndarray:
        """Commands as they act on each time step from time 0 on, shape (S, nu); of an estimator with an engine."""
        assert self.simulated is not None
        return self.simulated.ctrl

    @property
    def span(self) -> tuple[float, float]:
        """First and last time between which everything that was measured at all has readings [s]."""
        spans = [(float(s.time[0]), float(s.time[-1])) for s in self.signals()]
        return max(a for a, _ in spans), min(b for _, b in spans)

    @property
    def period(self) -> float:
        """Time between readings of the slowest signal [s]."""
        return max(float(np.median(np.diff(s.time))) for s in self.signals())

    def signals(self) -> list[Signal | OrientationSignal]:
        """Return the signals that states are estimated from."""
        found: list[Signal | OrientationSignal] = []
        found += [j.position for j in self.joints] if self.coupled is None else list(self.coupled.readings)
        found += [b.position for b in self.bodies]
        return found + [signal for _, _, signal in self._turning()]

    def _turning(self) -> list[tuple[int, int, OrientationSignal]]:
        """Return what turns about all axes, each by the addresses of its quaternion and of its angular velocity."""
        bodies = [(b.qpos + 3, b.dof + 3, b.orientation) for b in self.bodies if b.orientation is not None]
        return [*bodies, *((b.qpos, b.dof, b.orientation) for b in self.balls)]

    def states(self, time: np.ndarray) -> MeasuredStates:
        """Return the estimated states at `time` (T,) [s]."""
        time = np.asarray(time, dtype=float)
        qpos, qvel = self._unmeasured(time)
        qacc = np.zeros_like(qvel)
        if self.coupled is not None:
            found = self.coupled.estimate(time)
            dof = self.coupled.dof
            qpos[:, self.coupled.qpos], qvel[:, dof], qacc[:, dof] = found.value, found.rate, found.second
        else:
            for joint in self.joints:
                found = joint.position.estimate(time)
                qpos[:, joint.qpos], qvel[:, joint.dof] = found.value[:, 0], found.rate[:, 0]
                qacc[:, joint.dof] = found.second[:, 0]
        for body in self.bodies:
            found = body.position.estimate(time)
            linear = slice(body.dof, body.dof + 3)
            qpos[:, body.qpos : body.qpos + 3] = found.value
            qvel[:, linear], qacc[:, linear] = found.rate, found.second
        for place, dof, orientation in self._turning():
            turn, angular = orientation.estimate(time), slice(dof, dof + 3)
            qpos[:, place : place + 4] = turn.quaternion
            qvel[:, angular], qacc[:, angular] = turn.velocity, turn.acceleration
        return MeasuredStates(qpos, qvel, qacc)

    def standard_errors(self, time: np.ndarray) -> StateErrors:
        """Return the standard errors of the estimated states at `time` (T,) [s]."""
        time = np.asarray(time, dtype=float)
        variance = np.full((len(time), self.compiled.nv, 3), np.nan)
        if self.coupled is not None:
            variance[:, self.coupled.dof] = np.einsum("tjii->tji", self.coupled.covariance(time))
        else:
            for joint in self.joints:
                variance[:, joint.dof] = np.einsum("tii->ti", joint.position.covariance(time))
        positions = [(body.dof, body.position) for body in self.bodies]
        for start, signal in (*positions, *((dof, signal) for _, dof, signal in self._turning())):
            variance[:, start : start + 3] = np.einsum("tii->ti", signal.covariance(time))[:, None]
        return StateErrors(*np.sqrt(variance).transpose(2, 0, 1))

    def sample_states(
        self, time: np.ndarray, count: int, rng: np.random.Generator | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the estimated states at `time` (T,), followed by `count` samples of them under their errors.

        Args:
            time: Shape (T,) [s].
            count: Number of samples.
            rng: Source of random numbers; None for no samples.

        Returns:
            qpos, shape (1 + count, T, nq), and qvel, shape (1 + count, T, nv).
        """
        qpos, qvel = self._unmeasured(time)
        qpos, qvel = np.tile(qpos, (1 + count, 1, 1)), np.tile(qvel, (1 + count, 1, 1))
        if self.coupled is not None:
            qpos[:, :, self.coupled.qpos], qvel[:, :, self.coupled.dof] = self.coupled.sample(time, count, rng)
        else:
            for joint in self.joints:
                position, velocity = joint.position.sample(time, count, rng)
                qpos[:, :, joint.qpos], qvel[:, :, joint.dof] = position[..., 0], velocity[..., 0]
        for body in self.bodies:
            position, velocity = body.position.sample(time, count, rng)
            qpos[:, :, body.qpos : body.qpos + 3], qvel[:, :, body.dof : body.dof + 3] = position, velocity
        for place, dof, orientation in self._turning():
            qpos[:, :, place : place + 4], qvel[:, :, dof : dof + 3] = orientation.sample(time, count, rng)
        return qpos, qvel

    def scatter(self, time: np.ndarray) -> np.ndarray:
        """Return the scatter of the readings around each of `time` (T,), over the median, of the worst signal, (T,).

        Large where an impact lies among the readings.
        """
        return worst_scatter([s.scatter(time) for s in self.signals()])

    def scatter_of_both_sides(self, time: np.ndarray) -> np.ndarray:
        """Return the same of readings on both sides of each time, shape (T,).

        An estimate is taken from those on one side, which may be smooth up to an impact.
        """
        return worst_scatter([s.scatter_of_both_sides(time) for s in self.signals()])

    def in_contact(self, bodies: Sequence[str], time: np.ndarray) -> np.ndarray:
        """Return when any of some free bodies was in contact, by its measured acceleration, shape (T,) bool.

        Args:
            bodies: Names of free bodies.
            time: Shape (T,) [s].
        """
        gravity = self.compiled.opt.gravity
        size = float(np.linalg.norm(gravity)) or 9.81
        result = np.zeros(len(time), dtype=bool)
        for body in self.bodies:
            if body.name in bodies:
                acceleration, error = body.position.acceleration(time)
                departure = np.linalg.norm(acceleration - gravity, axis=1)
                result |= departure > max(self.cfg.support_share * size, 3 * float(np.median(error)))
        return result

    def _unmeasured(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the simulated states at `time` (T,), else the model's reference state: qpos (T, nq), qvel (T, nv)."""
        m = self.compiled
        if self.simulated is None:
            return np.tile(m.qpos0, (len(time), 1)), np.zeros((len(time), m.nv))
        qpos = interpolate(self.simulated.time, self.simulated.qpos, time)
        for j in range(m.njnt):
            if int(m.jnt_type[j]) not in HINGE_OR_SLIDE:
                start = m.jnt_qposadr[j] + (3 if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE else 0)
                qpos[:, start : start + 4] /= np.linalg.norm(qpos[:, start : start + 4], axis=1, keepdims=True)
        return qpos, interpolate(self.simulated.time, self.simulated.qvel, time)


def _by_polynomials(scene: Scene, demonstration: Demonstration, cfg: StateEstimatorCfg) -> StateEstimator:
    """Return an estimator by local polynomials.

    Raises:
        RecordingError: A joint or a free body was not measured.
    """
    m = scene.model
    balls = ball_signals(m, demonstration, cfg.polynomial)
    if len(balls) < np.count_nonzero(m.jnt_type == BALL):
        raise RecordingError(
            "a window cannot start where a ball joint was not measured",
            where=demonstration.name,
            expected="sensors of its rotation (ballquat), or of the orientation of the body on it (framequat)",
            found=[b.name for b in balls],
            fix="record them, or fit whole demonstrations",
        )
    bodies = polynomial_bodies(scene, demonstration, cfg.polynomial, initial_state(m, demonstration)[0])
    joints = joint_signals(m, demonstration, cfg.polynomial)
    coupled = coupled_joints(m, demonstration, cfg.polynomial, joints, cfg.min_singular)
    return StateEstimator(cfg, m, joints, bodies, coupled, None, balls)


def _by_splines(
    model: Model, demonstration: Demonstration, cfg: StateEstimatorCfg, engine: Engine | None
) -> StateEstimator:
    """Return an estimator by smoothing splines.

    Raises:
        RecordingError: No joint position and no position of a free body was measured, or too few samples.
    """
    m = model.compile() if engine is None else engine.compiled
    joints, bodies = joint_signals(m, demonstration, cfg.spline), spline_bodies(m, demonstration, cfg.spline)
    balls = ball_signals(m, demonstration, cfg.spline)
    if not (joints or bodies or balls):
        raise RecordingError(
            "no measured motion",
            where=demonstration.name,
            expected=f"{cfg.spline.min_readings} readings of a joint (jointpos, ballquat) or of a free body's framepos",
            found=sorted(demonstration.measured),
        )
    covered = len(joints) + 3 * len(balls) + sum(3 + 3 * (b.orientation is not None) for b in bodies)
    simulated = None
    if engine is not None:
        simulated = _simulated(model, demonstration, engine, complete=covered == m.nv)
    elif covered < m.nv:
        raise RecordingError(
            "some joints or free bodies were not measured",
            where=demonstration.name,
            expected="positions of all of them, or an engine that simulates the others",
            found=[one.name for one in (*joints, *bodies, *balls)],
        )
    return StateEstimator(cfg, m, joints, bodies, None, simulated, balls)


def _simulated(model: Model, demonstration: Demonstration, engine: Engine, *, complete: bool) -> SimulatedTrajectory:
    """Return the simulation of a demonstration; only its initial state if the measurements are `complete`."""
    m = engine.compiled
    qpos, qvel = initial_state(m, demonstration)
    time = np.array([0.0, max(demonstration.duration, engine.timestep)])
    base = time, np.stack([qpos, qpos]), np.stack([qvel, qvel])
    ctrl = acting_commands(model, m, demonstration, step_count(demonstration, engine.timestep) + 1)
    if not complete:
        rollout = replay(model, demonstration, engine, bodies=()).numpy()
        if np.isfinite(rollout.qpos).all() and np.isfinite(rollout.qvel).all():
            base = rollout.time, np.asarray(rollout.qpos[0], float), np.asarray(rollout.qvel[0], float)
    return SimulatedTrajectory(*base, ctrl)
