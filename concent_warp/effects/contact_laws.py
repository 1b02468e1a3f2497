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
        geom, address, dim = contact.geom, contact.efc_address, contact.dim
        forward = self.moving[geom[:, 1]] & self.still[geom[:, 0]]
        backward = self.moving[geom[:, 0]] & self.still[geom[:, 1]]
        rows = np.flatnonzero((forward | backward) & (address >= 0) & (dim >= 3))
        if not len(rows):
            return
        summed = np.concatenate([[0.0], np.cumsum(d.efc_force)])
        pyramid = m.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
        first = address[rows]
        pressed = summed[first + (2 * (dim[rows] - 1) if pyramid else 1)] - summed[first]
        body = m.geom_bodyid[np.where(forward[rows], geom[rows, 1], geom[rows, 0])]
        position, normal = contact.pos[rows], contact.frame[rows, :3]
        spin, linear = d.cvel[body, :3], d.cvel[body, 3:]
        velocity = linear + np.cross(spin, position - d.subtree_com[m.body_rootid[body]])
        velocity -= normal * (normal * velocity).sum(axis=1, keepdims=True)
        speed = np.sqrt((velocity * velocity).sum(axis=1) + SMOOTH**2)
        force = np.zeros_like(velocity)
        force[:, 1] = -extra * contact.friction[rows, 0] * pressed * velocity[:, 1] / speed
        np.add.at(d.xfrc_applied, body, np.hstack([force, np.cross(position - d.xipos[body], force)]))

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `Law.launch`."""
        import warp as wp

        from concent_warp.kernels import laws

        if self._device is None:
            self._device = (wp.array(self.moving, dtype=bool), wp.array(self.still, dtype=bool))
        laws.anisotropic(m, d, *self._device, values, SMOOTH)
