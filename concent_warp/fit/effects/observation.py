"""What is fitted: windows of demonstrations, with measured values in units of their noise.

A window starts from a state that is only roughly measured; its error is estimated along with the parameters
(multiple shooting: Bock, "Recent advances in parameter identification techniques for ODE", 1983). Where errors of the
initial state decay or stay small, as in pushing and in driven arms, a window is a whole demonstration; where they grow,
as in impacts and tumbling, it ends before they have grown much.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.estimation.partial_state import PartialState, PartialStateEstimator
from concent_warp.estimation.sample_noise import covariance_std, relative_whitening, whitened
from concent_warp.estimation.state_estimator import StateEstimator
from concent_warp.fit.effects.guided_replay import GuidedReplay
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.scene.sensor_frame import SensorFrame, sensor_frame
from concent_warp.simulate.replay import UNIT_QUATERNION_SENSORS, initial_state

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration, Recording


MIN_LEVER = 3e-3
"""Motion of a marker [m or rad] for one of a joint below which it says nothing of the joint."""


@dataclass(frozen=True)
class Reading:
    """The samples of one channel that lie in a window."""

    channel: str
    rows: slice
    """Their residuals among those of the window; each sample has one for each measured component, one after the
    other."""
    time: np.ndarray
    """Times [s] from the window's start, shape (T,)."""
    value: np.ndarray
    """Measured values, shape (T, dim); NaN where a component was not measured."""
    std: float
    """Standard deviation of the noise of a component (of the rotation vector, for orientations)."""
    orientation: bool
    known: np.ndarray | None = None
    """Which components were measured, shape (T, dim) bool, where some were not; these have no residual."""
    whitening: np.ndarray | None = field(default=None, repr=False)
    """Matrices, shape (T, dim, dim), that make the noise of all samples alike (`relative_whitening`); None where it is
    (dim 3 for orientations)."""

    def in_noise(self, value: np.ndarray) -> np.ndarray:
        """Return measured less predicted, shape (T, dim), in units of noise, for the components that were measured."""
        return self.residuals(whitened(value, self.whitening) / self.std)

    def common_in_noise(self, common: np.ndarray) -> np.ndarray:
        """Return what errors in common, shape (T, dim, m), change in units of noise, one row for each residual."""
        changes = np.moveaxis(np.nan_to_num(common), 2, 0)
        if self.known is not None and not self.orientation:
            changes = np.where(self.known, changes, np.nan)
        return np.stack([np.nan_to_num(self.in_noise(change)) for change in changes], axis=1)

    def residuals(self, value: np.ndarray) -> np.ndarray:
        """Return what (T, dim) is for the components that were measured, one after the other."""
        return value.ravel() if self.known is None else value[self.known]


@dataclass(frozen=True)
class TimeStepDefect:
    """What a shorter time step changes in a window's predictions, at some values and initial state.

    Added to the predictions with the model's own step (defect correction: Stetter, "The defect correction principle and
    discretization methods", Numerische Mathematik 29, 1978), it stands for simulations with the shorter one.
    """

    timestep: float
    """The shorter time step [s]."""
    residual: np.ndarray = field(repr=False)
    """Residuals with the shorter step less those with the model's own, in units of noise, shape (count,)."""


@dataclass(frozen=True)
class NumericalScatter:
    """Scatter of a window's predictions over the phase of the time grid, in units of noise.

    A simulated contact begins at a step of the time grid, up to one step after bodies meet; the impulse, and what
    follows, depends on where between two steps they meet. No measurement can tell: what it changes is an error of the
    simulation that counts as noise, correlated over the rest of the window.

    A body that slides hops in the simulation, by a fraction of a millimetre or more: soft contact laws with a convex
    cone of friction press it off the faster it slides. Hops follow one another without order, and real bodies do not
    hop. They are noise of each residual for itself.
    """

    deviations: np.ndarray = field(repr=False)
    """Deviations of the residuals, shape (count, K); their covariance is `deviations @ deviations.T`."""
    own: np.ndarray | None = field(default=None, repr=False)
    """Standard deviations of what each residual has for itself, shape (count,); None for nothing."""

    def whitened(self, residual: np.ndarray) -> np.ndarray:
        """Return residuals r (count,) in units of noise and scatter: (I + E D D' E)^(-1/2) E r, where E = (I + diag
        own^2)^(-1/2).
        """
        directions, variance = self._directions
        residual = residual * self._shares
        return residual + directions @ ((1 / np.sqrt(1 + variance) - 1) * (directions.T @ residual))

    def unwhitened(self, residual: np.ndarray) -> np.ndarray:
        """Return residuals (count,) in units of noise from those in units of noise and scatter: `whitened` undone."""
        directions, variance = self._directions
        residual = residual + directions @ ((np.sqrt(1 + variance) - 1) * (directions.T @ residual))
        return residual / self._shares

    def rows(self, chosen: np.ndarray) -> NumericalScatter:
        """Return the scatter of some of the residuals, by their indices."""
        return NumericalScatter(self.deviations[chosen], None if self.own is None else self.own[chosen])

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance of noise and scatter [-]."""
        return float(np.log1p(self._directions[1]).sum() - 2 * np.log(self._shares).sum())

    @property
    def square(self) -> float:
        """Sum of the variances by which residuals scatter [-]."""
        return float((self.deviations**2).sum() + (0.0 if self.own is None else (self.own**2).sum()))

    @cached_property
    def _shares(self) -> np.ndarray:
        """Noise of each residual over noise and what it has for itself, shape (count,)."""
        return np.ones(len(self.deviations)) if self.own is None else 1 / np.sqrt(1 + self.own**2)

    @cached_property
    def _directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal directions (count, K) of the deviations, and the variances along them (K,)."""
        directions, size, _ = np.linalg.svd(self.deviations * self._shares[:, None], full_matrices=False)
        return directions, size**2


@dataclass(frozen=True)
class Window:
    """A span of a demonstration that is simulated in one go."""

    demonstration: Demonstration
    number: int
    """Position of the demonstration in the recording."""
    start: float
    """[s]."""
    end: float
    qpos: np.ndarray
    """Estimated state at the start, shape (nq,)."""
    qvel: np.ndarray
    """Shape (nv,)."""
    spread: np.ndarray
    """Standard deviation of the estimate, of positions and then velocities, shape (2 nv,)."""
    readings: tuple[Reading, ...]
    count: int
    """Number of residuals."""
    clock: np.ndarray = field(repr=False)
    """Time in the demonstration that each residual belongs to [s], shape (count,)."""
    smooth: bool = False
    """Whether nothing touches anything in the model's motion, which then depends smoothly on the initial state."""
    noise_scale: float = 1.0
    """Standard deviation that residuals are in units of over that of the noise [-]: more than 1 where a model is so far
    off that its own error takes the place of the noise."""
    start_shown: bool = True
    """Whether the state at the start is as the instruments show it, and not the true one."""
    defect: TimeStepDefect | None = None
    """Correction of the predictions for a time step that is too long; None for none."""
    scatter: NumericalScatter | None = None
    """Numerical scatter of the predictions, with what readings have in common; None for none."""
    common: np.ndarray | None = field(default=None, repr=False)
    """Changes of the residuals per standard deviation of errors that all samples of a channel share (`Channel.common`),
    shape (count, m); None for none."""

    def without_scatter(self, residual: np.ndarray) -> np.ndarray:
        """Return residuals (count,) in units of noise alone from those in which numerical scatter counts as noise."""
        if self.scatter is None:
            return residual
        residual = self.scatter.unwhitened(residual)
        return residual if self.common is None else NumericalScatter(self.common).whitened(residual)


def first_part(w: Window, length: float) -> Window:
    """Return the first part of a window, of a length [s]; the window itself if it is no longer, or not measured there.

    A window that begins where the state was not measured cannot be cut into several.
    """
    if w.end - w.start <= length:
        return w
    readings, rows, count = [], [], 0
    for r in w.readings:
        inside = r.time <= length + 1e-9
        if not inside.any():
            continue
        here = np.arange(r.rows.start, r.rows.stop)
        each = len(here) // len(r.time) if r.known is None else r.known.sum(axis=1)
        here = here[np.repeat(inside, each)]
        known = None if r.known is None else r.known[inside]
        whitening = None if r.whitening is None else r.whitening[inside]
        kept = slice(count, count + len(here))
        part = replace(r, rows=kept, time=r.time[inside], value=r.value[inside], known=known, whitening=whitening)
        readings.append(part)
        rows.append(here)
        count += len(here)
    if not rows:
        return w
    chosen = np.concatenate(rows)
    defect = None if w.defect is None else replace(w.defect, residual=w.defect.residual[chosen])
    scatter = None if w.scatter is None else w.scatter.rows(chosen)
    common = None if w.common is None else w.common[chosen]
    return replace(
        w,
        end=w.start + length,
        readings=tuple(readings),
        count=count,
        clock=w.clock[chosen],
        defect=defect,
        scatter=scatter,
        common=common,
    )


def start_spread(
    m: mujoco.MjModel,
    noise: Mapping[str, float],
    cfg: ObservationCfg | None = None,
    *,
    measured: np.ndarray | None = None,
) -> np.ndarray:
    """Return the standard deviation of a measured initial state, positions and then velocities, shape (2 nv,).

    Args:
        m: The compiled model.
        noise: Standard deviation of a component of each channel.
        cfg: Settings.
        measured: Which degrees of freedom were measured, shape (nv,) bool; as the channels say by default. Those that
            were not, of free bodies of which others were or a marker was seen, are far more uncertain.
    """
    cfg = cfg or ObservationCfg()
    frames = {row: frame for name in noise if (frame := sensor_frame(m, row := int(m.sensor(name).id))) is not None}
    seen_bodies = {frame.body for frame in frames.values()}
    position, velocity = np.full(m.nv, cfg.unmeasured_position), np.full(m.nv, cfg.unmeasured_velocity)
    if measured is not None:
        for dof in (dof for body in seen_bodies for dof in _ball_dofs(m, body)):
            position[dof : dof + 3], velocity[dof : dof + 3] = cfg.unknown_orientation, cfg.unknown_spin
        for joint in np.flatnonzero(m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
            dof = int(m.jnt_dofadr[joint])
            if measured[dof : dof + 6].any() or int(m.jnt_bodyid[joint]) in seen_bodies:
                position[dof : dof + 3], position[dof + 3 : dof + 6] = cfg.unknown_position, cfg.unknown_orientation
                velocity[dof : dof + 3], velocity[dof + 3 : dof + 6] = cfg.unknown_velocity, cfg.unknown_spin

    rates: dict[int, float] = {}
    told: dict[int, float] = {}
    shown: set[int] = set()

    def seen(dof: slice, std: float) -> None:
        here = np.arange(m.nv)[dof]
        shown.update(here.tolist())
        here = here if measured is None else here[measured[here]]
        position[here] = cfg.state_noise * std
        velocity[here] = cfg.state_noise * std / cfg.velocity_time

    for sensor, std in noise.items():
        row = m.sensor(sensor).id
        kind, target = int(m.sensor_type[row]), int(m.sensor_objid[row])
        if kind == int(mujoco.mjtSensor.mjSENS_JOINTPOS):
            dof = int(m.jnt_dofadr[target])
            seen(slice(dof, dof + 1), std)
        elif kind == int(mujoco.mjtSensor.mjSENS_JOINTVEL):
            rates[int(m.jnt_dofadr[target])] = cfg.state_noise * std
        elif kind == int(mujoco.mjtSensor.mjSENS_BALLQUAT):
            dof = int(m.jnt_dofadr[target])
            seen(slice(dof, dof + 3), std)
        elif kind == int(mujoco.mjtSensor.mjSENS_TENDONPOS):
            first = m.tendon_adr[target]
            for w in range(first, first + m.tendon_num[target]):
                if m.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_JOINT):
                    dof = int(m.jnt_dofadr[m.wrap_objid[w]])
                    seen(slice(dof, dof + 1), std)
        elif kind in (int(mujoco.mjtSensor.mjSENS_FRAMEPOS), int(mujoco.mjtSensor.mjSENS_FRAMEQUAT)):
            if row not in frames:
                continue
            turns, joint = kind == int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(m.body_jntadr[frames[row].body])
            if joint < 0 or m.jnt_type[joint] != int(mujoco.mjtJoint.mjJNT_FREE):
                for dof in _ball_dofs(m, frames[row].body) if turns else ():
                    seen(slice(dof, dof + 3), std)
                for dof, lever in _levers(m, frames[row], turn=turns).items():
                    told[dof] = min(told.get(dof, np.inf), std / lever)
                continue
            dof = int(m.jnt_dofadr[joint]) + 3 * turns
            seen(slice(dof, dof + 3), std)
    for dof in told.keys() - shown:  # joints without a sensor of their own
        seen(slice(dof, dof + 1), told[dof])
    for dof, std in rates.items():  # of joints whose position was measured too, the velocity is estimated from both
        if measured is not None and not measured[dof]:
            velocity[dof] = std
    return np.concatenate([position, velocity])


def _ball_dofs(m: mujoco.MjModel, body: int) -> list[int]:
    """Return the first degree of freedom of each ball joint of a body."""
    first = int(m.body_jntadr[body])
    joints = range(first, first + int(m.body_jntnum[body]))
    return [int(m.jnt_dofadr[j]) for j in joints if m.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_BALL)]


def _levers(m: mujoco.MjModel, frame: SensorFrame, *, turn: bool) -> dict[int, float]:
    """Return by how much a frame moves in the reference pose [m or rad] with each hinge and slide below it, by its dof.

    Those that move it by less than `MIN_LEVER` are left out.
    """
    d, place, spin = mujoco.MjData(m), np.zeros((3, m.nv)), np.zeros((3, m.nv))
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    point = d.xpos[frame.body] + d.xmat[frame.body].reshape(3, 3) @ frame.offset
    mujoco.mj_jac(m, d, place, spin, point, frame.body)
    moves = np.linalg.norm(spin if turn else place, axis=0)
    return {int(dof): float(moves[dof]) for dof in np.flatnonzero(moves > MIN_LEVER) if _is_scalar(m, int(dof))}


def _is_scalar(m: mujoco.MjModel, dof: int) -> bool:
    """Return whether a degree of freedom is a hinge or a slide."""
    kind = int(m.jnt_type[m.dof_jntid[dof]])
    return kind in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True)
class ObservedRecording:
    """A recording as a model reads it: which channels count, with what noise, and the state at any time."""

    model: Model
    recording: Recording
    noise: Mapping[str, float]
    """Standard deviation of a component of each channel that counts."""
    cfg: ObservationCfg = field(default_factory=ObservationCfg)
    """Settings."""
    _measured: dict[int, tuple[Demonstration, StateEstimator | None]] = field(default_factory=dict, repr=False)
    """Estimated motions so far, by the identity of the demonstration."""
    _partial: dict[int, tuple[Demonstration, PartialStateEstimator]] = field(default_factory=dict, repr=False)
    """What was measured of motions of which not all was, likewise."""
    _guided: dict[int, tuple[Demonstration, GuidedReplay | None]] = field(default_factory=dict, repr=False)
    """Replays that follow what was measured of these, likewise."""

    def state(self, d: Demonstration, time: float) -> PartialState:
        """Return the state of a demonstration at a time [s], as recorded or measured, else of the reference pose."""
        m = self.model.scene.model
        every = np.ones(m.nv, dtype=bool)
        if time <= 0.0 and d.qpos is not None and d.qvel is not None:
            return PartialState(*initial_state(m, d), every)
        if (estimator := self.measured(d)) is not None:
            states = estimator.states(np.array([time]))
            return PartialState(states.qpos[0], states.qvel[0], every)
        if time > 0.0 and (guided := self.guided(d)) is not None:
            return guided.state(time)
        found = self._partly_measured(d).state(time)
        if time <= 0.0 and d.qpos is not None:
            return replace(found, qpos=initial_state(m, d)[0])
        return found

    def guided(self, d: Demonstration) -> GuidedReplay | None:
        """Return replays of a demonstration that follow the measured part of its motion.

        None where all of it was measured, or neither place nor orientation of a body that moves freely: where that
        goes, a model without the missing effect does not know.
        """
        if id(d) not in self._guided:
            found, m = None, self.model.scene.model
            if self.measured(d) is None and _sees_each_free_body(m, self._partly_measured(d)):
                partial = self._partly_measured(d)
                spread = self._spread(d, partial.measured)
                found = GuidedReplay.of(self.model, d, partial, spread, self._known(m.nv))
            self._guided[id(d)] = (d, found)
        return self._guided[id(d)][1]

    def _partly_measured(self, d: Demonstration) -> PartialStateEstimator:
        """Return the states of a demonstration as far as they were measured."""
        if id(d) not in self._partial:
            self._partial[id(d)] = (d, PartialStateEstimator.of(self.model.scene.model, d))
        return self._partial[id(d)][1]

    def _known(self, nv: int) -> np.ndarray:
        """Return the standard deviation of a state that replays tell, positions and then velocities, shape (2 nv,)."""
        return self.cfg.state_noise * np.repeat([self.cfg.unmeasured_position, self.cfg.unmeasured_velocity], nv)

    def _spread(self, d: Demonstration, measured: np.ndarray | None) -> np.ndarray:
        """Return the standard deviation of the first state of a demonstration, see `start_spread`."""
        noise = {name: std for name, std in self.noise.items() if name in d.measured}
        return start_spread(self.model.scene.model, noise, self.cfg, measured=measured)

    def measured(self, d: Demonstration) -> StateEstimator | None:
        """Return the estimated motion of a demonstration, None where the pose of a body or joint was not measured."""
        if id(d) not in self._measured:
            try:
                found = StateEstimator.of(self.model, d)
            except RecordingError:
                found = None
            self._measured[id(d)] = (d, found)
        return self._measured[id(d)][1]

    def window(self, number: int, start: float, end: float) -> Window | None:
        """Return a window; None where nothing was measured in it."""
        m = self.model.scene.model
        d = self.recording.demonstrations[number]
        readings, clock, shared, count = [], [], [], 0
        for name, std in self.noise.items():
            if name not in d.measured:
                continue
            channel = d.measured[name]
            inside = (channel.time >= start - 1e-9) & (channel.time <= end + 1e-9)
            inside &= np.isfinite(channel.value).any(axis=1)
            if not inside.any():
                continue
            orientation = int(m.sensor_type[m.sensor(name).id]) in map(int, UNIT_QUATERNION_SENSORS)
            value = np.asarray(channel.value[inside], dtype=float)
            if orientation:
                value = value / np.linalg.norm(value, axis=1, keepdims=True)
            dim = 3 if orientation else value.shape[1]
            finite = np.isfinite(value)
            known = None if finite.all() else finite
            size = dim * len(value) if known is None else int(known.sum())
            time = channel.time[inside]
            whitening, stated = relative_whitening(channel, own=True), self._stated(name)
            if whitening is not None:
                own = channel.noise_std or covariance_std(channel) or std
                whitening = whitening[inside] * (stated / own)
            rows = slice(count, count + size)
            readings.append(Reading(name, rows, time - start, value, std, orientation, known, whitening))
            if whitening is not None and channel.common is not None:
                # Noise that is raised raises errors in common, too.
                shared.append((rows, readings[-1].common_in_noise(channel.common[inside] * (std / stated))))
            clock.append(np.repeat(time, dim if known is None else known.sum(axis=1)))
            count += size
        if not count:
            return None
        state, noise = self.state(d, start), {r.channel: r.std for r in readings}
        spread = start_spread(m, noise, self.cfg, measured=None if state.measured.all() else state.measured)
        if start > 0.0 and not state.measured.all() and self.guided(d) is not None:
            spread = np.where(np.tile(state.measured, 2), spread, np.minimum(spread, self._known(m.nv)))
        clocks = np.concatenate(clock)
        found = Window(d, number, start, end, state.qpos, state.qvel, spread, tuple(readings), count, clocks)
        if not shared:
            return found
        common, column = np.zeros((count, sum(part.shape[1] for _, part in shared))), 0
        for rows, part in shared:
            common[rows, column : column + part.shape[1]] = part
            column += part.shape[1]
        return replace(found, common=common, scatter=NumericalScatter(common))

    def _stated(self, name: str) -> float:
        """Return the noise of a channel with covariances as the recording states it, that of all demonstrations."""
        channels = [d.measured[name] for d in self.recording.demonstrations if name in d.measured]
        stated = [std for c in channels if (std := c.noise_std or covariance_std(c))]
        return float(np.sqrt(np.mean(np.square(stated)))) if stated else self.noise[name]


def _sees_each_free_body(m: mujoco.MjModel, partial: PartialStateEstimator) -> bool:
    """Return whether bodies move freely, and of each the orientation and some of the position was measured."""
    first = m.jnt_dofadr[m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)]
    seen = [partial.measured[dof : dof + 3].any() and partial.measured[dof + 3 : dof + 6].all() for dof in first]
    return len(seen) > 0 and all(seen)


def first_time(d: Demonstration, channels: Sequence[str]) -> float:
    """Return when the first of some channels was first read [s]."""
    return min((float(d.measured[c].time[0]) for c in channels if c in d.measured), default=0.0)
