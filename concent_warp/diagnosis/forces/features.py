"""Features of the motion in each window that unexplained forces are tested against, averaged as the forces are."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.comparison.phases import GRASPED
from concent_warp.diagnosis.forces.cfg import FeatureCfg
from concent_warp.diagnosis.forces.contact_state import PUSHED
from concent_warp.diagnosis.forces.window_forces import INSTANT_WEIGHTS, INSTANTS

if TYPE_CHECKING:
    from concent_warp.diagnosis.forces.contact_state import BodyWindows
    from concent_warp.diagnosis.forces.window_forces import Windows
    from concent_warp.estimation.state_estimator import StateEstimator

DIRECTION, SPEED, ACCELERATION = "direction of motion", "velocity", "acceleration"
SLOW, LIMIT = "direction of slow motion", "drive force near its peak"
LOADED, GRAVITY, DRIVE = "direction of motion x load", "weight on it", "drive force"
COMMAND_RATE, POSITION, CONSTANT, CONTACT = "rate of the command", "position", "a constant", "contact"
SLIDING, DRAG = "direction of sliding", "velocity x speed"
AXES = ("x", "y", "z")


def joint_features(windows: Windows, motion: StateEstimator, cfg: FeatureCfg) -> dict[str, dict[str, np.ndarray]]:
    """Return the features of each measured joint, by its name, shape (K, 1) each.

    Units: "velocity" rad/s (m/s), "acceleration" rad/s^2, "direction of motion" -1..1, "position" rad about its mean,
    "weight on it" and "drive force" N m (N), "rate of the command" N m/s (N/s), "contact" 0..1.
    """
    m = copy.copy(motion.compiled)
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    d = mujoco.MjData(m)
    count = len(windows.start)
    time = (windows.start[:, None] + windows.length * INSTANTS).ravel()
    states = motion.states(time)
    qpos, qvel, qacc = states.qpos, states.qvel, states.qacc
    dt = m.opt.timestep
    back = max(round(cfg.rate_step / dt), 1)
    now = np.clip((time / dt).astype(int), 0, len(motion.ctrl) - 1)
    load, drive, before = (np.empty((len(time), m.nv)) for _ in range(3))
    for i in range(len(time)):
        d.qpos[:], d.qvel[:] = qpos[i], qvel[i]
        forces = []
        for row in (max(now[i] - back, 0), now[i]):
            if m.nu:
                d.ctrl[:] = motion.ctrl[row]
            mujoco.mj_forward(m, d)
            forces.append(d.qfrc_actuator.copy())
        before[i], drive[i] = forces
        d.qvel[:] = 0
        mujoco.mj_fwdVelocity(m, d)
        load[i] = d.qfrc_bias - d.qfrc_gravcomp
    touching = _contact_shares(motion.compiled, windows)
    found = {}
    for joint in motion.joints:
        v = qvel[:, joint.dof]
        std = np.sqrt(joint.position.covariance(windows.time)[:, 1, 1]).repeat(len(INSTANTS))
        direction = v / np.sqrt(v**2 + (cfg.direction_standard_errors * std) ** 2)
        force, scale = drive[:, joint.dof], float(np.percentile(np.abs(v), cfg.slow_percentile))
        raw = {
            DIRECTION: direction,
            SLOW: direction * np.exp(-((v / max(scale, 1e-9)) ** 2)),
            LIMIT: np.sign(force) * np.maximum(np.abs(force) - cfg.peak_share * float(np.abs(force).max()), 0),
            SPEED: v,
            ACCELERATION: qacc[:, joint.dof],
            LOADED: direction * np.abs(load[:, joint.dof]),
            GRAVITY: load[:, joint.dof],
            DRIVE: force,
            COMMAND_RATE: (drive[:, joint.dof] - before[:, joint.dof]) / (back * dt),
            POSITION: qpos[:, joint.qpos] - qpos[:, joint.qpos].mean(),
            CONSTANT: np.ones(len(time)),
        }
        mean = {name: value.reshape(count, -1) @ INSTANT_WEIGHTS for name, value in raw.items()}
        mean[CONTACT] = touching[:, joint.dof]
        found[joint.name] = {name: value[:, None] for name, value in mean.items() if _varies(name, value)}
    return found


def _varies(name: str, value: np.ndarray) -> bool:
    """Return whether a feature is a constant one or varies."""
    size = float(np.abs(value).max(initial=0))
    return name == CONSTANT or (size > 0 and float(np.ptp(value)) > 1e-6 * size)


def _contact_shares(m: mujoco.MjModel, windows: Windows) -> np.ndarray:
    """Return the share of each window's steps with a contact beyond a degree of freedom, shape (K, nv)."""
    count, steps = windows.path.shape[0], windows.path.shape[1] - 1
    log = windows.contacts
    shares = np.zeros((count, m.nv))
    moves = np.zeros((m.nbody, m.nv), dtype=bool)
    for b in range(1, m.nbody):
        moves[b] = moves[m.body_parentid[b]]
        start, size = int(m.body_dofadr[b]), int(m.body_dofnum[b])
        moves[b, start : start + size] = True
    bodies = m.geom_bodyid[log.geom]
    for dof in range(m.nv):
        beyond = moves[bodies, dof]
        rows = np.asarray(beyond.any(axis=1))
        pairs = np.unique(np.stack([log.variant[rows], log.step[rows]], axis=1), axis=0)
        shares[:, dof] = np.bincount(pairs[:, 0], minlength=count)[:count] / steps if len(pairs) else 0
    return shares


def body_force_features(state: BodyWindows, acceleration: np.ndarray, name: str) -> dict[str, np.ndarray]:
    """Return the features of the force on a free body, vectors in the world frame, shape (K, 3) each.

    Args:
        state: Its windows.
        acceleration: Of its origin [m/s^2], shape (K, 3).
        name: Of the body.
    """
    speed = np.linalg.norm(state.velocity, axis=1, keepdims=True)
    # Weight and friction grow with the mass as inertia does, so that a wrong one shows where the robot moves the body.
    driven = np.isin(state.phase.astype(str), [PUSHED, GRASPED])
    features = {
        SLIDING: state.heading,
        SPEED: state.velocity,
        DRAG: state.velocity * speed,
        ACCELERATION: np.where(driven[:, None], acceleration, 0),
    }
    for i, axis in enumerate(AXES):
        features[f"world {axis}"] = np.tile(np.eye(3)[i], (len(speed), 1))
    for i, axis in enumerate(AXES):
        features[f"{name} {axis}"] = state.rotation[:, :, i]
    return features


def body_torque_features(state: BodyWindows, name: str) -> dict[str, np.ndarray]:
    """Return the features of the torque on a free body, vectors in the world frame, shape (K, 3) each."""
    rate = np.linalg.norm(state.spin, axis=1, keepdims=True)
    features = {"direction of turning": state.spin / np.hypot(rate, 0.1), "angular velocity": state.spin}
    for i, axis in enumerate(AXES):
        features[f"world {axis}"] = np.tile(np.eye(3)[i], (len(rate), 1))
    for i, axis in enumerate(AXES):
        features[f"{name} {axis}"] = state.rotation[:, :, i]
    return features
