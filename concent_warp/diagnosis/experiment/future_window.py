"""A motion that was not recorded yet as a window with the readings to come, and what models predict of these."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.fit.effects.observation import Reading, Window, start_spread
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest, turn
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.simulate.replay import UNIT_QUATERNION_SENSORS
from concent_warp.simulate.select import EngineName


def future_window(recorded: RecordedRange, motion: ProposedMotion, duration: float) -> Window | None:
    """Return the beginning of a motion as a window to be recorded; None where nothing is measured."""
    m = recorded.m
    channels, readings, clock, count = recorded.channels(motion.away), [], [], 0
    for name in channels:
        row = m.sensor(name).id
        orientation = int(m.sensor_type[row]) in map(int, UNIT_QUATERNION_SENSORS)
        time = np.arange(0.0, duration, max(recorded.period[name], m.opt.timestep))
        value = np.zeros((len(time), int(m.sensor_dim[row])))
        dim = 3 if orientation else value.shape[1]
        rows = slice(count, count + dim * len(time))
        readings.append(Reading(name, rows, time, value, recorded.noise[name], orientation))
        clock.append(np.repeat(time, dim))
        count = rows.stop
    if not count:
        return None
    measured = {r.channel: Channel(r.time, r.value, noise_std=r.std) for r in readings}
    d = Demonstration(
        motion.name,
        qpos=motion.qpos,
        qvel=motion.qvel,
        action=motion.action,
        measured=measured,
        payloads=motion.payloads,
    )
    spread = start_spread(m, {c: recorded.noise[c] for c in channels}, recorded.observation)
    clocks = np.concatenate(clock)
    return Window(
        d, 0, 0.0, duration, motion.qpos, motion.qvel, spread, tuple(readings), count, clocks, start_shown=False
    )


def predicted_readings(model: Model, window: Window, engine: EngineName) -> list[np.ndarray]:
    """Return what instruments would read in a window from time 0, one (T, dim) for each of its readings."""
    prediction = Prediction(model, (), [window], engine=engine)
    (reader,) = prediction.readers([SimulationRequest(0, prediction.start)])
    for added in model.effects:
        if added.effect.measures:
            reader = added.effect.measure(model.scene.model, reader, added.array)
    return [reader(r.channel, r.time) for r in window.readings]


def difference_in_noise(window: Window, first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> np.ndarray:
    """Return how far two sets of readings are apart in units of noise, shape (count,)."""
    found = np.empty(window.count)
    for r, a, b in zip(window.readings, first, second, strict=True):
        found[r.rows] = r.in_noise(turn(b, a) if r.orientation else a - b)
    return found
