"""Positions of joints that no sensor measured and that closed loops determine: four-bars, parallel robots, linkages.

A loop that is closed by `connect` or `weld` constraints leaves its unmeasured joints no choice. At each time the
residuals of the constraints are brought to zero by Gauss and Newton's steps of these joints, from the solution at the
time before; so the linkage stays on the branch on which the scene has it.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.checks import Count, Positive


@dataclass(frozen=True)
class ClosedLoopCfg:
    """How the joints of closed loops are solved for."""

    max_steps: Count = 30
    """Most steps at one time [-]."""
    tolerance: Positive = 1e-8
    """Step below which a solution has converged [m or rad]."""
    max_residual: float = 0.01
    """Root mean square of the constraints' residuals above which a loop does not close [m or rad]: far more than noise
    of the measured joints opens it by."""
    max_rate: Positive = 250.0
    """Highest rate at which loops are solved [Hz]: the motion in between is smooth, and a solution takes 0.3 ms."""
    min_singular: Positive = 1e-3
    """Smallest singular value of the constraints' derivatives that determine the joints [-]."""


def close_loops(
    m: mujoco.MjModel, qpos: np.ndarray, dofs: np.ndarray, cfg: ClosedLoopCfg | None = None
) -> np.ndarray | None:
    """Return positions at T times in which the equality constraints on some joints hold, shape (T, nq).

    Args:
        m: The compiled scene.
        qpos: Positions, shape (T, nq), right but for the joints to be found; these start from the first row.
        dofs: Degrees of freedom of the joints to be found, hinges and slides, shape (U,).
        cfg: Settings.

    Returns:
        None where the constraints do not determine the joints, or cannot be met.
    """
    cfg, m = cfg or ClosedLoopCfg(), copy.copy(m)
    off = mujoco.mjtDisableBit
    m.opt.disableflags |= int(off.mjDSBL_CONTACT | off.mjDSBL_LIMIT | off.mjDSBL_FRICTIONLOSS)
    m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    d, found = mujoco.MjData(m), np.array(qpos, dtype=float)
    addresses = m.jnt_qposadr[m.dof_jntid[dofs]]
    for k, row in enumerate(found):
        row[addresses] = found[max(k - 1, 0), addresses]
        for _ in range(cfg.max_steps):
            residual, slope = _constraints(m, d, row, dofs)
            if not len(residual):
                return None
            step = np.linalg.lstsq(slope, -residual, rcond=None)[0]
            row[addresses] += np.clip(step, -0.5, 0.5)
            if np.abs(step).max() < cfg.tolerance:
                break
        residual, slope = _constraints(m, d, row, dofs)
        singular = np.linalg.svd(slope, compute_uv=False)
        determined = len(singular) == len(dofs) and singular[-1] > cfg.min_singular
        if not determined or np.sqrt(np.mean(residual**2)) > cfg.max_residual:
            return None
    return found


def _constraints(
    m: mujoco.MjModel, d: mujoco.MjData, qpos: np.ndarray, dofs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals of the equality constraints on some joints, shape (C,), and their derivatives, (C, U).

    Others, such as those of a mocap body to a hand or of a grasped object, say nothing of these joints.
    """
    d.qpos[:] = qpos
    mujoco.mj_fwdPosition(m, d)
    rows = d.efc_type[: d.nefc] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    jacobian = d.efc_J.reshape(-1, m.nv)[: d.nefc]
    slope = jacobian[rows][:, dofs]
    of = d.efc_id[: d.nefc][rows]
    on_joints = np.isin(of, of[slope.any(axis=1)])
    return d.efc_pos[: d.nefc][rows][on_joints], slope[on_joints]
