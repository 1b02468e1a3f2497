"""Initial states of replays: as a recording states them, else fitted to its first readings, as in a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.checks import Positive, PositiveDuration
from concent_warp.errors import RecordingError
from concent_warp.fit.effects.initial_states import InitialStateCfg, InitialStateSearch
from concent_warp.fit.effects.observation import NumericalScatter, ObservedRecording, Window, first_part, first_time
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import channel_noises, keeps_close
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.fit.effects.robust import huber, huber_limit
from concent_warp.simulate.replay import initial_state
from concent_warp.simulate.select import EngineName

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration, Recording


@dataclass(frozen=True)
class FittedStartCfg:
    """How initial states that a recording does not state are fitted, and stated ones are judged by first readings."""

    length: float = 1.0
    """Readings up to this time after the first one count [s]; less where small differences grow faster. Longer than it
    takes to tell a velocity, short enough for models that are far off."""
    first_readings: PositiveDuration = 0.05
    """Time from the first reading on over which a replay must show what was read [s]. A model that is far off follows
    later readings better from a start that these exclude, such as within a table, and then seems to fail there."""
    max_first_error: Positive = 4.0
    """Largest RMS error of a channel there over its noise [-], or that from the measured state where it is larger. Of
    replays with this noise alone, none comes near."""
    first_tolerance: Positive = 1.1
    """By what factor it may be larger than that from the measured state [-]: channels pull at a start against one
    another."""
    first_weights: tuple[Positive, ...] = (3.0, 10.0, 30.0, 100.0)
    """These readings are added once more, their noise divided by one after the other, until a replay shows them [-]."""
    max_steps: int = 400_000
    """Most simulation steps for a second fit without such weights, to all readings of a demonstration [-]; with more,
    only the first counts. A second of computation, a few with weights."""
    few_iterations: int = 3
    """Iterations of the second fit."""
    search: InitialStateCfg = field(default_factory=lambda: InitialStateCfg(iterations=6, restart_samples=0))
    """Search for the states."""
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    """Uncertainty of measured states."""


def with_initial_states(
    model: Model, recording: Recording, engine: EngineName = "mujoco", cfg: FittedStartCfg | None = None
) -> Recording:
    """Return a recording whose demonstrations all state where they start, as a model follows their first readings best.

    Positions and velocities that a demonstration states are kept, but for what the model's effects on measurements say
    of them: they are taken to be as the instruments show them, and corrected. Some recordings state the true ones,
    as of a robot that threw the body, and do not say so: where a demonstration states both positions and velocities,
    they are kept as they are if the model follows its first readings better from there (Huber's loss). Measured states
    are smoothed first, and then fitted through the model with its effects, those on measurements included.

    Args:
        model: The model.
        recording: What was commanded and measured.
        engine: Which engine simulates.
        cfg: Settings.
    """
    cfg = cfg or FittedStartCfg()
    unknown = [number for number, d in enumerate(recording.demonstrations) if not _states_all(d)]
    misled = any(added.effect.misleads_start for added in model.effects)
    if not (unknown or misled):
        return recording
    try:
        noise = channel_noises(model, recording, cfg.observation)
        source = ObservedRecording(model, recording, noise, cfg.observation)
    except RecordingError:  # too few readings to fit or to decide anything
        source = None
    stated = _with_true_states(model, recording, source, engine, cfg.length) if misled else recording
    if source is None:
        return stated
    first = [w for number in unknown if (w := _first_window(source, number, engine, cfg.length)) is not None]
    if not first:
        return stated
    fits = _StartFits(model, engine, cfg)
    offsets = fits.fitted(first)
    step, few = model.scene.model.opt.timestep, cfg.few_iterations
    for k, w in enumerate(first):
        last = _last_time(w.demonstration, list(source.noise))
        trials = len(w.spread) + len(cfg.search.dampings)
        if last > w.end and few * trials * last / step <= cfg.max_steps:
            whole = source.window(w.number, 0.0, last)
            if whole is not None:
                offsets[k] = fits.refitted(replace(whole, spread=w.spread), offsets[k])
    starts = {w.number: _moved(model, w, o) for w, o in zip(first, offsets, strict=True)}
    demonstrations = []
    for number, d in enumerate(stated.demonstrations):
        qpos, qvel = starts.get(number, (d.qpos, d.qvel))
        demonstrations.append(
            replace(d, qpos=qpos if d.qpos is None else d.qpos, qvel=qvel if d.qvel is None else d.qvel)
        )
    return replace(stated, demonstrations=tuple(demonstrations))


def _states_all(d: Demonstration) -> bool:
    """Return whether a demonstration states both positions and velocities at its start."""
    return d.qpos is not None and d.qvel is not None


def _first_window(source: ObservedRecording, number: int, engine: EngineName, length: float) -> Window | None:
    """Return the window of the first readings of a demonstration, at most of a length [s]; None for too few."""
    d, channels = source.recording.demonstrations[number], list(source.noise)
    begin = first_time(d, channels)
    end = min(_last_time(d, channels), begin + length)
    if end <= begin:
        return None
    known = _states_all(d) or source.measured(d) is not None
    reach = keeps_close(source, d, 0.0, end, engine, 0) if known else end
    return source.window(number, 0.0, min(end, max(reach, begin)))


def _last_time(d: Demonstration, channels: Sequence[str]) -> float:
    """Return when the last of some channels was last read [s]."""
    return max((float(d.measured[c].time[-1]) for c in channels if c in d.measured), default=0.0)


@dataclass(frozen=True)
class _StartFits:
    """Fits errors of the initial states of windows, in units of their spread, each window by itself."""

    model: Model
    engine: EngineName
    cfg: FittedStartCfg

    def fitted(self, windows: Sequence[Window]) -> list[np.ndarray]:
        """Return the errors of the measured states."""
        none = [np.zeros(len(w.spread)) for w in windows]
        return self._weighted_fits(windows, none, self._first_errors(windows, none), self.cfg.search.iterations)

    def refitted(self, whole: Window, offset: np.ndarray) -> np.ndarray:
        """Return the error that follows all readings of a demonstration best, found from that of the first ones."""
        before = self._first_errors([whole], [offset])
        (found,) = self._weighted_fits([whole], [offset], before, self.cfg.few_iterations)
        return found

    def _weighted_fits(
        self,
        windows: Sequence[Window],
        begin: Sequence[np.ndarray],
        before: Sequence[Mapping[str, float]],
        iterations: int,
    ) -> list[np.ndarray]:
        """Return fitted errors, first readings weighted where it takes that for a replay to show them.

        Where no weight makes a replay show them, that counts which comes nearest.

        Args:
            windows: What is fitted.
            begin: Errors from which the search begins.
            before: RMS errors of first readings by channel from there, which are allowed even if they are large.
            iterations: Most iterations.
        """
        found, pending, least = list(begin), list(range(len(windows))), [np.inf] * len(windows)
        for weight in (1.0, *self.cfg.first_weights):
            some = [self._weighted(windows[k], weight) for k in pending]
            fits = self._fit(some, [begin[k] for k in pending], iterations)
            errors = self._first_errors([windows[k] for k in pending], fits)
            for k, offset, error in zip(pending, fits, errors, strict=True):
                if (excess := self._excess(error, before[k])) < least[k]:
                    found[k], least[k] = offset, excess
            pending = [k for k in pending if least[k] > 1.0]
            if not pending:
                break
        return found

    def _head(self, w: Window) -> Window:
        """Return the part of a window with its first readings."""
        return first_part(w, float(w.clock.min()) - w.start + self.cfg.first_readings)

    def _weighted(self, w: Window, weight: float) -> Window:
        """Return a window that has its first readings once more, their noise divided by a weight above 1."""
        if weight <= 1.0:
            return w
        head, n = self._head(w), w.count
        again = tuple(
            replace(r, rows=slice(n + r.rows.start, n + r.rows.stop), std=r.std / weight) for r in head.readings
        )
        common = None if w.common is None or head.common is None else np.vstack([w.common, weight * head.common])
        return replace(
            w,
            readings=w.readings + again,
            count=n + head.count,
            clock=np.concatenate([w.clock, head.clock]),
            common=common,
            scatter=None if common is None else NumericalScatter(common),
        )

    def _fit(self, windows: Sequence[Window], offsets: Sequence[np.ndarray], iterations: int) -> list[np.ndarray]:
        """Return fitted errors."""
        prediction = Prediction(self.model, (), windows, engine=self.engine, at_true_time=True)
        search = InitialStateSearch(prediction, self.cfg.search)
        return search.refined(prediction.start, offsets, range(len(windows)), iterations)[0]

    def _first_errors(self, windows: Sequence[Window], offsets: Sequence[np.ndarray]) -> list[dict[str, float]]:
        """Return the RMS errors of first readings over their noise by channel, for each window."""
        heads = [self._head(w) for w in windows]
        prediction = Prediction(self.model, (), heads, engine=self.engine, at_true_time=True)
        trials = [SimulationRequest(k, prediction.start, o * heads[k].spread) for k, o in enumerate(offsets)]
        residuals = prediction.residuals(trials)
        return [
            {reading.channel: float(np.sqrt(np.mean(r[reading.rows] ** 2))) for reading in w.readings}
            for w, r in zip(heads, residuals, strict=True)
        ]

    def _excess(self, errors: Mapping[str, float], before: Mapping[str, float]) -> float:
        """Return the largest RMS error of first readings over what is allowed, up to 1 where all are shown [-]."""
        most, wider = self.cfg.max_first_error, self.cfg.first_tolerance
        return max((error / max(most, wider * before[channel]) for channel, error in errors.items()), default=0.0)


def _moved(model: Model, w: Window, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted state at the start of a window, its error in units of its spread taken off."""
    m, prediction = model.scene.model, Prediction(model, (), [w], at_true_time=True)
    qpos, qvel = prediction.first_state(w, prediction.start)
    qpos, step = qpos.copy(), offset * w.spread
    mujoco.mj_integratePos(m, qpos, step[: m.nv], 1.0)
    return qpos, qvel + step[m.nv :]


def _with_true_states(
    model: Model, recording: Recording, source: ObservedRecording | None, engine: EngineName, length: float
) -> Recording:
    """Return a recording whose stated initial states are corrected for a model's effects on measurements.

    Complete ones that the first readings, over a length [s], show to be true are kept; without a source, none.
    """
    m, demonstrations = model.scene.model, []
    for number, d in enumerate(recording.demonstrations):
        if d.qpos is None and d.qvel is None:
            demonstrations.append(d)
            continue
        none = np.zeros(0)
        w = Window(d, number, 0.0, 0.0, *initial_state(m, d), np.zeros(2 * m.nv), (), 0, none)
        prediction = Prediction(model, (), [w], at_true_time=True)
        qpos, qvel = prediction.first_state(w, prediction.start)
        differs = not (np.array_equal(qpos, w.qpos) and np.array_equal(qvel, w.qvel))
        if not (source and differs and _states_all(d) and _follows_unchanged(source, number, engine, length)):
            d = replace(d, qpos=None if d.qpos is None else qpos, qvel=None if d.qvel is None else qvel)
        demonstrations.append(d)
    return replace(recording, demonstrations=tuple(demonstrations))


def _follows_unchanged(source: ObservedRecording, number: int, engine: EngineName, length: float) -> bool:
    """Return whether a model follows first readings better with the stated state as the true one than as a shown one.

    A shown state is simulated from its true time on where one clock shifts all channels. The replay cannot: moved along
    its velocity to the start of the commands, the state lacks what the velocity changes by, which would count against
    it.
    """
    if (w := _first_window(source, number, engine, length)) is None:
        return False
    prediction = Prediction(source.model, (), [w, replace(w, start_shown=False)], engine=engine)
    shown, true = prediction.residuals([SimulationRequest(k, prediction.start) for k in range(2)])
    limit = huber_limit([shown, true])
    return float(huber(true, limit).sum()) < float(huber(shown, limit).sum())
