"""What a model predicts for windows of a recording, as a function of its effects' parameters and of initial states."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import mujoco
import numpy as np

from concent_warp.checks import Bounds, Duration, Positive
from concent_warp.effects.effect import AddedEffect, Effect, Parameter, Reader, variant_fields
from concent_warp.effects.posterior import JointPosterior
from concent_warp.effects.select import shown_dofs
from concent_warp.simulate.engine import Engine, Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import UNIT_QUATERNION_SENSORS, commands
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.fit.effects.observation import Window
    from concent_warp.model import Model
    from concent_warp.scene.payloads import Payload

EngineKey = tuple[tuple[float, ...], tuple["Payload", ...]]
"""What the compiled model depends on: the parameters that enter the MJCF, and payloads."""
MAX_ENGINES = 8
"""Engines that are kept for other such values."""


@dataclass(frozen=True)
class PredictionCfg:
    """Settings of predicted readings."""

    max_residual: Positive = 1e3
    """Largest residual, in units of noise, and that of readings which a diverged simulation does not predict [-]: far
    above what robust losses are linear from."""
    extrapolation: Duration = 0.05
    """Time before and after a window over which predictions are continued linearly [s]: readings may be delayed by as
    much."""
    call_steps: Annotated[int, Bounds(0, 10**6)] = 300
    """Steps of a simulation that take as long as what a call of the engine costs besides: windows that differ by fewer
    in all are simulated in one."""
    cache_bytes: Annotated[int, Bounds(0, 2**40)] = 2**25
    """Size of the simulations that are kept for repeated requests [bytes]."""


@dataclass(frozen=True)
class SimulationRequest:
    """One simulation: a window, from a state off the measured one, with values of the parameters."""

    window: int
    values: np.ndarray
    """Shape (P,)."""
    offset: np.ndarray | None = None
    """Difference of the initial state, positions then velocities, shape (2 nv,); None for none."""
    early: float = 0.0
    """Time by which the simulation begins before the window [s]."""


@dataclass(frozen=True)
class Course:
    """What a simulation went through."""

    reader: Reader
    """What the model's instruments read; times count from the window's start."""
    qpos: np.ndarray
    """Shape (K + 1, nq)."""
    qvel: np.ndarray
    """Shape (K + 1, nv)."""
    size: int
    """Of what the instruments read [bytes]."""


class Prediction:
    """Predicted measurements of a model with some effects.

    The parameters are those of the effects that the model has, then those of the effects in question, P in all.
    """

    def __init__(
        self,
        model: Model,
        effects: Sequence[Effect],
        windows: Sequence[Window],
        *,
        engine: EngineName = "mujoco",
        threads: int | None = None,
        cfg: PredictionCfg | None = None,
        at_true_time: bool = False,
    ) -> None:
        """Prepare to simulate.

        A window starts at the state that the instruments show at its start. Where bodies move freely, it is corrected
        for effects on measurements: if one shifts the clock of all channels, the simulation starts at the true time of
        that state; else what the instruments show too early or too late is moved along its velocity. Errors of the
        states of joints alone fade, or are small beside their uncertainty.

        Args:
            model: The model, whose effects take part with variable values.
            effects: Effects that it does not have.
            windows: What is predicted.
            engine: Which engine simulates.
            threads: Simulations at a time, for C MuJoCo; by default one for each CPU.
            cfg: Settings.
            at_true_time: Whether simulations start when windows do, by the clock of the commands.
        """
        self.cfg = cfg or PredictionCfg()
        self.windows = list(windows)
        self.effects: tuple[Effect, ...] = (*(a.effect for a in model.effects), *effects)
        self._base = replace(model, effects=())
        plain = self._base.compile()
        owned = [e.effect.parameters(plain) for e in model.effects]
        # Null values follow from the model without the effect: what it has already counts.
        current = model.compile()
        fresh = [e.parameters(current) for e in effects]
        self.parameters: tuple[Parameter, ...] = tuple(p for group in (*owned, *fresh) for p in group)
        ends = np.cumsum([0, *(len(group) for group in (*owned, *fresh))])
        self.split = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
        self.start = np.array(
            [v for a in model.effects for v in a.values] + [p.null for group in fresh for p in group], dtype=float
        )
        self.owned = sum(len(group) for group in owned)
        self.prior_mean = self.start.copy()
        for e, part in zip(self.effects, self.split, strict=True):
            if e.nominal:
                self.prior_mean[part] = [p.null for p in self.parameters[part]]
        self._engine_name: EngineName = engine
        self._threads = threads
        self._engines: dict[EngineKey, tuple[Engine, mujoco.MjModel]] = {}
        self._edits = [i for i, e in enumerate(self.effects) if e.edits]
        free = self._base.scene.model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)
        self._moves_freely = bool(free.any())
        self.measured_only, self.nominal = np.zeros((2, len(self.parameters)), dtype=bool)
        for e, part in zip(self.effects, self.split, strict=True):
            self.nominal[part] = e.nominal
            moves = e.edits or e.commands or type(e).write is not Effect.write
            pure = e.measures and not moves and type(e).force_model is Effect.force_model
            self.measured_only[part] = pure and not (self._moves_freely and e.misleads_start)
        channels = {r.channel for w in self.windows for r in w.readings}
        self._clocks = [not at_true_time and channels <= set(e.target) for e in self.effects]
        """Which effects shift the clock of all channels, if any."""
        self._kept: dict[tuple[int, bytes, bytes, float], tuple[Reader, int]] = {}
        self.simulated = 0
        """Simulated time so far [s]."""

    @property
    def timestep(self) -> float:
        """The time step of the model [s]."""
        return float(self._base.scene.model.opt.timestep)

    @property
    def compiled(self) -> mujoco.MjModel:
        """The compiled model at the start values, prepared for the effects."""
        return self._engine(self._engine_key(self.start))[0].compiled

    def compiled_in(self, window: int) -> mujoco.MjModel:
        """Return the same with the payloads of a window's demonstration."""
        return self._engine(self._engine_key(self.start, window))[0].compiled

    def only(self, windows: Sequence[int]) -> Prediction:
        """Return the prediction of some of the windows, with a memory of its own."""
        found = copy(self)
        found.windows, found._kept = [self.windows[w] for w in windows], {}
        return found

    def model(
        self,
        values: np.ndarray,
        intervals: Sequence[tuple[float, float]] = (),
        posterior: JointPosterior | None = None,
    ) -> Model:
        """Return the model with all effects at some values, shape (P,), their intervals and their posterior."""
        added = []
        for e, part in zip(self.effects, self.split, strict=True):
            first = 0 if posterior is None else part.start
            chosen = tuple(float(v) for v in values[part])
            added.append(AddedEffect(e, chosen, tuple(intervals[part]), posterior, first))
        return replace(self._base, effects=tuple(added))

    def _engine_key(self, values: np.ndarray, window: int | None = None) -> EngineKey:
        """Return the values that enter the MJCF, all others at the start, and the payloads of a window."""
        chosen = self.start.copy()
        for i in self._edits:
            chosen[self.split[i]] = values[self.split[i]]
        return tuple(chosen.tolist()), () if window is None else self.windows[window].demonstration.payloads

    def _engine(self, key: EngineKey) -> tuple[Engine, mujoco.MjModel]:
        """Return an engine, and the model before effects write their fields."""
        if key not in self._engines:
            if len(self._engines) > MAX_ENGINES:
                self._engines.pop(next(iter(self._engines)))
            model = self.model(np.array(key[0])).with_payloads(key[1])
            limited = self._threads is not None and self._engine_name == "mujoco"
            engine: Engine = (
                MujocoEngine(model, threads=self._threads) if limited else make_engine(self._engine_name, model)
            )
            self._engines[key] = engine, model.spec().compile()
        return self._engines[key]

    def readers(self, trials: Sequence[SimulationRequest]) -> list[Reader]:
        """Simulate, and return what the model's instruments read in each trial; times count from the window's start.

        Effects of measurement are applied on top, by `observed`. What was simulated lately is not simulated again.
        """
        keys = [self._key(trial) for trial in trials]
        new = {key: i for i, key in enumerate(keys) if key not in self._kept}
        fresh = dict(zip(new, self.courses([trials[i] for i in new.values()]), strict=True))
        found = [fresh[key].reader if key in fresh else self._kept[key][0] for key in keys]
        self._kept |= {key: (course.reader, course.size) for key, course in fresh.items()}
        size = sum(size for _, size in self._kept.values())
        while size > self.cfg.cache_bytes:
            size -= self._kept.pop(next(iter(self._kept)))[1]
        return found

    def _key(self, trial: SimulationRequest) -> tuple[int, bytes, bytes, float]:
        """Return what a simulation depends on."""
        offset = b"" if trial.offset is None else trial.offset.tobytes()
        return trial.window, trial.values[~self.measured_only].tobytes(), offset, trial.early

    def courses(self, trials: Sequence[SimulationRequest], time: float | None = None) -> list[Course]:
        """Simulate trials, each to the end of its window or for some time [s] only."""
        courses: list[Course | None] = [None] * len(trials)
        groups: dict[EngineKey, list[int]] = {}
        steps = [self._steps(trial.window, time) for trial in trials]
        for i, trial in enumerate(trials):
            groups.setdefault(self._engine_key(trial.values, trial.window), []).append(i)
        for key, alike in groups.items():
            for members in of_similar_length(alike, steps, self.cfg.call_steps):
                engine, bare = self._engine(key)
                simulated = self._simulate(engine, bare, [trials[i] for i in members], [steps[i] for i in members])
                for i, course in zip(members, simulated, strict=True):
                    courses[i] = course
        return [c for c in courses if c is not None]

    def _steps(self, window: int, time: float | None) -> int:
        """Return how many steps cover a window, or its first part of some time [s]."""
        w = self.windows[window]
        span = w.end - w.start if time is None else min(time, w.end - w.start)
        return max(int(np.ceil(span / self.timestep - 1e-9)), 1)

    def _simulate(
        self, engine: Engine, bare: mujoco.MjModel, trials: Sequence[SimulationRequest], lengths: Sequence[int]
    ) -> list[Course]:
        """Simulate trials of similar lengths [steps] in one engine, all for as long as the longest."""
        m, n, steps = engine.compiled, len(trials), max(lengths)
        values = np.array([t.values for t in trials])
        qpos, qvel, ctrl = np.empty((n, m.nq)), np.empty((n, m.nv)), np.empty((n, steps, m.nu))
        plain = {}
        for i, trial in enumerate(trials):
            w = self.windows[trial.window]
            qpos[i], qvel[i] = self.first_state(w, values[i])
            if trial.offset is not None:
                mujoco.mj_integratePos(m, qpos[i], trial.offset[: m.nv], 1.0)
                qvel[i] += trial.offset[m.nv :]
            begin = self.first_time(w, values[i]) - trial.early
            if (trial.window, begin) not in plain:
                plain[trial.window, begin] = self._commands(m, w, steps, begin)
            ctrl[i] = self._acting(m, plain[trial.window, begin], values[i], steps)
        fields = variant_fields(bare, self.effects, values, self.split)
        force_models = [
            (force_model, values[:, part])
            for e, part in zip(self.effects, self.split, strict=True)
            if (force_model := e.force_model(m)) is not None
        ]
        variants = Variants(n, qpos=qpos, qvel=qvel, fields=fields, force_models=force_models)
        rollout = engine.run(variants, ctrl, bodies=[]).numpy()
        self.simulated += n * steps * m.opt.timestep
        courses = []
        found = zip(trials, lengths, rollout.qpos, rollout.qvel, rollout.sensordata, strict=True)
        for trial, length, qpos, qvel, read in found:
            part = slice(length + 1)
            own, time = read[part].copy(), rollout.time[part] - trial.early  # the array of all would live as long
            reader = SensorReader(m, time, own, self.cfg.extrapolation)
            courses.append(Course(reader, qpos[part], qvel[part], own.nbytes))
        return courses

    def first_time(self, w: Window, values: np.ndarray) -> float:
        """Return when the simulation of a window starts [s], by the clock of the commands.

        Args:
            w: The window.
            values: Parameters, shape (P,).
        """
        time = w.start
        if w.start_shown and self._moves_freely:
            for e, part, all_channels in zip(self.effects[::-1], self.split[::-1], self._clocks[::-1], strict=True):
                time = e.true_time(time, values[part]) if all_channels else time
        return time

    def first_state(self, w: Window, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the state in which the simulation of a window starts, without an offset, qpos (nq,) and qvel (nv,).

        Args:
            w: The window.
            values: Parameters, shape (P,).
        """
        m, qpos, qvel = self._base.scene.model, w.qpos, w.qvel
        for e, part, all_channels in zip(self.effects[::-1], self.split[::-1], self._clocks[::-1], strict=True):
            if not (w.start_shown and self._moves_freely and e.misleads_start):
                continue
            qpos, qvel = e.true_state(m, qpos, qvel, values[part])
            shown, later = (e.true_time(t, values[part]) for t in (w.start, w.start + 1.0))
            dof = shown_dofs(m, e.target)
            qpos, qvel, step = qpos.copy(), qvel.copy(), np.zeros(m.nv)
            qvel[dof] /= later - shown
            if not all_channels:
                step[dof] = (w.start - shown) * qvel[dof]
                mujoco.mj_integratePos(m, qpos, step, 1.0)
        return qpos, qvel

    def _commands(self, m: mujoco.MjModel, w: Window, steps: int, begin: float) -> np.ndarray:
        """Return the commands of a window and of the time before it that effects reach back to, shape (H + K, nu)."""
        before = self._before(m)
        return commands(m, w.demonstration, before + steps, begin - before * m.opt.timestep)

    def _before(self, m: mujoco.MjModel) -> int:
        """Return how many steps effects reach back."""
        return int(np.ceil(max((e.history for e in self.effects), default=0.0) / m.opt.timestep))

    def _acting(self, m: mujoco.MjModel, plain: np.ndarray, values: np.ndarray, steps: int) -> np.ndarray:
        """Return the commands that act, shape (K, nu)."""
        ctrl = plain
        for e, part in zip(self.effects, self.split, strict=True):
            if e.commands:
                ctrl = e.command(m, ctrl, values[part])
        return ctrl[len(ctrl) - steps :]

    def observed(self, window: int, reader: Reader, values: np.ndarray) -> np.ndarray:
        """Return residuals, measured less predicted, of a window as instruments read it, shape (count,).

        They are in units of noise, or of noise and numerical scatter (`Window.scatter`) together.
        """
        w, m = self.windows[window], self._base.scene.model
        begin = self.first_time(w, values)
        read: Reader = lambda sensor, time: reader(sensor, time - begin)  # noqa: E731
        for e, part in zip(self.effects, self.split, strict=True):
            if e.measures:
                read = e.measure(m, read, values[part])
        residual, most = np.empty(w.count), self.cfg.max_residual
        for r in w.readings:
            predicted = read(r.channel, r.time + w.start)
            value = turn(predicted, r.value) if r.orientation else r.value - predicted
            residual[r.rows] = np.nan_to_num(r.in_noise(value), nan=most, posinf=most, neginf=-most)
        if w.scatter is not None:
            residual = w.scatter.whitened(np.clip(residual, -most, most))
        return np.clip(residual if w.defect is None else residual + w.defect.residual, -most, most)

    def residuals(self, trials: Sequence[SimulationRequest]) -> list[np.ndarray]:
        """Return the residuals of each trial, see `observed`."""
        readers = self.readers(trials)
        return [self.observed(t.window, r, t.values) for t, r in zip(trials, readers, strict=True)]


def of_similar_length(members: Sequence[int], steps: Sequence[int], most: int) -> list[list[int]]:
    """Return simulations in parts, each of which is simulated for as long as its longest takes.

    Args:
        members: Indices of the simulations.
        steps: Steps of each by index.
        most: Most steps beyond the own ones that all simulations of a part take together, but for equal ones.
    """
    found: list[list[int]] = []
    extra = 0
    for i in sorted(members, key=lambda i: -steps[i]):
        extra += steps[found[-1][0]] - steps[i] if found else 0
        if not found or extra > most:
            found.append([])
            extra = 0
        found[-1].append(i)
    return found


class SensorReader:
    """Predicted sensor values at any time, linear between records and for a short time beyond them."""

    def __init__(
        self,
        m: mujoco.MjModel,
        time: np.ndarray,
        sensordata: np.ndarray,
        extrapolation: float = PredictionCfg.extrapolation,
    ) -> None:
        """Set the records.

        Args:
            m: The compiled model.
            time: Times [s], shape (R,).
            sensordata: Sensor values, shape (R, nsensordata).
            extrapolation: Time before and after the records over which they are continued linearly [s].
        """
        self._m, self._time, self._data, self._extrapolation = m, time, sensordata, extrapolation

    def __call__(self, sensor: str, time: np.ndarray) -> np.ndarray:
        """Return the values of a sensor at times (T,) [s], shape (T, dim)."""
        row = self._m.sensor(sensor).id
        address, dim = self._m.sensor_adr[row], self._m.sensor_dim[row]
        value = self._data[:, address : address + dim]
        if len(self._time) < 2:
            return np.repeat(value[:1], len(time), axis=0)
        now = np.clip(time, self._time[0] - self._extrapolation, self._time[-1] + self._extrapolation)
        step = self._time[1] - self._time[0]
        lower = np.clip(((now - self._time[0]) / step + 1e-9).astype(int), 0, len(self._time) - 2)
        weight = ((now - self._time[lower]) / step)[:, None]
        low, high = value[lower], value[lower + 1]
        if int(self._m.sensor_type[row]) in map(int, UNIT_QUATERNION_SENSORS):
            high = np.where((low * high).sum(axis=1, keepdims=True) < 0, -high, high)
            mixed = (1 - weight) * low + weight * high
            return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
        return (1 - weight) * low + weight * high


def turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rotation vectors [rad] from `start` to `end`, quaternions wxyz (T, 4), shape (T, 3); NaN for NaN."""
    w1, w2 = start[:, :1], end[:, :1]
    v1, v2 = start[:, 1:], end[:, 1:]
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = w1 * v2 - w2 * v1 - np.cross(v1, v2)
        cosine = w1 * w2 + (v1 * v2).sum(axis=1, keepdims=True)
        axis, cosine = np.where(cosine < 0, -axis, axis), np.abs(cosine)
        sine = np.sqrt((axis**2).sum(axis=1, keepdims=True))
        length = np.hypot(sine, cosine)
        # The angle over its half's sine; quaternions need not have unit length.
        factor = np.where(sine < 1e-6 * length, 2.0 / length, 2.0 * np.arctan2(sine, cosine) / sine)
    return axis * factor
