"""Initial states of replays: as a recording states them, else fitted to its first readings, as in a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.fit.effects.initial_states import InitialStateCfg, InitialStateSearch
from concent_warp.fit.effects.observation import ObservationCfg, ObservedRecording, Window, first_time
from concent_warp.fit.effects.observe import channel_noises, keeps_close
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.simulate.replay import initial_state
from concent_warp.simulate.select import EngineName

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration, Recording


@dataclass(frozen=True)
class FittedStartCfg:
    """How initial states that a recording does not state are fitted."""

    length: float = 1.0
    """Readings up to this time after the first one count [s]; less where small differences grow faster. Longer than it
    takes to tell a velocity, short enough for models that are far off."""
    max_steps: int = 400_000
    """Most simulation steps for a second fit, to all readings of a demonstration [-]; with more, only the first counts.
    A second of computation."""
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
    of them: they are taken to be as the instruments show them. Measured states are smoothed first, and then fitted
    through the model with its effects, those on measurements included.

    Args:
        model: The model.
        recording: What was commanded and measured.
        engine: Which engine simulates.
        cfg: Settings.
    """
    cfg, unknown = cfg or FittedStartCfg(), [d.qpos is None or d.qvel is None for d in recording.demonstrations]
    stated = _with_true_states(model, recording)
    if not any(unknown):
        return stated
    try:
        noise = channel_noises(model, recording, cfg.observation)
    except RecordingError:  # too few readings to fit anything to
        return stated
    source = ObservedRecording(model, recording, noise, cfg.observation)
    first: list[Window] = []
    for number, d in enumerate(recording.demonstrations):
        begin, last = first_time(d, list(noise)), _last_time(d, list(noise))
        end = min(last, begin + cfg.length)
        if unknown[number] and end > begin:
            reach = end if source.measured(d) is None else keeps_close(source, d, 0.0, end, engine, 0)
            if (window := source.window(number, 0.0, min(end, max(reach, begin)))) is not None:
                first.append(window)
    if not first:
        return stated
    offsets = _fitted(model, first, [np.zeros(len(w.spread)) for w in first], engine, cfg, cfg.search.iterations)
    step, few = model.scene.model.opt.timestep, cfg.few_iterations
    for k, w in enumerate(first):
        last = _last_time(w.demonstration, list(noise))
        trials = len(w.spread) + len(cfg.search.dampings)
        if last > w.end and few * trials * last / step <= cfg.max_steps:
            whole = source.window(w.number, 0.0, last)
            if whole is not None:
                (offsets[k],) = _fitted(model, [replace(whole, spread=w.spread)], [offsets[k]], engine, cfg, few)
    starts = {w.number: _moved(model, w, o) for w, o in zip(first, offsets, strict=True)}
    demonstrations = []
    for number, d in enumerate(stated.demonstrations):
        qpos, qvel = starts.get(number, (d.qpos, d.qvel))
        demonstrations.append(
            replace(d, qpos=qpos if d.qpos is None else d.qpos, qvel=qvel if d.qvel is None else d.qvel)
        )
    return replace(stated, demonstrations=tuple(demonstrations))


def _last_time(d: Demonstration, channels: Sequence[str]) -> float:
    """Return when the last of some channels was last read [s]."""
    return max((float(d.measured[c].time[-1]) for c in channels if c in d.measured), default=0.0)


def _fitted(
    model: Model,
    windows: Sequence[Window],
    offsets: Sequence[np.ndarray],
    engine: EngineName,
    cfg: FittedStartCfg,
    iterations: int,
) -> list[np.ndarray]:
    """Return the errors of the initial states of windows, in units of their spread, each window by itself."""
    prediction = Prediction(model, (), windows, engine=engine, at_true_time=True)
    search = InitialStateSearch(prediction, cfg.search)
    return search.refined(prediction.start, offsets, range(len(windows)), iterations)[0]


def _moved(model: Model, w: Window, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted state at the start of a window, its error in units of its spread taken off."""
    m, prediction = model.scene.model, Prediction(model, (), [w], at_true_time=True)
    qpos, qvel = prediction.first_state(w, prediction.start)
    qpos, step = qpos.copy(), offset * w.spread
    mujoco.mj_integratePos(m, qpos, step[: m.nv], 1.0)
    return qpos, qvel + step[m.nv :]


def _with_true_states(model: Model, recording: Recording) -> Recording:
    """Return a recording whose stated initial states are corrected for a model's effects on measurements."""
    if not any(added.effect.misleads_start for added in model.effects):
        return recording
    m, demonstrations = model.scene.model, []
    for number, d in enumerate(recording.demonstrations):
        if d.qpos is not None or d.qvel is not None:
            none = np.zeros(0)
            w = Window(d, number, 0.0, 0.0, *initial_state(m, d), np.zeros(2 * m.nv), (), 0, none)
            prediction = Prediction(model, (), [w], at_true_time=True)
            qpos, qvel = prediction.first_state(w, prediction.start)
            d = replace(d, qpos=None if d.qpos is None else qpos, qvel=None if d.qvel is None else qvel)
        demonstrations.append(d)
    return replace(recording, demonstrations=tuple(demonstrations))
