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

from concent_warp.fit.effects.observation import ObservationCfg, Window
from concent_warp.fit.effects.prediction import Course, Prediction, Reader, SimulationRequest


@dataclass(frozen=True)
class Impact:
    """An impact of a free body that flew before."""

    begin: int
    """Step of the simulation before it."""
    step: int
    """Step after it."""
    dof: int
    """First degree of freedom of the body."""
    std: np.ndarray
    """Standard deviation of the velocities after it that no law foretells, linear [m/s] and angular [rad/s], (6,)."""
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
    w, values, m = prediction.windows[window], prediction.start, prediction.compiled
    none = np.zeros((w.count, 0))
    if not cfg.impact_error:
        return none
    (course,) = prediction.courses([SimulationRequest(window, values, begun)])
    columns = []
    for impact in impacts(m, course, cfg):
        offsets = np.zeros((7, 2 * m.nv))
        offsets[1:, m.nv + impact.dof : m.nv + impact.dof + 6] = np.diag(impact.std)

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


def impacts(m: mujoco.MjModel, course: Course, cfg: ObservationCfg) -> Iterator[Impact]:
    """Yield the impacts of free bodies in a simulated motion, those in which they change their velocity notably.

    A body flies where its centre of mass accelerates as gravity does.

    Args:
        m: The compiled model.
        course: The motion, at each step.
        cfg: Settings.
    """
    step, gravity = m.opt.timestep, np.array(m.opt.gravity)
    if not np.isfinite(course.qpos).all() or not np.isfinite(course.qvel).all():
        return
    flown, lasting = (max(round(t / step), 1) for t in (cfg.impact_flight, cfg.impact_duration))
    for joint in np.flatnonzero(m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        body, dof = int(m.jnt_bodyid[joint]), int(m.jnt_dofadr[joint])
        if m.body_mass[body] <= 0:  # its mass is in bodies that are fixed to it
            continue
        velocity = _center_velocity(m, body, course.qpos[:, m.jnt_qposadr[joint] + 3 :], course.qvel[:, dof : dof + 6])
        turning = course.qvel[:, dof + 3 : dof + 6]
        pushed = np.linalg.norm(np.diff(velocity, axis=0) / step - gravity, axis=1)
        touching = pushed > cfg.impact_acceleration * max(float(np.linalg.norm(gravity)), 1.0)
        radius = np.sqrt(m.body_inertia[body] / m.body_mass[body])
        for begin in np.flatnonzero(touching[1:] & ~touching[:-1]) + 1:
            if begin < flown or touching[begin - flown : begin].any():
                continue
            flight = np.flatnonzero(~touching[begin : begin + lasting])
            end = begin + (int(flight[0]) if len(flight) else min(lasting, len(touching) - begin))
            change = np.linalg.norm(velocity[end] - velocity[begin] - gravity * step * (end - begin))
            turned = np.linalg.norm(turning[end] - turning[begin])
            if change < cfg.impact_velocity or end >= len(touching):
                continue
            linear, angular = np.full(3, change), np.hypot(turned, change / np.maximum(radius, 1e-9))
            std = cfg.impact_error * np.concatenate([linear, angular])
            yield Impact(int(begin) - 1, int(end), dof, std, bool(len(flight)))


def _center_velocity(m: mujoco.MjModel, body: int, orientation: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return the velocity of a free body's centre of mass, shape (T, 3), world frame.

    Args:
        m: The compiled model.
        body: The body.
        orientation: Quaternions wxyz first, shape (T, 4 or more).
        qvel: Linear velocity of its frame's origin, world frame, and angular velocity, body frame, shape (T, 6).
    """
    arm, found = m.body_ipos[body], qvel[:, :3].copy()
    moved = np.cross(qvel[:, 3:], arm)
    turned = np.empty(3)
    for k, quaternion in enumerate(orientation[:, :4]):
        mujoco.mju_rotVecQuat(turned, moved[k], quaternion)
        found[k] += turned
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
