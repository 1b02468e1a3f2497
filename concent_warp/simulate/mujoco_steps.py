"""The steps of one variant in C MuJoCo, and what is recorded of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.simulate.compiled_steps import step_compiled

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel
    from concent_warp.simulate.inputs import SimulationRun

WARNING = mujoco.mjtWarning
DIVERGED = [int(w) for w in (WARNING.mjWARN_BADQPOS, WARNING.mjWARN_BADQVEL, WARNING.mjWARN_BADQACC)]
OVERFLOW = [int(w) for w in (WARNING.mjWARN_CONTACTFULL, WARNING.mjWARN_CNSTRFULL)]


@dataclass
class VariantResult:
    """Records of one variant; NaN where it diverged."""

    qpos: np.ndarray
    """Shape (R, nq)."""
    qvel: np.ndarray
    """Shape (R, nv)."""
    sensordata: np.ndarray
    """Shape (R, nsensordata)."""
    body_position: np.ndarray
    """[m], shape (R, B, 3)."""
    body_quaternion: np.ndarray
    """wxyz, shape (R, B, 4)."""
    touched: np.ndarray
    """Shape (ngeom, nbody) bool."""
    contacts: list[tuple[int, np.ndarray]]
    """Step, and rows of geom ids (2), position (3), normal (3), distance and force (3), shape (C, 12)."""
    diverged: bool = False

    @staticmethod
    def empty(m: mujoco.MjModel, run: SimulationRun) -> VariantResult:
        """Return a result without records."""
        r, b = len(run.record), len(run.body_ids)
        return VariantResult(
            qpos=np.full((r, m.nq), np.nan),
            qvel=np.full((r, m.nv), np.nan),
            sensordata=np.full((r, m.nsensordata), np.nan),
            body_position=np.full((r, b, 3), np.nan),
            body_quaternion=np.full((r, b, 4), np.nan),
            touched=np.zeros((m.ngeom, m.nbody), dtype=bool),
            contacts=[],
        )

    def put(self, row: int, d: mujoco.MjData, body_ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Record a state, and what `d` holds computed from it."""
        self.qpos[row], self.qvel[row], self.sensordata[row] = qpos, qvel, d.sensordata
        self.body_position[row], self.body_quaternion[row] = d.xpos[body_ids], d.xquat[body_ids]


@contextmanager
def restored(m: mujoco.MjModel, names: Sequence[str]) -> Iterator[None]:
    """Give fields of a model the values back that they had."""
    before = {name: getattr(m, name).copy() for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            getattr(m, name)[:] = value


def simulate_steps(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    run: SimulationRun,
    ctrl: np.ndarray,
    result: VariantResult,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
) -> bool:
    """Simulate the commands `ctrl`, shape (K, nu), into `result`; returns whether the state stayed valid.

    `mj_step` computes sensors, poses and contacts from the state before the step and leaves them in `d`, so they are
    read after the step that they belong to. Only Runge-Kutta overwrites poses and contacts, with those of its last
    stage; sensors it leaves.
    """
    row_of = {int(step): row for row, step in enumerate(run.record)}
    record_contacts = run.contacts != "none"
    overwritten = m.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    number = d.warning.number
    base = {name: getattr(m, name).copy() for force_model, _ in force_models for name in force_model.edits}
    k = 0
    for stop in range(1, run.steps + 1) if force_models else _stops(ctrl, run):
        if m.nu:
            d.ctrl[:] = ctrl[k]
        if force_models:
            _apply_force_models(m, d, force_models, base)
        row = row_of.get(k)
        if row is None and not record_contacts:
            mujoco.mj_step(m, d, nstep=stop - k)
        else:
            qpos, qvel = d.qpos.copy(), d.qvel.copy()
            if overwritten:
                mujoco.mj_forward(m, d)
                _read(m, d, k, row, run, result, qpos, qvel)
            mujoco.mj_step(m, d)
            if not overwritten and not number[DIVERGED].any():
                _read(m, d, k, row, run, result, qpos, qvel)
        if number[OVERFLOW].any():
            return True
        if number[DIVERGED].any():
            return False
        k = stop
    mujoco.mj_checkPos(m, d)
    mujoco.mj_checkVel(m, d)
    if force_models:
        _apply_force_models(m, d, force_models, base)
    if run.steps in row_of and not number[DIVERGED].any():
        mujoco.mj_forward(m, d)
        result.put(row_of[run.steps], d, run.body_ids, d.qpos, d.qvel)
    return not number[DIVERGED].any()


def records_states_only(m: mujoco.MjModel, run: SimulationRun) -> bool:
    """Return whether only states and sensors are recorded, so that MuJoCo can step without interruption."""
    state = mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
    plain = state == 1 + m.nq + m.nv and not m.nmocap
    return run.contacts == "none" and not len(run.body_ids) and run.steps > 0 and plain


def simulate_in_one_call(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    run: SimulationRun,
    ctrl: np.ndarray,
    result: VariantResult,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
) -> bool:
    """Simulate as `simulate_steps` by one call of `mujoco.rollout`, which other threads run beside; no contacts."""
    from mujoco import rollout

    del force_models
    number = d.warning.number
    start = np.concatenate([[0.0], d.qpos, d.qvel])
    # Sensors are those of the state before each step, so one more step gives those of the last state.
    commanded = np.concatenate([ctrl, ctrl[-1:]]) if m.nu else None
    state, sensordata = rollout.rollout(
        m, d, start[None], None if commanded is None else commanded[None], nstep=run.steps + 1
    )
    if number[OVERFLOW].any():
        return True
    valid = run.steps + 1
    if number[DIVERGED].any():
        clock = state[0, :, 0]
        stuck = np.flatnonzero(np.diff(clock, prepend=0.0) <= 0)
        valid = int(stuck[0]) if len(stuck) else run.steps
    rows = run.record < valid
    steps = run.record[rows]
    before = np.concatenate([start[None], state[0]])[steps]
    result.qpos[rows] = before[:, 1 : 1 + m.nq]
    result.qvel[rows] = before[:, 1 + m.nq :]
    result.sensordata[rows] = sensordata[0, steps]
    return valid > run.steps


def simulate_with_force_models(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    run: SimulationRun,
    ctrl: np.ndarray,
    result: VariantResult,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
    *,
    compiled: bool = False,
) -> bool:
    """Simulate as `simulate_steps` where only force models interrupt the steps; on a warning, fall back to that.

    The steps may be `compiled` where `concent_warp.simulate.compiled_steps` allows it.
    """
    number = d.warning.number
    start = d.qpos.copy(), d.qvel.copy(), d.userdata.copy()
    base = [
        (getattr(m, name), getattr(m, name).copy()) for force_model, _ in force_models for name in force_model.edits
    ]
    row_of = np.full(run.steps + 1, -1)
    row_of[run.record] = np.arange(len(run.record))
    if compiled:
        step_compiled(m, d, ctrl, row_of, force_models, result.qpos, result.qvel, result.sensordata)
    else:
        _step_in_python(m, d, ctrl, row_of, force_models, base, result)
    if number[OVERFLOW].any() or number[DIVERGED].any():
        mujoco.mj_resetData(m, d)
        for records in (result.qpos, result.qvel, result.sensordata):
            records.fill(np.nan)
        for field, value in base:
            field[:] = value
        d.qpos[:], d.qvel[:], d.userdata[:] = start
        return simulate_steps(m, d, run, ctrl, result, force_models)
    return True


def _step_in_python(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    ctrl: np.ndarray,
    row_of: np.ndarray,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
    base: Sequence[tuple[np.ndarray, np.ndarray]],
    result: VariantResult,
) -> None:
    """Do what `step_compiled` does; `base` holds fields that force models edit, and their values."""
    acting = [force_model.bound(m, d, values) for force_model, values in force_models]
    rows, command = row_of.tolist(), d.ctrl
    qpos, qvel, sensordata, joint_force, wrench = d.qpos, d.qvel, d.sensordata, d.qfrc_applied, d.xfrc_applied
    for k, row in enumerate(rows):
        if m.nu and k < len(ctrl):
            command[:] = ctrl[k]
        joint_force.fill(0.0)
        wrench.fill(0.0)
        for field, value in base:
            field[:] = value
        for act in acting:
            act()
        if row < 0:
            mujoco.mj_step(m, d)
            continue
        result.qpos[row], result.qvel[row] = qpos, qvel
        mujoco.mj_step(m, d)
        result.sensordata[row] = sensordata


def _apply_force_models(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
    base: Mapping[str, np.ndarray],
) -> None:
    """Let force models act on the coming step, from fields as they are in `base` and no applied force."""
    d.qfrc_applied[:] = 0
    d.xfrc_applied[:] = 0
    for name, value in base.items():
        getattr(m, name)[:] = value
    for force_model, values in force_models:
        force_model.apply(m, d, values)


def _stops(ctrl: np.ndarray, run: SimulationRun) -> Iterator[int]:
    """Return the steps at which the simulation pauses, increasing, the last one K.

    Every step when contacts are recorded; else around each record and where the commands change.
    """
    if run.contacts != "none":
        return iter(range(1, run.steps + 1))
    changes = np.flatnonzero((ctrl[1:] != ctrl[:-1]).any(axis=1)) + 1
    every = np.concatenate([changes, run.record, run.record + 1, [run.steps]])
    return iter(np.unique(every[(every > 0) & (every <= run.steps)]).tolist())


def _read(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    step: int,
    row: int | None,
    run: SimulationRun,
    result: VariantResult,
    qpos: np.ndarray,
    qvel: np.ndarray,
) -> None:
    """Record what `d` computed from the state of `step`."""
    if row is not None:
        result.put(row, d, run.body_ids, qpos, qvel)
    if run.contacts == "none" or not d.ncon:
        return
    active = np.flatnonzero(d.contact.efc_address >= 0)
    geom = d.contact.geom[active]
    if run.contacts == "touched":
        body = m.geom_bodyid[geom]
        result.touched[geom[:, 0], body[:, 1]] = True
        result.touched[geom[:, 1], body[:, 0]] = True
    elif len(active):
        result.contacts.append((step, _contact_rows(m, d, active)))


def _contact_rows(m: mujoco.MjModel, d: mujoco.MjData, active: np.ndarray) -> np.ndarray:
    """Return geom ids, position [m], normal, distance [m] and force [N] of the `active` contacts, shape (C, 12)."""
    contact = d.contact
    frame = contact.frame[active].reshape(-1, 3, 3)
    wrench = np.zeros((len(active), 6))
    for i, c in enumerate(active):
        mujoco.mj_contactForce(m, d, int(c), wrench[i])
    force = np.einsum("cij,ci->cj", frame, wrench[:, :3])
    geom = contact.geom[active]
    sign = np.where(geom[:, 0] > geom[:, 1], -1.0, 1.0)[:, None]
    return np.concatenate(
        [np.sort(geom, axis=1), contact.pos[active], sign * frame[:, 0], contact.dist[active, None], sign * force],
        axis=1,
    )
