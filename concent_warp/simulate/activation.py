"""States of actuators at the start of a simulation: those in which the first command would have left them.

A recording says nothing of them, and begins anywhere in a motion: the filter of a servo that starts empty would pull
the joint to zero first (MuJoCo documentation, chapter Computation, actuator activation dynamics).
"""

from __future__ import annotations

import mujoco
import numpy as np

DYNAMICS, BIAS = mujoco.mjtDyn, mujoco.mjtBias
JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
FOLLOWING = (int(DYNAMICS.mjDYN_FILTER), int(DYNAMICS.mjDYN_FILTEREXACT), int(DYNAMICS.mjDYN_MUSCLE))
"""Dynamics whose activation tends to the command."""


def initial_activation(m: mujoco.MjModel, d: mujoco.MjData, ctrl: np.ndarray) -> np.ndarray:
    """Return the activations at the start, shape (na,).

    Filters and muscles are where the first command would hold them. An integrator that is the setpoint of a servo is
    where this holds its joint at rest against weight and springs, if it alone drives the joint, else where it does not
    pull; others are zero.

    Args:
        m: The compiled model.
        d: Its data with the initial positions; the kinematics are computed.
        ctrl: The first command, shape (nu,).
    """
    act = np.zeros(m.na)
    if not m.na:
        return act
    clipped = not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    mujoco.mj_tendon(m, d)
    mujoco.mj_transmission(m, d)
    holding = _holding_forces(m, d)
    for i in np.flatnonzero(m.actuator_actadr >= 0):
        last = int(m.actuator_actadr[i] + m.actuator_actnum[i]) - 1
        kind = int(m.actuator_dyntype[i])
        if kind in FOLLOWING:
            command = float(ctrl[i])
            limited = clipped and m.actuator_ctrllimited[i]
            act[last] = np.clip(command, *m.actuator_ctrlrange[i]) if limited else command
            if kind == int(DYNAMICS.mjDYN_MUSCLE):
                act[last] = np.clip(act[last], 0.0, 1.0)
        elif kind == int(DYNAMICS.mjDYN_INTEGRATOR):
            gain, (offset, slope) = m.actuator_gainprm[i, 0], m.actuator_biasprm[i, :2]
            servo = m.actuator_biastype[i] == BIAS.mjBIAS_AFFINE and slope != 0 and gain != 0
            act[last] = (holding[i] - offset - slope * d.actuator_length[i]) / gain if servo else 0.0
        if m.actuator_actlimited[i]:
            act[last] = np.clip(act[last], *m.actuator_actrange[i])
    return act


def _holding_forces(m: mujoco.MjModel, d: mujoco.MjData) -> np.ndarray:
    """Return the force by which each actuator holds its joint at rest, shape (nu,); 0 if others drive the joint, too.

    Args:
        m: The compiled model.
        d: Its data with the initial positions, whose kinematics and transmissions are computed.
    """
    found, load, velocity = np.zeros(m.nu), np.zeros(m.nv), d.qvel.copy()
    integrators = np.flatnonzero(m.actuator_dyntype == int(DYNAMICS.mjDYN_INTEGRATOR))
    if not len(integrators):
        return found
    d.qvel[:] = 0
    mujoco.mj_comVel(m, d)
    mujoco.mj_passive(m, d)
    mujoco.mj_rne(m, d, 0, load)
    load -= d.qfrc_passive
    d.qvel[:] = velocity
    driven = np.where(np.isin(m.actuator_trntype, JOINTS), m.actuator_trnid[:, 0], -1)
    for i in integrators:
        joint, gear = int(driven[i]), m.actuator_gear[i, 0]
        if joint < 0 or int(m.jnt_type[joint]) not in SINGLE or (driven == joint).sum() > 1 or gear == 0:
            continue
        force = load[m.jnt_dofadr[joint]] / gear
        found[i] = np.clip(force, *m.actuator_forcerange[i]) if m.actuator_forcelimited[i] else force
    return found


def initial_activations(m: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray) -> np.ndarray:
    """Return the activations of N variants at the start, shape (N, na).

    Args:
        m: The compiled model.
        qpos: Initial positions, shape (N, nq).
        ctrl: Commands, shape (n, K, nu), of which variant i follows those of row i % n.
    """
    d, found = mujoco.MjData(m), np.zeros((len(qpos), m.na))
    for k, position in enumerate(qpos):
        d.qpos[:] = position
        found[k] = initial_activation(m, d, ctrl[k % len(ctrl), 0])
    return found
