"""Impacts: what a contact law leaves open of them, as correlated noise of what follows.

No law of rigid contact foretells the velocities after an impact exactly, and simulators with the same parameters
differ in them. In flight, a small error of that kind soon exceeds the noise of a tracker. Nor is the time known for
which bodies touch: simulated contacts are softer than real ones, and a body leaves them later. Neither is a missing
effect, and both are taken as independent from impact to impact: the changes of the residuals by such errors are
deviations as those of the numerical scatter (`NumericalScatter`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.prediction import Course, Prediction, Reader, SimulationRequest


@dataclass(frozen=True)
class FlyingBody:
    """A body that may fly: a free one, or one that slides along axes that stand still."""

    body: int
    dof: int
    """Its first degree of freedom."""
    axes: np.ndarray
    """Directions in which it slides, world frame, shape (k, 3) with k from 1 to 3; of a free body the world's."""
    turns: bool
    """Whether it is free, and turns too."""

    @property
    def count(self) -> int:
        """Degrees of freedom."""
        return len(self.axes) + 3 * self.turns

    def along_axes(self, vector: np.ndarray) -> np.ndarray:
        """Return what of a vector (3,) lies in the space in which it moves."""
        return np.linalg.pinv(self.axes) @ self.axes @ vector


@dataclass(frozen=True)
class Impact:
    """An impact of a body that flew before."""

    begin: int
    """Step of the simulation before it."""
    step: int
    """Step after it."""
    dof: int
    """First degree of freedom of the body."""
    std: np.ndarray
    """Standard deviation of the velocities after it that no law foretells, linear [m/s] and angular [rad/s], (6,) of a
    free body, (k,) of one with k slides."""
    flies: bool
    """Whether the body flies after it, and does not stay in contact."""


def impact_deviations(
    prediction: Prediction, window: int, cfg: ObservationCfg, begun: np.ndarray | None = None
) -> np.ndarray:
    """Return what uncertain outcomes of the impacts in a window change in its residuals, shape (count, K).

    Each column is the change by one standard deviation of one component of the velocity after one impact, of its
    duration, or of what is seen meanwhile.

    Args:
        prediction: What simulates, without scatter.
        window: Index of the window.
        cfg: Settings.
        begun: Error of the window's initial state, shape (2 nv,); none by default.
    """
    w, values, m = prediction.windows[window], prediction.start, prediction.compiled_in(window)
    none = np.zeros((w.count, 0))
    if not cfg.impact_error:
        return none
    (course,) = prediction.courses([SimulationRequest(window, values, begun)])
    columns = []
    for impact in impacts(m, course, cfg):
        count = len(impact.std)
        offsets = np.zeros((1 + count, 2 * m.nv))
        offsets[1:, m.nv + impact.dof : m.nv + impact.dof + count] = np.diag(impact.std)

        def continued(at: int, changes: np.ndarray, impact: Impact = impact) -> list[np.ndarray]:
            """Return the residuals where the motion goes on with the velocity after the impact, from some step on."""
            rest = _rest_of(w, course, at, impact.step, m.opt.timestep)
            after = Prediction(prediction.model(values), (), [rest], cfg=prediction.cfg)
            return [
                prediction.observed(window, _joined(course.reader, rest.start - w.start, later.reader), values)
                for later in after.courses([SimulationRequest(0, after.start, change) for change in changes])
            ]

        plain, *kicked = continued(impact.step, offsets)
        columns += [changed - plain for changed in kicked]
        if impact.flies and cfg.impact_duration_error:
            (without_duration,) = continued(impact.begin, offsets[:1])
            changed = cfg.impact_duration_error * (without_duration - plain)
            columns += [changed, *_meanwhile(w, impact, changed, m.opt.timestep)]
    most = prediction.cfg.max_residual
    kept = [c for c in columns if np.isfinite(c).all() and np.abs(c).max() < most]
    return np.stack(kept, axis=1) if kept else none


def flying_bodies(m: mujoco.MjModel) -> list[FlyingBody]:
    """Return the bodies that may fly: free ones with a mass, and those that slide against what stands still.

    The mass of a free one without may be in bodies that are fixed to it.
    """
    data, found = mujoco.MjData(m), []
    mujoco.mj_kinematics(m, data)
    for body in range(1, m.nbody):
        first, count = int(m.body_jntadr[body]), int(m.body_jntnum[body])
        joints = slice(first, first + count)
        kinds = set(m.jnt_type[joints].tolist())
        if m.body_weldid[m.body_parentid[body]] or m.body_mass[body] <= 0:
            continue
        if kinds == {int(mujoco.mjtJoint.mjJNT_FREE)}:
            found.append(FlyingBody(body, int(m.jnt_dofadr[first]), np.eye(3), turns=True))
        elif kinds == {int(mujoco.mjtJoint.mjJNT_SLIDE)}:
            found.append(FlyingBody(body, int(m.jnt_dofadr[first]), data.xaxis[joints].copy(), turns=False))
    return found


def impacts(m: mujoco.MjModel, course: Course, cfg: ObservationCfg) -> Iterator[Impact]:
    """Yield the impacts of bodies that fly in a simulated motion, those in which they change their velocity notably.

    A body flies where its centre of mass accelerates as gravity does, along the axes of its slides if it has any.

    Args:
        m: The compiled model.
        course: The motion, at each step.
        cfg: Settings.
    """
    step, least = m.opt.timestep, max(float(np.linalg.norm(m.opt.gravity)), 1.0)
    if not np.isfinite(course.qpos).all() or not np.isfinite(course.qvel).all():
        return
    flown, lasting = (max(round(t / step), 1) for t in (cfg.impact_flight, cfg.impact_duration))
    for flying in flying_bodies(m):
        velocity, turning = _velocity(m, flying, course)
        gravity = flying.along_axes(np.array(m.opt.gravity))
        pushed = np.linalg.norm(np.diff(velocity, axis=0) / step - gravity, axis=1)
        touching = pushed > cfg.impact_acceleration * least
        radius = np.sqrt(m.body_inertia[flying.body] / m.body_mass[flying.body])
        for begin in np.flatnonzero(touching[1:] & ~touching[:-1]) + 1:
            if begin < flown or touching[begin - flown : begin].any():
                continue
            flight = np.flatnonzero(~touching[begin : begin + lasting])
            end = begin + (int(flight[0]) if len(flight) else min(lasting, len(touching) - begin))
            change = np.linalg.norm(velocity[end] - velocity[begin] - gravity * step * (end - begin))
            turned = np.linalg.norm(turning[end] - turning[begin])
            if change < cfg.impact_velocity or end >= len(touching):
                continue
            linear, angular = np.full(len(flying.axes), change), np.hypot(turned, change / np.maximum(radius, 1e-9))
            std = cfg.impact_error * np.concatenate([linear, angular])[: flying.count]
            yield Impact(int(begin) - 1, int(end), flying.dof, std, bool(len(flight)))


def _velocity(m: mujoco.MjModel, flying: FlyingBody, course: Course) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity of a body's centre of mass, world frame, and its angular velocity, shape (T, 3) each."""
    qvel = course.qvel[:, flying.dof : flying.dof + flying.count]
    if not flying.turns:
        return qvel @ flying.axes, np.zeros((len(qvel), 3))
    first = int(m.jnt_qposadr[m.body_jntadr[flying.body]])
    return _center_velocity(m, flying.body, course.qpos[:, first + 3 :], qvel), qvel[:, 3:]


def _center_velocity(m: mujoco.MjModel, body: int, orientation: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return the velocity of a free body's centre of mass, shape (T, 3), world frame.

    Args:
        m: The compiled model.
        body: The body.
        orientation: Quaternions wxyz first, shape (T, 4 or more).
        qvel: Linear velocity of its frame's origin, world frame, and angular velocity, body frame, shape (T, 6).
    """
    arm, found = _center_of_mass(m, body), qvel[:, :3].copy()
    moved = np.cross(qvel[:, 3:], arm)
    turned = np.empty(3)
    for k, quaternion in enumerate(orientation[:, :4]):
        mujoco.mju_rotVecQuat(turned, moved[k], quaternion)
        found[k] += turned
    return found


def _center_of_mass(m: mujoco.MjModel, body: int) -> np.ndarray:
    """Return the centre of mass of a free body and of what is fixed to it [m], in the frame of the body, shape (3,)."""
    data, turned = mujoco.MjData(m), np.zeros(4)
    mujoco.mj_kinematics(m, data)
    mujoco.mj_comPos(m, data)
    mujoco.mju_negQuat(turned, data.xquat[body])
    found = np.zeros(3)
    mujoco.mju_rotVecQuat(found, data.subtree_com[body] - data.xpos[body], turned)
    return found


def _rest_of(w: Window, course: Course, at: int, after: int, timestep: float) -> Window:
    """Return the rest of a window from a step on, with the simulated pose there and the velocity of another step."""
    return replace(
        w,
        start=w.start + at * timestep,
        qpos=course.qpos[at].copy(),
        qvel=course.qvel[after].copy(),
        start_shown=False,
        scatter=None,
        defect=None,
    )


def _meanwhile(w: Window, impact: Impact, changed: np.ndarray, timestep: float) -> list[np.ndarray]:
    """Return what is uncertain while bodies touch, where a small error of the time of impact changes much.

    Each reading by itself, by as much as the duration of the impact changes any of them.

    Args:
        w: The window.
        impact: The impact.
        changed: Change of the residuals by an error of its duration, shape (count,).
        timestep: Of the simulation [s].
    """
    during = (w.clock > impact.begin * timestep) & (w.clock <= (impact.step + 1) * timestep)
    rows = np.flatnonzero(during & (changed != 0.0))
    return [np.where(np.arange(w.count) == row, np.abs(changed[rows]).max(), 0.0) for row in rows]


def _joined(first: Reader, time: float, later: Reader) -> Reader:
    """Return what instruments read of a simulation up to a time [s], and of another that begins then."""

    def read(sensor: str, at: np.ndarray) -> np.ndarray:
        value = np.array(first(sensor, at), dtype=float)
        after = at > time
        if after.any():
            value[after] = later(sensor, at[after] - time)
        return value

    return read
