"""Variants of a model as parallel worlds of MuJoCo-Warp."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from concent_warp.checks import check_at_least, check_device
from concent_warp.errors import EngineError
from concent_warp.scene.quiet_mujoco import quiet_mujoco
from concent_warp.simulate.activation import initial_activations
from concent_warp.simulate.contact_log import sorted_log
from concent_warp.simulate.engine import ContactLog, Contacts, Rollout, Variants
from concent_warp.simulate.inputs import SPHERE_FIELDS, SimulationRun, check_run, compile_model, with_force_models
from concent_warp.simulate.warp_model import batchable, check_drag, is_switch
from concent_warp.simulate.warp_program import Buffers, Demand, Plan, Program, world_bytes

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.scene.payloads import Payload

BITS = mjw.OverflowType
GROWING = BITS.NEFC | BITS.NJMAX_NNZ | BITS.BROADPHASE | BITS.NARROWPHASE | BITS.CCD | BITS.CONTACT_MATCH
"""Overflows that larger buffers mend."""
FATAL = BITS.HFIELD | BITS.NVMAX | BITS.EPA_HORIZON | BITS.TACTILE
"""Overflows of buffers whose size cannot be set."""
LIMITED = BITS.ITERATIONS | BITS.LS_ITERATIONS

LOG_ROW_BYTES = 14 * 4
MAX_PROGRAMS = 2
"""Most programs kept for the next run with the same shapes: each holds the data of all worlds."""
STEP_MEMORY_RATIO = 1.5
"""Memory that MuJoCo-Warp takes in a step, relative to that of its data [-]."""


@dataclass(frozen=True)
class ProgramResult:
    """What came out of the worlds of one program run."""

    records: list[torch.Tensor]
    touched: torch.Tensor | None
    log: tuple[np.ndarray, np.ndarray] | None
    unstable_step: np.ndarray


class WarpEngine:
    """Simulates in MuJoCo-Warp, in single precision. See `concent_warp.simulate.engine.Engine`.

    Graphs and buffers are kept between runs of the same shapes, so that a run with other values costs no set-up.
    """

    def __init__(
        self,
        model: Model,
        *,
        collidable: np.ndarray | None = None,
        device: str | None = None,
        nconmax: int | None = None,
        njmax: int | None = None,
        max_memory: int | None = None,
        max_worlds: int | None = None,
    ) -> None:
        """Compile the model.

        Args:
            model: What to simulate.
            collidable: Spheres that take part in the physics, shape (S,) bool; None for all.
            device: Warp's name of the device; ``cuda:0`` where there is one, else ``cpu``.
            nconmax: Contacts and candidate pairs to make room for, a world, in a pool for all worlds. By default
                measured: the first variant is simulated in C MuJoCo before the first run. It grows when it overflows.
            njmax: Constraint rows to make room for in each world; the same holds.
            max_memory: Memory that the data of all worlds may take [bytes]; by default 40 % of what is free on a GPU,
                2 GiB on a CPU.
            max_worlds: Worlds simulated at a time; by default what fits the memory.

        Raises:
            EngineError: The model holds an effect that needs the other engine, or an argument is out of bounds.
            ConcentError: There is no such device.
        """
        check_at_least(1, EngineError, nconmax=nconmax, njmax=njmax, max_memory=max_memory, max_worlds=max_worlds)
        check_device(device)
        if foreign := sorted({a.effect.name for a in model.effects if "warp" not in a.effect.engines}):
            raise EngineError(f"{', '.join(foreign)} cannot run on MuJoCo-Warp", fix="use MujocoEngine")
        self.model = model
        self.device = str(wp.get_device(device if device is not None else preferred_device()))
        self._collidable = None if collidable is None else np.array(collidable)
        self._compiled, self._sphere_geom = compile_model(model, self._collidable)
        self._max_memory = _free_memory(self.device) if max_memory is None else int(max_memory)
        self._max_worlds = max_worlds
        self._nconmax, self._njmax = nconmax, njmax
        self._buffers: Buffers | None = None
        self._world_bytes: dict[Buffers, int] = {}
        self._programs: OrderedDict[Plan, Program] = OrderedDict()
        self._carrying: dict[tuple[Payload, ...], WarpEngine] = {}
        self.repeats = 0
        """How often the last run was repeated with larger buffers."""
        self.limited = 0
        """In how many variants of the last run the solver or its line search reached its iteration limit."""

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

    def carrying(self, payloads: tuple[Payload, ...]) -> WarpEngine:
        """Return the engine for demonstrations in which bodies carried payloads, see `Engine.carrying`."""
        if not payloads:
            return self
        if payloads not in self._carrying:
            self._carrying[payloads] = WarpEngine(
                self.model.with_payloads(payloads),
                collidable=self._collidable,
                device=self.device,
                nconmax=self._nconmax,
                njmax=self._njmax,
                max_memory=self._max_memory,
                max_worlds=self._max_worlds,
            )
        return self._carrying[payloads]

    @property
    def buffers(self) -> Buffers | None:
        """Sizes in use, as they have grown so far; None before the first run."""
        return self._buffers

    def run(
        self,
        variants: Variants,
        ctrl: np.ndarray,
        *,
        record: Sequence[int] | np.ndarray | None = None,
        bodies: Sequence[str] | None = None,
        contacts: Contacts = "none",
    ) -> Rollout:
        """Simulate all variants, see `Engine.run`.

        Arrays of the rollout are float32 tensors on the device, its contact log is NumPy. A variant whose position,
        velocity or acceleration is not finite or beyond 1e10 is `diverged`, and its records are NaN from then on.
        """
        run = check_run(self._compiled, len(self._sphere_geom), variants, ctrl, record, bodies, contacts)
        variants = _with_edited_fields(self._compiled, with_force_models(self.model, self._compiled, variants))
        run = replace(run, variants=variants)
        for name in variants.fields:
            if not batchable(name):
                raise EngineError(f"{name} cannot vary between the worlds of MuJoCo-Warp", fix="use MujocoEngine")
        check_drag(self._compiled, variants.fields)
        if self._buffers is None:
            self._buffers = self._first_buffers(run)
        self.repeats = self.limited = 0
        parts: list[ProgramResult] = []
        start = 0
        while start < variants.count:
            size = self._chunk(self._buffers, run)
            part = self._run_part(run, np.arange(start, start + size))
            if part is not None:
                parts.append(part)
                start += size
        return self._join(run, parts)

    def _activations(self, count: int, qpos: Any, ctrl: Any) -> np.ndarray:
        """Return the activations of variants at the start, shape (count, na), from positions and commands."""
        host = [value.detach().cpu().numpy() if hasattr(value, "detach") else value for value in (qpos, ctrl)]
        place = np.tile(self._compiled.qpos0, (count, 1)) if host[0] is None else np.asarray(host[0])
        return initial_activations(self._compiled, place, np.asarray(host[1]))

    def _run_part(self, run: SimulationRun, rows: np.ndarray) -> ProgramResult | None:
        """Simulate the variants `rows`, the last one standing in for those beyond; None if buffers had to grow."""
        assert self._buffers is not None
        count = run.variants.count
        kept = int((rows < count).sum())
        rows = np.minimum(rows, count - 1)
        program = self._program(run, len(rows))
        spheres = {name: _pick(getattr(run.variants, name), rows) for name in program.plan.spheres}
        fields = {name: _pick(value, rows) for name, value in run.variants.fields.items()}
        force_models = [_pick(values, rows) for _, values in run.variants.force_models or ()]
        ctrl = run.ctrl[rows[: program.plan.commands] % len(run.ctrl)]
        qpos, qvel = _pick(run.variants.qpos, rows), _pick(run.variants.qvel, rows)
        act = self._activations(len(rows), qpos, ctrl) if self._compiled.na and run.steps else None
        program.load(spheres, fields, force_models, qpos, qvel, ctrl, run.record, act)
        demand = program.run()
        if (grown := self._grown(self._buffers, demand, program)) is not None:
            self._buffers = grown
            self._programs.clear()
            self.repeats += 1
            return None
        self.limited += int(((demand.overflow[:kept] & int(LIMITED)) != 0).sum())
        log = None
        if run.contacts == "all":
            key, value = program.log(demand)
            inside = key[:, 0] < kept
            log = key[inside] + np.array([rows[0], 0, 0, 0]), value[inside]
        return ProgramResult(
            records=[values[:kept] for values in program.records()],
            touched=program.touched()[:kept] if run.contacts == "touched" else None,
            log=log,
            unstable_step=demand.unstable_step[:kept],
        )

    def _program(self, run: SimulationRun, worlds: int) -> Program:
        """Return a program for a run, a kept one if there is one."""
        assert self._buffers is not None
        fields, force_models = run.variants.fields, run.variants.force_models or ()
        edited = _edited_fields(run.variants)
        plan = Plan(
            worlds=worlds,
            steps=run.steps,
            commands=min(len(run.ctrl), worlds),
            records=len(run.record),
            bodies=tuple(run.body_ids.tolist()),
            contacts=run.contacts,
            spheres=tuple(name for name in SPHERE_FIELDS if getattr(run.variants, name) is not None),
            fields=tuple(
                (name, is_switch(name) and (name in edited or bool((fields[name] != 0).any())))
                for name in sorted(fields)
            ),
            force_models=tuple((force_model, np.shape(values)[1]) for force_model, values in force_models),
        )
        if plan in self._programs:
            self._programs.move_to_end(plan)
            return self._programs[plan]
        while len(self._programs) >= MAX_PROGRAMS:
            self._programs.popitem(last=False)
        typical = {name: largest_by_magnitude(value) + (name in edited) for name, value in fields.items()}
        try:
            program = Program(self._compiled, self._sphere_geom, plan, self._buffers, typical, self.device)
        except RuntimeError as error:
            if "alloc" not in str(error).lower() and "memory" not in str(error).lower():
                raise
            raise EngineError(
                f"{worlds} worlds do not fit the memory of {self.device}", fix=f"set max_worlds below {worlds}"
            ) from error
        self._programs[plan] = program
        return program

    def _first_buffers(self, run: SimulationRun) -> Buffers:
        """Return sizes for the first run: what was given, else twice what the first variant needs in C MuJoCo."""
        contacts, constraints, total = _probe(self._compiled, run)
        return Buffers(
            contacts=_rung(2 * contacts + 8) if self._nconmax is None else self._nconmax,
            constraints=_rung(1.5 * constraints + 16) if self._njmax is None else self._njmax,
            log_rows=int(min(2 * total * run.variants.count + 64, self._max_memory / 8 / LOG_ROW_BYTES)),
        )

    def _grown(self, buffers: Buffers, demand: Demand, program: Program) -> Buffers | None:
        """Return the sizes that a run would have needed, or None if all went well."""
        bits = BITS(int(np.bitwise_or.reduce(demand.overflow)))
        sane = demand.unstable_step > program.plan.steps
        if fatal := BITS(int(np.bitwise_or.reduce(demand.overflow, where=sane))) & FATAL:
            raise EngineError(f"MuJoCo-Warp ran out of fixed buffers ({fatal.name})", fix="use MujocoEngine")
        changes: dict[str, Any] = {}
        capacity = buffers.contacts * program.plan.worlds
        if demand.contacts > capacity or bits & (BITS.BROADPHASE | BITS.NARROWPHASE | BITS.CCD):
            need = 1.25 * demand.contacts / program.plan.worlds
            changes["contacts"] = _rung(max(need, buffers.contacts + 1))
        if demand.constraints > buffers.constraints or bits & BITS.NEFC:
            changes["constraints"] = _rung(max(1.25 * demand.constraints, buffers.constraints + 1))
        if bits & BITS.NJMAX_NNZ:
            changes["nonzeros"] = 2 * program.data.njmax_nnz
        elif "constraints" in changes:
            changes["nonzeros"] = None
        if bits & BITS.CONTACT_MATCH:
            changes["matches"] = 2 * int(program.model.opt.contact_sensor_maxmatch)
        if program.plan.contacts == "all" and demand.logged > buffers.log_rows:
            changes["log_rows"] = int(1.25 * demand.logged)
        return replace(buffers, **changes) if changes else None

    def _chunk(self, buffers: Buffers, run: SimulationRun) -> int:
        """Return how many variants to simulate at a time, in chunks of one size."""
        m, count = self._compiled, run.variants.count
        if buffers not in self._world_bytes:
            self._world_bytes[buffers] = world_bytes(m, buffers)
        recorded = 2 * 4 * len(run.record) * (m.nq + m.nv + m.nsensordata + 7 * len(run.bodies))
        one = int(STEP_MEMORY_RATIO * self._world_bytes[buffers]) + recorded + m.ngeom * m.nbody + 4 * run.steps * m.nu
        logged = buffers.log_rows * LOG_ROW_BYTES if run.contacts == "all" else 0
        room = (self._max_memory - logged) // one
        if room < 1:
            raise EngineError(
                f"one variant needs {buffers.contacts} contacts and {buffers.constraints} constraint rows, and the "
                f"contact log {logged // LOG_ROW_BYTES} rows: too much memory",
                expected=f"at most {self._max_memory} bytes",
                found=one + logged,
                fix="thin out the contact geometry, simulate fewer variants or steps at a time, or raise max_memory",
            )
        most = min(room, count, self._max_worlds or count)
        chunks = -(-count // most)
        return -(-count // chunks)

    def _join(self, run: SimulationRun, parts: Sequence[ProgramResult]) -> Rollout:
        """Put the parts together in the order of the variants."""
        qpos, qvel, sensordata, position, quaternion = (
            parts[0].records[i] if len(parts) == 1 else torch.cat([part.records[i] for part in parts]) for i in range(5)
        )
        touched = [part.touched for part in parts if part.touched is not None]
        unstable = np.concatenate([part.unstable_step for part in parts])
        return Rollout(
            step=run.record,
            time=run.record * self.timestep,
            bodies=run.bodies,
            qpos=qpos,
            qvel=qvel,
            sensordata=sensordata,
            body_position=position,
            body_quaternion=quaternion,
            touched=torch.cat(touched) if touched else None,
            contacts=_join_logs([part.log for part in parts if part.log is not None])
            if run.contacts == "all"
            else None,
            diverged=torch.as_tensor(unstable <= run.steps, device=qpos.device),
        )


def _join_logs(logs: Sequence[tuple[np.ndarray, np.ndarray]]) -> ContactLog:
    """Return the ordered log of keys (variant, step, geoms), shape (C, 4), and values, shape (C, 10)."""
    key = np.concatenate([key for key, _ in logs])
    value = np.concatenate([value for _, value in logs])
    return sorted_log(key[:, 0].astype(int), key[:, 1].astype(int), np.concatenate([key[:, 2:], value], axis=1))


def _probe(compiled: mujoco.MjModel, run: SimulationRun) -> tuple[int, int, int]:
    """Simulate the first variant's commands on the unchanged model in C MuJoCo.

    Returns:
        Most contacts and most constraint rows at a time, and the contacts of all steps together.
    """
    d = mujoco.MjData(compiled)
    for name in ("qpos", "qvel"):
        if (value := _pick(getattr(run.variants, name), np.zeros(1, dtype=int))) is not None:
            getattr(d, name)[:] = value[0].detach().cpu().numpy() if hasattr(value, "detach") else value[0]
    ctrl = run.ctrl[0]
    contacts = constraints = total = 0
    with quiet_mujoco():
        for k in range(max(run.steps, 1)):
            if compiled.nu and run.steps:
                d.ctrl[:] = ctrl[k]
            mujoco.mj_step(compiled, d)
            contacts, constraints = max(contacts, d.ncon), max(constraints, d.nefc)
            total += d.ncon
    return contacts, constraints, total


def _edited_fields(variants: Variants) -> set[str]:
    """Return the names of the model fields that force models edit."""
    return {name for force_model, _ in variants.force_models or () for name in force_model.edits}


def _with_edited_fields(compiled: mujoco.MjModel, variants: Variants) -> Variants:
    """Return the variants with a row a world of each field that force models edit."""
    shared = {name: getattr(compiled, name) for name in _edited_fields(variants) - set(variants.fields)}
    rows = {name: np.tile(value, (variants.count, *[1] * value.ndim)) for name, value in shared.items()}
    return replace(variants, fields={**variants.fields, **rows})


def _rung(size: float) -> int:
    """Return the next of 16, 24, 32, 48, 64, 96, ...: few sizes, since each one is compiled for and cached."""
    step = 16
    while step < size:
        if 3 * step // 2 >= size:
            return 3 * step // 2
        step *= 2
    return step


def largest_by_magnitude(value: Any) -> np.ndarray:
    """Return the entry largest in magnitude over the variants of a field (N, ...), shape (...)."""
    array = np.asarray(value.detach().cpu().numpy() if hasattr(value, "detach") else value, dtype=float)
    return np.take_along_axis(array, np.abs(array).argmax(axis=0)[None], axis=0)[0]


def _pick(value: Any, rows: np.ndarray) -> Any:
    """Return the rows of an array or a tensor, or None of None."""
    if value is None:
        return None
    return value[torch.as_tensor(rows, device=value.device)] if isinstance(value, torch.Tensor) else value[rows]


def preferred_device() -> str:
    """Return the first CUDA device, or the CPU."""
    return "cuda:0" if wp.is_cuda_available() else "cpu"


def _free_memory(device: str) -> int:
    """Return what the data of worlds may take by default [bytes]."""
    return int(0.4 * wp.get_device(device).free_memory) if device.startswith("cuda") else 2 * 2**30
