"""States of actuators at the start of a simulation: those in which the first command would have left them.

A recording says nothing of them, and begins anywhere in a motion: the filter of a servo that starts empty would pull
the joint to zero first (MuJoCo documentation, chapter Computation, actuator activation dynamics).
"""

from __future__ import annotations

import mujoco
import numpy as np

DYNAMICS, BIAS = mujoco.mjtDyn, mujoco.mjtBias
FOLLOWING = (int(DYNAMICS.mjDYN_FILTER), int(DYNAMICS.mjDYN_FILTEREXACT), int(DYNAMICS.mjDYN_MUSCLE))
"""Dynamics whose activation tends to the command."""


def initial_activation(m: mujoco.MjModel, d: mujoco.MjData, ctrl: np.ndarray) -> np.ndarray:
    """Return the activations at the start, shape (na,).

    Filters and muscles are where the first command would hold them. An integrator that is the setpoint of a servo is
    where the servo does not pull, which is its position if its gain is its stiffness; others are zero.

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
            act[last] = -(offset + slope * d.actuator_length[i]) / gain if servo else 0.0
        if m.actuator_actlimited[i]:
            act[last] = np.clip(act[last], *m.actuator_actrange[i])
    return act


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
