"""Parts of a robot that grasp."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np


def actuator_names(m: mujoco.MjModel) -> list[str]:
    """Return the names of a model's actuators."""
    return [m.actuator(a).name for a in range(m.nu)]


def pad_geoms(m: mujoco.MjModel, grippers: Sequence[str]) -> tuple[str, ...]:
    """Return the named geoms that can touch and whose bodies the grippers move or, as suction cups, are."""
    joints: set[int] = set()
    cups: set[int] = set()
    for name in set(grippers) & set(actuator_names(m)):
        a = m.actuator(name).id
        kind, target = int(m.actuator_trntype[a]), int(m.actuator_trnid[a, 0])
        if kind == mujoco.mjtTrn.mjTRN_TENDON:
            wraps = range(m.tendon_adr[target], m.tendon_adr[target] + m.tendon_num[target])
            joints |= {int(m.wrap_objid[w]) for w in wraps if m.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT}
        elif kind == mujoco.mjtTrn.mjTRN_BODY:
            cups.add(target)
        elif kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            joints.add(target)
    for e in np.flatnonzero(m.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        pair = {int(m.eq_obj1id[e]), int(m.eq_obj2id[e])} - {-1}
        joints |= pair if pair & joints else set()
    bodies = cups | {int(m.jnt_bodyid[j]) for j in joints}
    geoms = [g for g in range(m.ngeom) if int(m.geom_bodyid[g]) in bodies and m.geom_contype[g]]
    return tuple(m.geom(g).name for g in geoms if m.geom(g).name)
