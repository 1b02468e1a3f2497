"""The steps of a simulation with force models as machine code, by Numba.

One table holds the elements that all force models act on; its first column tells which function acts. MuJoCo's step is
called by its address in the library that is loaded already.

An error of MuJoCo ends the process when it is not its Python package that called, and the one error that a step may
raise is a full arena. So these steps are for models whose contacts and constraints cannot fill it, see
`cannot_fill_arena`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.effects.compiled_forces import FORCES, WIDTH, StepState, can_compile, step

GEOM = mujoco.mjtGeom

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

CONTACTS = {GEOM.mjGEOM_SPHERE: 1, GEOM.mjGEOM_CAPSULE: 2, GEOM.mjGEOM_HFIELD: 50, GEOM.mjGEOM_SDF: 50}
"""Most contacts of a geom with another [-]: the smaller number of both, but for fields, which have MuJoCo's limit."""
OTHER_CONTACTS = 8
"""Of any other geom [-]: those of two boxes."""
BYTES_OF_A_ROW = 400
"""Of a contact or a constraint, without its Jacobian."""
SHARE_OF_ARENA = 0.25
"""Share of the arena that constraints may need at most [-]; the rest is for what MuJoCo works with."""


def can_step(force_models: Sequence[tuple[ForceModel, np.ndarray]]) -> bool:
    """Return whether all of some force models, with their parameters, act as machine code."""
    return can_compile() and all(force_model.acts in FORCES for force_model, _ in force_models)


def cannot_fill_arena(m: mujoco.MjModel) -> bool:
    """Return whether all contacts and constraints that a model may ever have at once fit into its arena with ease."""
    return not m.nflex and most_memory(m) < SHARE_OF_ARENA * m.narena


def most_memory(m: mujoco.MjModel) -> int:
    """Return what contacts and constraints take at most [bytes], if all geoms that may touch do; rather more."""
    first, second = np.triu_indices(m.ngeom, 1)
    kind, affinity, body = m.geom_contype, m.geom_conaffinity, m.body_weldid[m.geom_bodyid]
    collides = ((kind[first] & affinity[second]) | (kind[second] & affinity[first])) != 0
    collides &= body[first] != body[second]
    if not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        parent = m.body_weldid[m.body_parentid[body]]
        near = (parent[first] == body[second]) | (parent[second] == body[first])
        collides &= ~near | (body[first] == 0) | (body[second] == 0)
    each = np.full(m.ngeom, OTHER_CONTACTS)
    for shape, count in CONTACTS.items():
        each[m.geom_type == shape] = count
    fewer, more = np.minimum(each[first], each[second]), np.maximum(each[first], each[second])
    contacts = int(np.where(more > OTHER_CONTACTS, more, fewer)[collides].sum()) + int(each.max(initial=0)) * m.npair
    dimensions = max(int(m.geom_condim.max(initial=1)), int(m.pair_dim.max(initial=1)))
    rows = m.nv + 2 * (m.njnt + m.ntendon) + 6 * m.neq + 2 * dimensions * contacts
    need = BYTES_OF_A_ROW * (contacts + rows) + 4 * 8 * rows * m.nv + 2 * 8 * m.nv**2
    if m.opt.solver == mujoco.mjtSolver.mjSOL_PGS or m.opt.noslip_iterations:
        need += 2 * 8 * rows**2
    return need


def step_compiled(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    ctrl: np.ndarray,
    row_of: np.ndarray,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
    qpos: np.ndarray,
    qvel: np.ndarray,
    sensordata: np.ndarray,
) -> None:
    """Simulate from the state in `d`.

    Args:
        m: Model; fields that force models edit are overwritten.
        d: Data.
        ctrl: Commands, shape (K, nu); the last ones hold.
        row_of: Row of the records of each step, -1 for none, shape (K + 1,) int.
        force_models: Those that act, and their parameters; see `can_step`.
        qpos: Filled, shape (R, nq).
        qvel: Filled, shape (R, nv).
        sensordata: Filled, shape (R, nsensordata).
    """
    kinds = [FORCES.index(force_model.acts) for force_model, _ in force_models]
    rows = [
        (kind, row)
        for kind, (force_model, values) in zip(kinds, force_models, strict=True)
        for row in force_model.rows(m, values)
    ]
    whole, real = np.zeros((len(rows), 6), dtype=np.int64), np.zeros((len(rows), WIDTH))
    for n, (kind, (indices, numbers)) in enumerate(rows):
        whole[n, : 1 + len(indices)] = kind, *indices
        real[n, : len(numbers)] = numbers
    ctrl = np.ascontiguousarray(ctrl, dtype=float)
    step(m._address, d._address, StepState.of(m, d), ctrl, row_of, whole, real, qpos, qvel, sensordata)
