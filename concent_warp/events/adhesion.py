"""Pull of adhesion actuators, such as suction cups, on the contacts of a replay.

MuJoCo spreads the force of such an actuator evenly over the contacts of its body, along their normals (MuJoCo
documentation, XML reference, actuator/adhesion). The contact forces that it reports do not contain it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from concent_warp.simulate.engine import ContactLog


def adhesion_pull(m: mujoco.MjModel, log: ContactLog, ctrl: np.ndarray) -> np.ndarray:
    """Return the force with which adhesion pulls the two bodies of each contact together [N], shape (C,).

    Args:
        m: The compiled model.
        log: Every contact of every step.
        ctrl: Commands, shape (K, nu).
    """
    pull = np.zeros(len(log.step))
    body = np.asarray(m.geom_bodyid)[log.geom]
    for i in np.flatnonzero(m.actuator_trntype == int(mujoco.mjtTrn.mjTRN_BODY)):
        command = ctrl[:, i]
        if m.actuator_ctrllimited[i]:
            command = np.clip(command, *m.actuator_ctrlrange[i])
        force = m.actuator_gainprm[i, 0] * command
        if m.actuator_forcelimited[i]:
            force = np.clip(force, *m.actuator_forcerange[i])
        own = np.flatnonzero((body == m.actuator_trnid[i, 0]).any(axis=1) & (log.step < len(ctrl)))
        _, group, count = np.unique(
            np.column_stack([log.variant[own], log.step[own]]), axis=0, return_inverse=True, return_counts=True
        )
        pull[own] += force[log.step[own]] / count[group.ravel()]
    return pull
