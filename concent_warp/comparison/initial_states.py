"""Initial states of replays: as a recording states them, else fitted to its first readings, as in a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.fit.effects.initial_states import InitialStateCfg, InitialStateSearch
from concent_warp.fit.effects.observation import ObservationCfg, ObservedRecording, Window, first_time
from concent_warp.fit.effects.observe import channel_noises, keeps_close
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.simulate.select import EngineName

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Recording


@dataclass(frozen=True)
class FittedStartCfg:
    """How initial states that a recording does not state are fitted."""

    length: float = 1.0
    """Readings up to this time after the first one count [s]; less where small differences grow faster. Longer than it
    takes to tell a velocity, short enough for models that are far off."""
    max_steps: int = 400_000
    """Most simulation steps for a second fit, to all readings of a demonstration [-]; with more, only the first counts.
    A second of computation."""
    search: InitialStateCfg = field(default_factory=lambda: InitialStateCfg(iterations=6, restart_samples=0))
    """Search for the states."""
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    """Uncertainty of measured states."""


def with_initial_states(
    model: Model, recording: Recording, engine: EngineName = "mujoco", cfg: FittedStartCfg | None = None
) -> Recording:
    """Return a recording whose demonstrations all state where they start, as a model follows their first readings best.

    Positions and velocities that a demonstration states are kept. Measured states are smoothed first, and then fitted
    through the model with its effects, those on measurements included.

    Args:
        model: The model.
        recording: What was commanded and measured.
        engine: Which engine simulates.
        cfg: Settings.
    """
    cfg, unknown = cfg or FittedStartCfg(), [d.qpos is None or d.qvel is None for d in recording.demonstrations]
    if not any(unknown):
        return recording
    try:
        noise = channel_noises(model, recording, cfg.observation)
    except RecordingError:  # too few readings to fit anything to
        return recording
    source = ObservedRecording(model, recording, noise, cfg.observation)
    windows: list[Window] = []
    for number, d in enumerate(recording.demonstrations):
        first = first_time(d, list(noise))
        last = min(
            max((float(c.time[-1]) for n, c in d.measured.items() if n in noise), default=0.0), first + cfg.length
        )
        if not unknown[number] or last <= first:
            continue
        reach = last if source.measured(d) is None else keeps_close(source, d, 0.0, last, engine, 0)
        if (window := source.window(number, 0.0, min(last, max(reach, first)))) is not None:
            windows.append(window)
    if not windows:
        return recording
    prediction = Prediction(model, (), windows, engine=engine)
    zero = [np.zeros(len(w.spread)) for w in windows]
    search = InitialStateSearch(prediction, cfg.search)
    offsets, _, _ = search.refined(prediction.start, zero, range(len(windows)), cfg.search.iterations)
    starts = {w.number: _moved(model.scene.model, w, o) for w, o in zip(windows, offsets, strict=True)}
    demonstrations = []
    for number, d in enumerate(recording.demonstrations):
        qpos, qvel = starts.get(number, (d.qpos, d.qvel))
        demonstrations.append(
            replace(d, qpos=qpos if d.qpos is None else d.qpos, qvel=qvel if d.qvel is None else d.qvel)
        )
    return replace(recording, demonstrations=tuple(demonstrations))


def _moved(m: mujoco.MjModel, w: Window, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted state at the start of a window, its error in units of its spread taken off."""
    qpos, step = w.qpos.copy(), offset * w.spread
    mujoco.mj_integratePos(m, qpos, step[: m.nv], 1.0)
    return qpos, w.qvel + step[m.nv :]
