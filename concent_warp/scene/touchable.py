"""Which geoms of a model may touch."""

from __future__ import annotations

import mujoco
import numpy as np


def touchable_pairs(m: mujoco.MjModel) -> np.ndarray:
    """Return which geoms MuJoCo lets touch, by their masks and bodies, shape (ngeom, ngeom) bool, symmetric."""
    kind, affinity = m.geom_contype, m.geom_conaffinity
    masks = (kind[:, None] & affinity[None]) | (affinity[:, None] & kind[None])
    weld = m.body_weldid[m.geom_bodyid]
    found = (masks != 0) & (weld[:, None] != weld[None])
    if not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        above = m.body_weldid[m.body_parentid[weld]]
        carried = (above[:, None] == weld[None]) & (above[:, None] != 0)
        found &= ~(carried | carried.T)
    for signature in m.exclude_signature:
        one, other = m.geom_bodyid == int(signature) >> 16, m.geom_bodyid == int(signature) & 0xFFFF
        found &= ~(one[:, None] & other[None] | other[:, None] & one[None])
    return found
