"""Fields of a compiled model that vary, and the constants that MuJoCo derives from them."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

SOURCES_OF_CONSTANTS = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_pos",
    "body_quat",
    "body_gravcomp",
    "jnt_pos",
    "jnt_axis",
    "dof_armature",
    "qpos0",
    "eq_data",
    "tendon_armature",
    "actuator_gear",
    "site_pos",
    "site_quat",
)
"""Fields that constants are derived from."""

CONSTANTS = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "tendon_length0",
    "tendon_invweight0",
    "actuator_acc0",
    "eq_data",
)
"""Those constants, as far as they bear on the simulation."""


def apply_fields(m: mujoco.MjModel, fields: Mapping[str, np.ndarray], scratch: mujoco.MjData) -> None:
    """Set fields of a compiled model, ``opt.<name>`` for options, and derive the constants anew.

    Args:
        m: The model, edited in place.
        fields: Values by name, each of the field's shape. A constant that is given stays as given.
        scratch: Data of the model, overwritten.
    """
    for name, value in fields.items():
        if name.startswith("opt."):
            setattr(m.opt, name[4:], value)
        else:
            getattr(m, name)[:] = value
    if "geom_margin" in fields or "geom_gap" in fields:
        m.body_margin[:] = 0
        np.maximum.at(m.body_margin, m.geom_bodyid, m.geom_margin + m.geom_gap)
    mujoco.mj_setConst(m, scratch)
    for name in set(CONSTANTS) & set(fields) - set(SOURCES_OF_CONSTANTS):
        getattr(m, name)[:] = fields[name]


def derived_constants(compiled: mujoco.MjModel, fields: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Return the constants of each variant.

    `mujoco_warp.set_const` does this on the device, but its body_invweight0 of a body on slide joints alone is a third
    of MuJoCo's.

    Args:
        compiled: The model.
        fields: Values by name, each of shape (N, *field shape).
        count: N.

    Returns:
        Each of `CONSTANTS`, shape (N, *field shape).
    """
    results = {name: np.empty((count, *np.shape(getattr(compiled, name)))) for name in CONSTANTS}
    cores = len(os.sched_getaffinity(0))

    def derive(rows: np.ndarray) -> None:
        m = copy.copy(compiled)
        scratch = mujoco.MjData(m)
        for n in rows:
            apply_fields(m, {name: value[n] for name, value in fields.items()}, scratch)
            for name, result in results.items():
                result[n] = getattr(m, name)

    shares = [rows for rows in np.array_split(np.arange(count), cores) if len(rows)]
    with ThreadPoolExecutor(len(shares)) as pool:
        list(pool.map(derive, shares))
    return results
