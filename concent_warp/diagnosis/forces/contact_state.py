"""What a free body touches in each window, in which phase it is, and which motions its contacts leave free."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.comparison.phases import FREE, GRASPED, IMPACT, REST, SLIDE, STICK, MotionPhaseCfg
from concent_warp.diagnosis.forces.cfg import ContactStateCfg
from concent_warp.diagnosis.forces.window_forces import INSTANT_WEIGHTS, INSTANTS

if TYPE_CHECKING:
    from concent_warp.diagnosis.forces.window_forces import Windows
    from concent_warp.estimation.signals import MeasuredBody
    from concent_warp.estimation.state_estimator import StateEstimator

PUSHED, BETWEEN = "pushed", "between"
"""Further phases: the robot presses on it from one side; it starts or stops moving."""


@dataclass(frozen=True)
class Touch:
    """Contact of a body with another in one window."""

    point: np.ndarray
    """Force-weighted mean of the contact points [m], body frame, shape (3,)."""
    normal: np.ndarray
    """Mean direction in which the other pushes the body, body frame, shape (3,)."""
    share: float
    """Share of the steps with contact."""


@dataclass(frozen=True)
class BodyWindows:
    """One free body in the windows of a demonstration, K of them."""

    phase: np.ndarray
    """Names of phases as `concent_warp.comparison.phases` has them, shape (K,)."""
    touches: tuple[Mapping[str, Touch], ...]
    """By the name of the other body."""
    free: np.ndarray
    """Projector onto the motions (world frame, about the body's origin: velocity, angular velocity times `size`) that
    lasting contacts leave free, shape (K, 6, 6)."""
    size: float
    """Radius that makes angles comparable with lengths [m]."""
    sliding: np.ndarray
    """Velocity at the contact, without what is along its normal [m/s], world frame, shape (K, 3); 0 without contact."""
    heading: np.ndarray
    """Direction of sliding, averaged over the window as forces are, shape (K, 3); shorter where it comes to rest."""
    velocity: np.ndarray
    """Of the body's origin [m/s], world frame, shape (K, 3)."""
    spin: np.ndarray
    """Angular velocity [rad/s], world frame, shape (K, 3)."""
    rotation: np.ndarray
    """Body to world, shape (K, 3, 3)."""


def body_windows(motion: StateEstimator, windows: Windows, body: MeasuredBody, cfg: ContactStateCfg) -> BodyWindows:
    """Return the contacts of a body in the model's simulation of each window, its phase and its free motions."""
    m = motion.compiled
    count, steps = windows.path.shape[0], windows.path.shape[1] - 1
    rotation = Rotation.from_quat(windows.qpos[:, body.qpos + 3 : body.qpos + 7], scalar_first=True)
    velocity = windows.qvel[:, body.dof : body.dof + 3]
    spin = rotation.apply(windows.qvel[:, body.dof + 3 : body.dof + 6])
    speed_std = np.sqrt(body.position.covariance(windows.time)[:, 1, 1])
    size = _body_size(m, body.body)
    log, owner = windows.contacts, m.geom_bodyid[windows.contacts.geom]
    first, second = np.asarray(owner[:, 0] == body.body), np.asarray(owner[:, 1] == body.body)
    phase = np.full(count, FREE, dtype=object)
    touches: list[dict[str, Touch]] = [{} for _ in range(count)]
    free = np.tile(np.eye(6), (count, 1, 1))
    sliding, heading = np.zeros((count, 3)), np.zeros((count, 3))
    instants = windows.start[:, None] + windows.length * INSTANTS
    passing = motion.states(instants.ravel()).qvel.reshape(count, len(INSTANTS), -1)
    for k in range(count):
        rows = np.flatnonzero((log.variant == k) & (first ^ second))
        if not len(rows):
            continue
        pose = windows.path[k, log.step[rows], body.qpos : body.qpos + 7]
        turn = Rotation.from_quat(pose[:, 3:], scalar_first=True).inv()
        sign = np.where(second[rows], 1.0, -1.0)[:, None]
        point = turn.apply(log.position[rows] - pose[:, :3])
        normal = turn.apply(sign * log.normal[rows])
        force = np.linalg.norm(log.force[rows], axis=1) + 1e-9
        other = np.where(second[rows], owner[rows, 0], owner[rows, 1])
        for b in np.unique(other):
            mine = other == b
            mean = np.average(normal[mine], axis=0, weights=force[mine])
            touches[k][m.body(int(b)).name or f"body{b}"] = Touch(
                np.average(point[mine], axis=0, weights=force[mine]),
                mean / max(float(np.linalg.norm(mean)), 1e-9),
                len(np.unique(log.step[rows][mine])) / steps,
            )
        share = _lasting_share(np.unique(log.step[rows]), steps, round(cfg.max_interruption / m.opt.timestep))
        matrix = rotation[k].as_matrix()
        movers = {int(b) for b in np.unique(other) if _moved_by_joints(m, int(b))}
        fixed = (
            ~np.isin(other, list(movers)) if len(movers) < len(np.unique(other)) else np.ones(len(other), dtype=bool)
        )
        centre = matrix @ np.average(point[fixed], axis=0, weights=force[fixed])
        up = matrix @ np.average(normal[fixed], axis=0, weights=force[fixed])
        up /= max(float(np.linalg.norm(up)), 1e-9)
        slip = velocity[k] + np.cross(spin[k], centre)
        sliding[k] = slip - up * (up @ slip)
        along = passing[k, :, body.dof : body.dof + 3] + np.cross(
            passing[k, :, body.dof + 3 : body.dof + 6] @ matrix.T, centre
        )
        along -= np.outer(along @ up, up)
        blur = cfg.direction_standard_errors * float(speed_std[k])
        heading[k] = share * INSTANT_WEIGHTS @ (along / np.hypot(np.linalg.norm(along, axis=1), blur)[:, None])
        if share < cfg.lasting_share:
            phase[k] = IMPACT
        elif movers:
            phase[k] = GRASPED if len(movers) > 1 else PUSHED
        else:
            limit = max(MotionPhaseCfg.slide_speed, cfg.motion_standard_errors * float(speed_std[k]))
            speeds = windows.edge_qvel[:, k, body.dof : body.dof + 6]
            ends = [_speed_at(velocity[k], spin[k], centre, up, size)]
            ends += [_speed_at(v[:3], matrix @ v[3:], centre, up, size) for v in speeds]
            travel, slips = ends[0]
            if slips < cfg.rolling_ratio * travel and travel > limit:
                phase[k] = STICK
            else:
                # A window in which it stops or starts shows neither sliding nor rest.
                slides = [s > limit for _, s in ends]
                phase[k] = SLIDE if all(slides) else BETWEEN if any(slides) else REST
        if share >= cfg.lasting_share:
            push = np.concatenate([normal, np.cross(point, normal) / size], axis=1)
            both = np.kron(np.eye(2), matrix)
            free[k] = both @ _free_motions(push, len(np.unique(log.step[rows])), cfg.min_constraint) @ both.T
    return BodyWindows(phase, tuple(touches), free, size, sliding, heading, velocity, spin, rotation.as_matrix())


def _speed_at(
    velocity: np.ndarray, spin: np.ndarray, point: np.ndarray, up: np.ndarray, size: float
) -> tuple[float, float]:
    """Return the speed of a body, and its slip at a point including the spin about the normal [m/s].

    Args:
        velocity: Of its origin [m/s], shape (3,).
        spin: [rad/s], world frame, shape (3,).
        point: From the origin [m], world frame, shape (3,).
        up: Normal, shape (3,).
        size: Radius for turning about the normal [m].
    """
    slip = velocity + np.cross(spin, point)
    slip = slip - up * (up @ slip)
    return float(np.linalg.norm(velocity)), float(np.hypot(np.linalg.norm(slip), abs(float(spin @ up)) * size))


def _lasting_share(touched: np.ndarray, steps: int, longest_gap: int) -> float:
    """Return the share of `steps` with contact, interruptions of up to `longest_gap` steps included.

    Args:
        touched: Steps with contact, increasing.
        steps: Steps of the window.
        longest_gap: Longest interruption that is included [steps].
    """
    edges = np.concatenate([[-1], touched, [steps]])
    gaps = np.diff(edges) - 1
    return 1 - float(gaps[gaps > longest_gap].sum()) / steps


def _free_motions(push: np.ndarray, steps: int, min_constraint: float) -> np.ndarray:
    """Return the projector (6, 6) onto motions that contacts leave free.

    Args:
        push: Direction of each contact's push in the space of motions, shape (C, 6).
        steps: Number of steps that the contacts are of.
        min_constraint: Mean squared normal component of a unit motion from which on it is constrained.
    """
    value, axes = np.linalg.eigh(push.T @ push / steps)
    loose = axes[:, value < min_constraint]
    return loose @ loose.T


def _moved_by_joints(m: mujoco.MjModel, body: int) -> bool:
    """Return whether a body is moved by joints, as a robot's links are, rather than being free or fixed."""
    root = body
    while m.body_parentid[root] != 0:
        root = int(m.body_parentid[root])
    if m.body_weldid[body] == 0:
        return False
    joint = m.body_jntadr[root]
    return not (joint >= 0 and m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE)


def _body_size(m: mujoco.MjModel, body: int) -> float:
    """Return half the mean extent of a body's geoms [m]."""
    low, high = extent(m, body)
    return max(float(np.mean(high - low)) / 2, 1e-3)


def extent(m: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box about a body's geoms [m], body frame, (3,) each."""
    start, count = int(m.body_geomadr[body]), int(m.body_geomnum[body])
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for g in range(start, start + count):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, m.geom_quat[g])
        matrix = matrix.reshape(3, 3)
        centre = m.geom_pos[g] + matrix @ m.geom_aabb[g, :3]
        reach = np.abs(matrix) @ m.geom_aabb[g, 3:]
        low, high = np.minimum(low, centre - reach), np.maximum(high, centre + reach)
    return (low, high) if count > 0 else (np.zeros(3), np.zeros(3))
