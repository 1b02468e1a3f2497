"""Friction of a surface with a grain as a force beside MuJoCo's isotropic friction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.effects.law import Law
from concent_warp.effects.select import standing_geoms

if TYPE_CHECKING:
    import mujoco_warp as mjw
    import warp as wp

SMOOTH = 2e-3
"""Sliding speed [m/s] below which the force fades out."""


class AnisotropicForce(Law):
    """-(ratio - 1) mu N v_y / sqrt(|v|^2 + v0^2) along y at each contact of a body with what stands still.

    v is the sliding velocity [m/s], N the normal force [N] of the step before. The parameter is the ratio, shape (1,).
    """

    def __init__(self, m: mujoco.MjModel, bodies: np.ndarray) -> None:
        """Act on the contacts of some bodies, ids of shape (n,)."""
        self.moving = np.zeros(m.ngeom, dtype=bool)
        self.moving[np.isin(m.geom_bodyid, bodies)] = True
        self.still = np.zeros(m.ngeom, dtype=bool)
        self.still[standing_geoms(m)] = True
        self._device: tuple[wp.array[Any], wp.array[Any]] | None = None

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> None:
        """See `Law.apply`."""
        extra = float(values[0]) - 1.0
        if not d.ncon or not extra:
            return
        contact = d.contact
        first, second = contact.geom.T
        backward = self.moving[first] & self.still[second]
        mine = (backward | (self.moving[second] & self.still[first])) & (contact.dim >= 3)
        active = np.flatnonzero(mine & (contact.efc_address >= 0))
        if not len(active):
            return
        body = m.geom_bodyid[np.where(backward, first, second)[active]]
        position, normal = contact.pos[active], contact.frame[active, :3]
        load = normal_forces(m, d, active)
        velocity = d.cvel[body, 3:] + cross(d.cvel[body, :3], position - d.subtree_com[m.body_rootid[body]])
        velocity -= normal * (normal * velocity).sum(axis=1, keepdims=True)
        speed = np.sqrt((velocity * velocity).sum(axis=1) + SMOOTH**2)
        force = -extra * contact.friction[active, 0] * load * velocity[:, 1] / speed
        arm = position - d.xipos[body]
        for b, f, (x, _, z) in zip(body, force, arm, strict=True):
            d.xfrc_applied[b, 1] += f
            d.xfrc_applied[b, 3] -= z * f
            d.xfrc_applied[b, 5] += x * f

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `Law.launch`."""
        import warp as wp

        from concent_warp.kernels import laws

        if self._device is None:
            self._device = (wp.array(self.moving, dtype=bool), wp.array(self.still, dtype=bool))
        laws.anisotropic(m, d, *self._device, values, SMOOTH)


def normal_forces(m: mujoco.MjModel, d: mujoco.MjData, active: np.ndarray) -> np.ndarray:
    """Return the normal force [N] of active contacts, ids of shape (C,), as the last step had it."""
    address, dim = d.contact.efc_address[active], d.contact.dim[active]
    if m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        return d.efc_force[address]
    # A pyramid's edges each carry a share of it: 2 (dim - 1) of them, one where there is no friction.
    running = np.concatenate([[0.0], np.cumsum(d.efc_force)])
    return running[address + np.where(dim > 1, 2 * (dim - 1), 1)] - running[address]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the vector products of rows, shape (C, 3); for few rows faster than NumPy's own."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )
