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
        geom, address = contact.geom, contact.efc_address
        forward = self.moving[geom[:, 1]] & self.still[geom[:, 0]]
        backward = self.moving[geom[:, 0]] & self.still[geom[:, 1]]
        wrench = np.zeros(6)
        for i in np.flatnonzero((forward | backward) & (address >= 0)):
            body = m.geom_bodyid[geom[i, 1] if forward[i] else geom[i, 0]]
            mujoco.mj_contactForce(m, d, int(i), wrench)
            arm = contact.pos[i] - d.xipos[body]
            spin, linear = d.cvel[body, :3], d.cvel[body, 3:]
            velocity = linear + np.cross(spin, contact.pos[i] - d.subtree_com[m.body_rootid[body]])
            normal = contact.frame[i, :3]
            velocity = velocity - normal * (normal @ velocity)
            speed = np.sqrt(velocity @ velocity + SMOOTH**2)
            force = -extra * contact.friction[i, 0] * wrench[0] * velocity[1] / speed
            d.xfrc_applied[body, 1] += force
            d.xfrc_applied[body, 3:] += np.cross(arm, (0.0, force, 0.0))

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `Law.launch`."""
        import warp as wp

        from concent_warp.kernels import laws

        if self._device is None:
            self._device = (wp.array(self.moving, dtype=bool), wp.array(self.still, dtype=bool))
        laws.anisotropic(m, d, *self._device, values, SMOOTH)
