"""Commands with which position servos hold an arm at rest."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.effects.select import servo_gain

NEGLIGIBLE = 1e-6
"""Leads [rad or m] below which a servo is taken to hold its joint where it is commanded."""


def holding_leads(m: mujoco.MjModel, d: mujoco.MjData, actuators: np.ndarray, qpos: np.ndarray) -> np.ndarray:
    """Return by how much commands differ from joints where servos hold an arm at rest, without contacts.

    That is the torque of gravity, less what compensation and springs bear, over the servo's stiffness.

    Args:
        m: The model.
        d: Its data, overwritten.
        actuators: J position actuators, each of a joint of its own, shape (J,) int.
        qpos: Positions, shape (K, nq).

    Returns:
        Command less joint position [rad or m], shape (K, J); 0 where it is negligible.
    """
    leads, weight = np.zeros((len(qpos), len(actuators))), np.zeros(m.nv)
    gain = np.array([servo_gain(m, int(i)) for i in actuators])
    joints = m.actuator_trnid[actuators, 0].astype(int)
    dof = m.jnt_dofadr[joints]
    by_actuator = m.jnt_actgravcomp[joints] > 0
    d.qvel[:] = 0
    for row, q in zip(leads, qpos, strict=True):
        d.qpos[:] = q
        # What mj_forward computes of positions and forces at rest, without its search for contacts.
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_tendon(m, d)
        mujoco.mj_comVel(m, d)
        mujoco.mj_passive(m, d)
        mujoco.mj_rne(m, d, 0, weight)
        borne = d.qfrc_passive[dof] + np.where(by_actuator, d.qfrc_gravcomp[dof], 0.0)
        row[:] = (weight[dof] - borne) / gain
    return np.where(np.abs(leads) > NEGLIGIBLE, leads, 0.0)


def holding_commands(m: mujoco.MjModel, d: mujoco.MjData, actuators: np.ndarray, qpos: np.ndarray) -> np.ndarray:
    """Return commands that hold an arm at positions (K, nq), as far as their limits allow, shape (K, J).

    Args:
        m: The model.
        d: Its data, overwritten.
        actuators: J position actuators, each of a joint of its own, shape (J,) int.
        qpos: Positions, shape (K, nq).
    """
    joints = qpos[:, m.jnt_qposadr[m.actuator_trnid[actuators, 0].astype(int)]]
    limited, (low, high) = m.actuator_ctrllimited[actuators].astype(bool), m.actuator_ctrlrange[actuators].T
    limits = np.where(limited, low, -np.inf), np.where(limited, high, np.inf)
    return np.clip(joints + holding_leads(m, d, actuators, qpos), *limits)
