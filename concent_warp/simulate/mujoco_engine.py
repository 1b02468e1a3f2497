"""Variants of a model in C MuJoCo, one after the other in each of a few threads."""

from __future__ import annotations

import copy
import queue
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import mujoco
import numpy as np

from concent_warp.checks import check_at_least
from concent_warp.errors import EngineError
from concent_warp.scene.quiet_mujoco import quiet_mujoco
from concent_warp.simulate.activation import initial_activation
from concent_warp.simulate.compiled_steps import can_step, cannot_fill_arena
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
from concent_warp.simulate.mujoco_batch import BatchCfg, distinct, simulate_batch
from concent_warp.simulate.mujoco_steps import (
    OVERFLOW,
    VariantResult,
    records_states_only,
    restored,
    simulate_in_one_call,
    simulate_steps,
    simulate_with_force_models,
)
from concent_warp.simulate.parallel import ProcessPoolCfg, in_processes, simulations_at_a_time
from concent_warp.simulate.time_limit import time_check

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel
    from concent_warp.model import Model
    from concent_warp.scene.payloads import Payload

S = TypeVar("S")
T = TypeVar("T")


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
        processes: ProcessPoolCfg | None = None,
        batches: BatchCfg | None = None,
    ) -> None:
        """Compile the model.

        Args:
            model: What to simulate.
            collidable: Spheres that take part in the physics, shape (S,) bool; None for all.
            threads: Variants simulated at a time; by default one for each CPU this process may use, see
                `concent_warp.simulate.parallel`.
            memory: Arena of one simulation [bytes], which holds contacts and constraints; by default what MuJoCo takes.
                It grows when it overflows.
            max_memory: How far the arena may grow [bytes].
            processes: When simulations whose steps call Python are distributed over processes.
            batches: How the others are distributed over calls of MuJoCo.

        Raises:
            EngineError: An argument is out of bounds.
        """
        check_at_least(1, EngineError, threads=threads, memory=memory, max_memory=max_memory)
        self.model = model
        self.threads = simulations_at_a_time() if threads is None else int(threads)
        self.max_memory = int(max_memory)
        self._collidable = None if collidable is None else np.array(collidable)
        self._memory = memory
        self._processes = processes or ProcessPoolCfg()
        self._batches = batches or BatchCfg()
        self._compiled, self._sphere_geom = compile_model(model, self._collidable)
        self._compilers: queue.SimpleQueue[VariantCompiler] = queue.SimpleQueue()
        self._data: queue.SimpleQueue[mujoco.MjData] = queue.SimpleQueue()
        self._roomy: bool | None = None
        self._carrying: dict[tuple[Payload, ...], MujocoEngine] = {}
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

    def carrying(self, payloads: tuple[Payload, ...]) -> MujocoEngine:
        """Return the engine for demonstrations in which bodies carried payloads, see `Engine.carrying`."""
        if not payloads:
            return self
        if payloads not in self._carrying:
            self._carrying[payloads] = MujocoEngine(
                self.model.with_payloads(payloads),
                collidable=self._collidable,
                threads=self.threads,
                memory=self._memory,
                max_memory=self.max_memory,
                processes=self._processes,
                batches=self._batches,
            )
        return self._carrying[payloads]

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

        Raises:
            TimeUpError: See `concent_warp.simulate.time_limit`.
        """
        run = check_run(self._compiled, len(self._sphere_geom), variants, ctrl, record, bodies, contacts)
        variants = with_force_models(self.model, self._compiled, host_variants(variants))
        run = SimulationRun(**{**vars(run), "variants": variants})
        results: list[VariantResult | None] = [None] * variants.count
        pending = list(range(variants.count))
        self.repeats = 0
        with quiet_mujoco():
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
        return {name: value for name, value in vars(self).items() if name not in ("_compilers", "_data")}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Restore the engine in another process."""
        vars(self).update(state)
        self._compilers, self._data = queue.SimpleQueue(), queue.SimpleQueue()

    def _simulated(self, run: SimulationRun, rows: Sequence[int]) -> list[VariantResult | None]:
        """Simulate some variants, `threads` at a time."""
        count = min(self.threads, len(rows))
        if run.variants.force_models and self._processes.suits(count, len(rows) * run.steps):
            time_check()
            return in_processes(self._all_in_turn, run, rows, self.threads)
        if run.variants.force_models:  # Python code, which runs in one thread at a time: more would only slow it down
            return self._in_turn(run, rows)
        if records_states_only(self._compiled, run) and not self._varies_spheres(run.variants):
            parts = self._batches.parts(rows, run.steps, count)
            return [r for part in _in_threads(lambda part: self._batch(run, part), parts, count) for r in part]
        return self._in_turn(run, rows) if count == 1 else _in_threads(lambda n: self._simulate(run, n), rows, count)

    def _batch(self, run: SimulationRun, rows: Sequence[int]) -> list[VariantResult | None]:
        """Simulate some variants in one call, and those that raise a warning by themselves."""
        fields = run.variants.fields
        like = distinct(rows, [fields[name] for name in fields])
        models = {n: self._variant_model(run.variants, n) for n in dict.fromkeys(like)}
        try:
            d = self._data.get_nowait()
        except queue.Empty:
            d = mujoco.MjData(self._compiled)
        found = simulate_batch([models[n] for n in like], d, run, rows)
        self._data.put(d)
        return [self._simulate(run, n) if result is None else result for n, result in zip(rows, found, strict=True)]

    def _all_in_turn(self, run: SimulationRun) -> list[VariantResult | None]:
        """Simulate all variants one after the other, in another process."""
        with quiet_mujoco():
            return self._in_turn(run, range(run.variants.count))

    def _in_turn(self, run: SimulationRun, rows: Sequence[int]) -> list[VariantResult | None]:
        """Simulate some variants one after the other; those with equal fields share a model and its data.

        A fit varies initial states far more often than fields, and making a model takes as long as some hundred steps.
        """
        check = time_check()
        groups: dict[int, list[int]] = {}
        for n, like in zip(rows, self._alike(run.variants, rows), strict=True):
            groups.setdefault(like, []).append(n)
        found: dict[int, VariantResult | None] = {}
        for like, members in groups.items():
            m = self._variant_model(run.variants, like)
            m = copy.copy(m) if m is self._compiled else m
            d = mujoco.MjData(m)
            for n in members:
                check()
                found[n] = self._simulate(run, n, m, d)
        return [found[n] for n in rows]

    def _alike(self, variants: Variants, rows: Sequence[int]) -> list[int]:
        """Return for each of some variants the first of them that has the same model."""
        if self._varies_spheres(variants):
            return list(rows)
        return distinct(rows, list((variants.fields or {}).values()))

    def _simulate(
        self, run: SimulationRun, n: int, m: mujoco.MjModel | None = None, d: mujoco.MjData | None = None
    ) -> VariantResult | None:
        """Simulate variant n; None if its contacts or constraints did not fit the arena.

        Args:
            run: What is asked for.
            n: Index of the variant.
            m: Its model, which force models may edit; fields that they edit are as before when this returns.
            d: Data of the model, overwritten.
        """
        force_models = [(force_model, values[n]) for force_model, values in run.variants.force_models or ()]
        if m is None:
            m = self._variant_model(run.variants, n)
            if any(force_model.edits for force_model, _ in force_models):
                m = copy.copy(m)
        if d is None:
            d = mujoco.MjData(m)
        else:
            mujoco.mj_resetData(m, d)
        if run.variants.qpos is not None:
            d.qpos[:] = run.variants.qpos[n]
        if run.variants.qvel is not None:
            d.qvel[:] = run.variants.qvel[n]
        ctrl = run.ctrl[n % len(run.ctrl)]
        if m.na and run.steps:
            d.act[:] = initial_activation(m, d, ctrl[0])
        result = VariantResult.empty(m, run)
        step = simulate_steps
        if records_states_only(m, run):
            step = partial(simulate_with_force_models, compiled=self._may_compile(force_models))
            step = step if force_models else simulate_in_one_call
        try:
            with restored(m, [name for force_model, _ in force_models for name in force_model.edits]):
                result.diverged = not step(m, d, run, ctrl, result, force_models)
        except mujoco.FatalError as error:
            if "stack" in str(error) or "arena" in str(error):
                return None
            raise EngineError("MuJoCo stopped", where=f"variant {n}", found=error) from None
        return None if d.warning.number[OVERFLOW].any() else result

    def _may_compile(self, force_models: Sequence[tuple[ForceModel, np.ndarray]]) -> bool:
        """Return whether steps with some force models may be compiled."""
        if not force_models or not can_step(force_models):
            return False
        if self._roomy is None:
            self._roomy = cannot_fill_arena(self._compiled)
        return self._roomy

    def _varies_spheres(self, variants: Variants) -> bool:
        """Return whether spheres of the contact geometry vary."""
        return bool(len(self._sphere_geom)) and any(getattr(variants, name) is not None for name in SPHERE_FIELDS)

    def _variant_model(self, variants: Variants, n: int) -> mujoco.MjModel:
        """Return the model of variant n, compiled anew where geometry varies: the mid-phase trees depend on it."""
        if self._varies_spheres(variants):
            try:
                compiler = self._compilers.get_nowait()
            except queue.Empty:
                compiler = VariantCompiler(self.model, self._collidable, self._memory)
            m = compiler.compile(variants, n)
            self._compilers.put(compiler)
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
        self._compilers, self._data = queue.SimpleQueue(), queue.SimpleQueue()
        spec = self.model.spec(self._collidable)
        spec.memory = size
        self._compiled = self.model.finish(spec.compile())
        self._roomy = None


def _in_threads(work: Callable[[S], T], arguments: Sequence[S], count: int) -> list[T]:
    """Return the results of some work, in `count` threads; see `concent_warp.simulate.time_limit`."""
    check = time_check()

    def in_time(argument: S) -> T:
        check()
        return work(argument)

    if count == 1 or len(arguments) == 1:
        return [in_time(each) for each in arguments]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(in_time, arguments))


class VariantCompiler:
    """Compiles the models of variants that differ in their spheres, from one spec; not thread-safe."""

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
        """Return the compiled model of variant n, spheres only; what does not vary is as in the model.

        Compiling takes about as long as a short simulation, and a search runs each geometry on many segments in turn:
        equal variants share a model, which must not be edited.
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
