"""Variants of a model in C MuJoCo, one after the other in each of a few threads."""

from __future__ import annotations

import copy
import queue
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.errors import EngineError
from concent_warp.simulate.contact_log import collect
from concent_warp.simulate.engine import Contacts, Rollout, Variants
from concent_warp.simulate.fields import apply_fields
from concent_warp.simulate.inputs import (
    SPHERE_FIELDS,
    SimulationRun,
    check_run,
    compile_model,
    host_variants,
    with_force_models,
)
from concent_warp.simulate.processes import FEWEST, WORTH, in_processes
from concent_warp.simulate.threads import simulations_at_a_time

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel
    from concent_warp.model import Model

WARNING = mujoco.mjtWarning
DIVERGED = [int(w) for w in (WARNING.mjWARN_BADQPOS, WARNING.mjWARN_BADQVEL, WARNING.mjWARN_BADQACC)]
OVERFLOW = [int(w) for w in (WARNING.mjWARN_CONTACTFULL, WARNING.mjWARN_CNSTRFULL)]


class MujocoEngine:
    """Simulates in C MuJoCo, in double precision. See `concent_warp.simulate.engine.Engine`."""

    def __init__(
        self,
        model: Model,
        *,
        collidable: np.ndarray | None = None,
        threads: int | None = None,
        memory: int | None = None,
        max_memory: int = 2**30,
    ) -> None:
        """Compile the model.

        Args:
            model: What to simulate.
            collidable: Spheres that take part in the physics, shape (S,) bool; None for all.
            threads: Variants simulated at a time; by default one for each CPU this process may use, see
                `concent_warp.simulate.threads`.
            memory: Arena of one simulation [bytes], which holds contacts and constraints; by default what MuJoCo takes.
                It grows when it overflows.
            max_memory: How far the arena may grow [bytes].
        """
        self.model = model
        self.threads = simulations_at_a_time() if threads is None else max(int(threads), 1)
        self.max_memory = int(max_memory)
        self._collidable = None if collidable is None else np.array(collidable)
        self._memory = memory
        self._compiled, self._sphere_geom = compile_model(model, self._collidable)
        self._workshops: queue.SimpleQueue[Workshop] = queue.SimpleQueue()
        if memory is not None:
            self._resize(memory)
        self.repeats = 0
        """How often variants of the last run were repeated with a larger arena."""

    @property
    def timestep(self) -> float:
        """The model's time step [s]."""
        return float(self._compiled.opt.timestep)

    @property
    def compiled(self) -> mujoco.MjModel:
        """The compiled model of the variant that changes nothing; geom ids refer to it. Not to be edited."""
        return self._compiled

    @property
    def sphere_geom(self) -> np.ndarray:
        """Geom id of each sphere of the model's geometry, shape (S,) int; -1 for those that are not collidable."""
        return self._sphere_geom

    @property
    def memory(self) -> int:
        """Arena of one simulation [bytes], as it has grown so far."""
        return int(self._compiled.narena)

    def run(
        self,
        variants: Variants,
        ctrl: np.ndarray,
        *,
        record: Sequence[int] | np.ndarray | None = None,
        bodies: Sequence[str] | None = None,
        contacts: Contacts = "none",
    ) -> Rollout:
        """Simulate all variants, see `Engine.run`; arrays of the rollout are float64.

        A variant that MuJoCo finds unstable is `diverged`, and its records are NaN from then on.
        """
        run = check_run(self._compiled, len(self._sphere_geom), variants, ctrl, record, bodies, contacts)
        variants = with_force_models(self.model, self._compiled, host_variants(variants))
        run = SimulationRun(**{**vars(run), "variants": variants})
        results: list[VariantResult | None] = [None] * variants.count
        pending = list(range(variants.count))
        self.repeats = 0
        with quiet_warnings():
            while pending:
                for n, result in zip(pending, self._simulated(run, pending), strict=True):
                    results[n] = result
                if pending := [n for n in pending if results[n] is None]:
                    self._grow(len(pending))
        done = [result for result in results if result is not None]
        return Rollout(
            step=run.record,
            time=run.record * self.timestep,
            bodies=run.bodies,
            qpos=np.stack([r.qpos for r in done]),
            qvel=np.stack([r.qvel for r in done]),
            sensordata=np.stack([r.sensordata for r in done]),
            body_position=np.stack([r.body_position for r in done]),
            body_quaternion=np.stack([r.body_quaternion for r in done]),
            touched=np.stack([r.touched for r in done]) if contacts == "touched" else None,
            contacts=collect([r.contacts for r in done]) if contacts == "all" else None,
            diverged=np.array([r.diverged for r in done]),
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs."""
        return {name: value for name, value in vars(self).items() if name != "_workshops"}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Go on in another process."""
        vars(self).update(state)
        self._workshops = queue.SimpleQueue()

    def _simulated(self, run: SimulationRun, rows: Sequence[int]) -> list[VariantResult | None]:
        """Simulate some variants, as many at a time as may be."""
        count = min(self.threads, len(rows))
        if run.variants.force_models and count >= FEWEST and len(rows) * run.steps >= WORTH:
            return in_processes(self._in_turn, run, rows, self.threads)
        # Force models are Python code, which runs in one thread at a time: more threads would only slow it down.
        with ThreadPoolExecutor(1 if run.variants.force_models else count) as pool:
            return list(pool.map(lambda n: self._simulate(run, n), rows))

    def _in_turn(self, run: SimulationRun) -> list[VariantResult | None]:
        """Simulate all variants one after the other, in another process."""
        with quiet_warnings():
            return [self._simulate(run, n) for n in range(run.variants.count)]

    def _simulate(self, run: SimulationRun, n: int) -> VariantResult | None:
        """Simulate variant n; None if its contacts or constraints did not fit the arena."""
        m = self._variant_model(run.variants, n)
        force_models = [(force_model, values[n]) for force_model, values in run.variants.force_models or ()]
        if any(force_model.edits for force_model, _ in force_models):
            m = copy.copy(m)
        d = mujoco.MjData(m)
        if run.variants.qpos is not None:
            d.qpos[:] = run.variants.qpos[n]
        if run.variants.qvel is not None:
            d.qvel[:] = run.variants.qvel[n]
        result = VariantResult.empty(m, run)
        step = _simulate if not _unwatched(m, run) else _in_one_loop if force_models else _in_one_call
        try:
            result.diverged = not step(m, d, run, run.ctrl[n % len(run.ctrl)], result, force_models)
        except mujoco.FatalError as error:
            if "stack" in str(error) or "arena" in str(error):
                return None
            raise EngineError("MuJoCo stopped", where=f"variant {n}", found=error) from None
        return None if d.warning.number[OVERFLOW].any() else result

    def _variant_model(self, variants: Variants, n: int) -> mujoco.MjModel:
        """Return the model of variant n, compiled anew where geometry varies: the mid-phase trees depend on it."""
        if len(self._sphere_geom) and any(getattr(variants, name) is not None for name in SPHERE_FIELDS):
            try:
                workshop = self._workshops.get_nowait()
            except queue.Empty:
                workshop = Workshop(self.model, self._collidable, self._memory)
            m = workshop.compile(variants, n)
            self._workshops.put(workshop)
            m = copy.copy(m) if variants.fields else m
        elif variants.fields:
            m = copy.copy(self._compiled)
        else:
            return self._compiled
        if variants.fields:
            apply_fields(m, {name: value[n] for name, value in variants.fields.items()}, mujoco.MjData(m))
        return m

    def _grow(self, count: int) -> None:
        """Double the arena."""
        size = 2 * self.memory
        if size > self.max_memory:
            raise EngineError(
                f"contacts and constraints of {count} variants overflow an arena of {self.memory} bytes",
                expected=f"at most {self.max_memory} bytes",
                fix=f"thin out the contact geometry, or allow at least max_memory={size}",
            )
        self.repeats += 1
        self._resize(size)

    def _resize(self, size: int) -> None:
        """Compile anew with an arena of `size` bytes."""
        self._memory = size
        self._workshops = queue.SimpleQueue()
        spec = self.model.spec(self._collidable)
        spec.memory = size
        self._compiled = self.model.finish(spec.compile())


class Workshop:
    """A spec whose spheres are set and compiled for one variant after the other; for one thread at a time."""

    def __init__(self, model: Model, collidable: np.ndarray | None, memory: int | None) -> None:
        self._model = model
        self._spec = model.spec(collidable)
        if memory is not None:
            self._spec.memory = memory
        geometry = model.geometry
        assert geometry is not None
        self._nominal = {
            "sphere_position": geometry.position,
            "sphere_radius": geometry.radius,
            "sphere_friction": geometry.friction,
        }
        self._last: tuple[tuple[np.ndarray, ...], mujoco.MjModel] | None = None
        geoms = {geom.name: geom for geom in self._spec.geoms}
        self._geoms = [(i, geoms[name]) for i, name in enumerate(geometry.names()) if name in geoms]

    def compile(self, variants: Variants, n: int) -> mujoco.MjModel:
        """Return the compiled model of variant n, spheres only; what does not vary goes back to the model's own.

        Compiling takes about as long as a short simulation, and a search runs each geometry on many segments in turn:
        variants alike share a model, which is not to be edited.
        """
        values = tuple(
            np.asarray(nominal if (value := getattr(variants, name)) is None else value[n])
            for name, nominal in self._nominal.items()
        )
        if self._last is not None and all(map(np.array_equal, values, self._last[0])):
            return self._last[1]
        position, radius, friction = values
        for i, geom in self._geoms:
            geom.pos = position[i]
            geom.size[0] = radius[i]
            geom.friction[0] = friction[i]
        compiled = self._model.finish(self._spec.compile())
        self._last = tuple(value.copy() for value in values), compiled
        return compiled


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


def _simulate(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    run: SimulationRun,
    ctrl: np.ndarray,
    result: VariantResult,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
) -> bool:
    """Step through the commands `ctrl`, shape (K, nu), filling `result`; returns whether the state stayed sane.

    `mj_step` computes sensors, poses and contacts from the state before the step and leaves them in `d`, so they are
    read after the step that they belong to. Only Runge-Kutta overwrites them, with those of its last stage.
    """
    row_of = {int(step): row for row, step in enumerate(run.record)}
    watch = run.contacts != "none"
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
        if row is None and not watch:
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


def _unwatched(m: mujoco.MjModel, run: SimulationRun) -> bool:
    """Return whether states and sensors are all that is asked for, so that MuJoCo may step on its own."""
    plain = m.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4 and not m.na and not m.nmocap
    return run.contacts == "none" and not len(run.body_ids) and run.steps > 0 and plain


def _in_one_call(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    run: SimulationRun,
    ctrl: np.ndarray,
    result: VariantResult,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
) -> bool:
    """Do what `_simulate` does where nothing is watched, in MuJoCo's own loop, which lets other threads run."""
    from mujoco import rollout

    del force_models
    number = d.warning.number
    start = np.concatenate([[0.0], d.qpos, d.qvel])
    # Sensors are those of the state before each step, so one more step gives those of the last state.
    held = np.concatenate([ctrl, ctrl[-1:]]) if m.nu else None
    state, sensordata = rollout.rollout(m, d, start[None], None if held is None else held[None], nstep=run.steps + 1)
    if number[OVERFLOW].any():
        return True
    sane = run.steps + 1
    if number[DIVERGED].any():
        clock = state[0, :, 0]
        stuck = np.flatnonzero(np.diff(clock, prepend=0.0) <= 0)
        sane = int(stuck[0]) if len(stuck) else run.steps
    rows = run.record < sane
    steps = run.record[rows]
    before = np.concatenate([start[None], state[0]])[steps]
    result.qpos[rows] = before[:, 1 : 1 + m.nq]
    result.qvel[rows] = before[:, 1 + m.nq :]
    result.sensordata[rows] = sensordata[0, steps]
    return sane > run.steps


def _in_one_loop(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    run: SimulationRun,
    ctrl: np.ndarray,
    result: VariantResult,
    force_models: Sequence[tuple[ForceModel, np.ndarray]],
) -> bool:
    """Simulate as `_simulate` where only force models interrupt the steps; errors are left to `_simulate`."""
    number = d.warning.number
    start = d.qpos.copy(), d.qvel.copy(), d.userdata.copy()
    base = [
        (getattr(m, name), getattr(m, name).copy()) for force_model, _ in force_models for name in force_model.edits
    ]
    acting = [force_model.bound(m, d, values) for force_model, values in force_models]
    row_of = np.full(run.steps + 1, -1)
    row_of[run.record] = np.arange(len(run.record))
    rows, held = row_of.tolist(), d.ctrl
    qpos, qvel, sensordata, applied, pushed = d.qpos, d.qvel, d.sensordata, d.qfrc_applied, d.xfrc_applied
    for k, row in enumerate(rows):
        if m.nu and k < run.steps:
            held[:] = ctrl[k]
        applied.fill(0.0)
        pushed.fill(0.0)
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
    if number[OVERFLOW].any() or number[DIVERGED].any():
        mujoco.mj_resetData(m, d)
        for field, value in base:
            field[:] = value
        d.qpos[:], d.qvel[:], d.userdata[:] = start
        return _simulate(m, d, run, ctrl, result, force_models)
    return True


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

    Every step when contacts are watched; else around each record and where the commands change.
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


@contextmanager
def quiet_warnings() -> Iterator[None]:
    """Keep MuJoCo from printing warnings and writing a log file: the engine reads the counters instead."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
