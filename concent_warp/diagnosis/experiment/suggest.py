"""The experiment to do next: the motion in which the hypotheses that are left differ most.

Each hypothesis is a model with its parameters as the present recording has them. Every motion of a menu is simulated in
each of them, as the same instruments would see it; how far apart two predictions are is counted in units of the
instruments' noise, after what errors of the start could account for has been taken out. Cf. Hunter and Reiner, "Designs
for discriminating between two rival models", Technometrics 7, 1965.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.comparison.units import times, words
from concent_warp.diagnosis.experiment.joint_motions import drive_motions
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.diagnosis.experiment.object_motions import body_motions
from concent_warp.errors import ConcentError
from concent_warp.fit.effects.observation import ObservedRecording, Reading, Window, start_spread
from concent_warp.fit.effects.observe import channel_noises, keeps_close
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest, turn
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.simulate.replay import UNIT_QUATERNION_SENSORS
from concent_warp.simulate.select import EngineName

MOST_MODELS = 4
"""Hypotheses that are told apart; more cost too much."""
FINALISTS = 8
"""Motions that are looked at closely."""
PROBE = 0.1
"""Error of the start for which its effects are computed, in standard deviations."""
LEAST = 1.0
"""Predictions closer than this many times the noise are not worth an experiment."""


@dataclass(frozen=True)
class Experiment:
    """A motion that tells hypotheses apart."""

    motion: str
    """Which entry of the menu."""
    sentence: str
    """What to do and what it would show."""
    separation: float
    """RMS difference of the predictions of `pair` over the noise, in the channel where it is largest [-]."""
    pair: tuple[str, str]
    """The two hypotheses that it separates best."""
    channel: str
    """Channel in which they differ most."""
    separations: Mapping[tuple[str, str], float]
    """The same of every pair."""


def suggest(
    models: Mapping[str, Model], recording: Recording, engine: EngineName = "mujoco", seed: int = 0
) -> Experiment | None:
    """Return the motion in which the predictions of models differ most, None where no motion of the menu tells.

    Args:
        models: Hypotheses by name, fitted to the recording, the likeliest first.
        recording: What is known so far.
        engine: Which engine simulates.
        seed: Of the disturbances that tell how long a motion can be predicted.

    Raises:
        RecordingError: The models do not predict what was measured.
        EngineError: A model cannot be simulated.
    """
    chosen = dict(list(models.items())[:MOST_MODELS])
    if len(chosen) < 2:
        return None
    first = next(iter(chosen.values()))
    bench = RecordedRange(first, recording, channel_noises(first, recording))
    tilted = any(a.effect.name == "gravity_tilt" for model in chosen.values() for a in model.effects)
    menu = [*drive_motions(bench, tilted), *body_motions(bench, engine, tilted)]
    looked = [(_score(found), k) for k, motion in enumerate(menu) if (found := _rough(chosen, bench, motion, engine))]
    best = None
    for _, k in sorted(looked, key=lambda pair: (-pair[0], pair[1]))[:FINALISTS]:
        found = _close(chosen, bench, menu[k], engine, seed)
        if found and (best is None or _score(found) > _score(best[1])):
            best = menu[k], found
    if best is None or max(value for value, _ in best[1].values()) < LEAST:
        return None
    return _experiment(*best, first=next(iter(chosen)))


Separations = dict[tuple[str, str], tuple[float, str]]
"""How far two hypotheses differ [noise], and in which channel, by their names."""


def _score(found: Separations) -> float:
    """Return a number that is larger the better a motion tells all pairs apart: one well apart makes up for little."""
    return float(np.mean([np.log1p(value) for value, _ in found.values()]))


def _rough(
    models: Mapping[str, Model], bench: RecordedRange, motion: ProposedMotion, engine: EngineName
) -> Separations | None:
    """Return how far hypotheses differ in a motion from the very same start; None where one cannot be simulated."""
    window = _imagined(bench, motion, motion.duration)
    return None if window is None else _separations(models, motion, window, engine)


def _close(
    models: Mapping[str, Model], bench: RecordedRange, motion: ProposedMotion, engine: EngineName, seed: int
) -> Separations | None:
    """Return how far hypotheses differ in a motion whose start is known only as well as it is measured.

    It counts for as long as errors of the start have effects in proportion to them: what is chaotic tells nothing.
    """
    whole = _imagined(bench, motion, motion.duration)
    if whole is None:
        return None
    model = motion.change(bench.model)
    source = ObservedRecording(model, bench.recording, bench.noise)
    reach = keeps_close(source, whole.demonstration, 0.0, whole.end, engine, seed)
    if (window := _imagined(bench, motion, reach)) is None:
        return None
    starts = _start_effects(model, window, engine)
    return None if starts is None else _separations(models, motion, window, engine, starts)


def _start_effects(model: Model, window: Window, engine: EngineName) -> np.ndarray | None:
    """Return what an error of the start of one standard deviation does to the readings [noise], shape (count, 2 nv).

    None where a motion with such an error cannot be simulated.
    """
    values = _readings(model, window, engine)
    if not all(np.isfinite(v).all() for v in values):
        return None
    filled = tuple(replace(r, value=v) for r, v in zip(window.readings, values, strict=True))
    prediction = Prediction(model, (), [replace(window, readings=filled)], engine=engine)
    steps = PROBE * np.diag(window.spread)
    found = prediction.residuals([SimulationRequest(0, prediction.start, step) for step in steps])
    return np.stack(found, axis=1) / PROBE


def _imagined(bench: RecordedRange, motion: ProposedMotion, duration: float) -> Window | None:
    """Return the beginning of a motion as a window of a recording yet to be made; None where nothing is measured."""
    m = bench.m
    channels, readings, clock, count = bench.channels(motion.away), [], [], 0
    for name in channels:
        row = m.sensor(name).id
        orientation = int(m.sensor_type[row]) in map(int, UNIT_QUATERNION_SENSORS)
        time = np.arange(0.0, duration, max(bench.period[name], m.opt.timestep))
        value = np.zeros((len(time), int(m.sensor_dim[row])))
        dim = 3 if orientation else value.shape[1]
        rows = slice(count, count + dim * len(time))
        readings.append(Reading(name, rows, time, value, bench.noise[name], orientation))
        clock.append(np.repeat(time, dim))
        count = rows.stop
    if not count:
        return None
    measured = {r.channel: Channel(r.time, r.value, noise_std=r.std) for r in readings}
    d = Demonstration(motion.name, qpos=motion.qpos, qvel=motion.qvel, action=motion.action, measured=measured)
    spread = start_spread(m, {c: bench.noise[c] for c in channels})
    clocks = np.concatenate(clock)
    return Window(d, 0, 0.0, duration, motion.qpos, motion.qvel, spread, tuple(readings), count, clocks)


def _separations(
    models: Mapping[str, Model],
    motion: ProposedMotion,
    window: Window,
    engine: EngineName,
    starts: np.ndarray | None = None,
) -> Separations | None:
    """Return how far hypotheses differ in a motion; None where one cannot be simulated.

    Args:
        models: Hypotheses by name.
        motion: What is done.
        window: The motion as a window of a recording.
        engine: Which engine simulates.
        starts: How residuals depend on the initial state in units of its spread, shape (count, 2 nv); what it may
            account for is taken out.
    """
    try:
        seen = {name: _readings(motion.change(model), window, engine) for name, model in models.items()}
    except (ConcentError, ValueError, mujoco.FatalError):
        # A payload may not fit a scene that asks for something special of its bodies: one motion less.
        return None
    if not all(np.isfinite(value).all() for values in seen.values() for value in values):
        return None
    found: Separations = {}
    for a, b in itertools.combinations(models, 2):
        residual = _difference(window, seen[a], seen[b])
        if starts is not None:
            normal = starts.T @ starts + np.eye(starts.shape[1])
            residual = residual - starts @ np.linalg.solve(normal, starts.T @ residual)
        sizes = [(float(np.sqrt(np.mean(residual[r.rows] ** 2))), r.channel) for r in window.readings]
        found[a, b] = max(sizes)
    return found


def _readings(model: Model, window: Window, engine: EngineName) -> list[np.ndarray]:
    """Return what instruments would read in a window from time 0, one (T, dim) for each of its readings."""
    prediction = Prediction(model, (), [window], engine=engine)
    (reader,) = prediction.readers([SimulationRequest(0, prediction.start)])
    for added in model.effects:
        if added.effect.measures:
            reader = added.effect.measure(model.scene.model, reader, added.array)
    return [reader(r.channel, r.time) for r in window.readings]


def _difference(window: Window, first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> np.ndarray:
    """Return how far two sets of readings are apart in units of noise, shape (count,)."""
    found = np.empty(window.count)
    for r, a, b in zip(window.readings, first, second, strict=True):
        found[r.rows] = ((turn(b, a) if r.orientation else a - b) / r.std).ravel()
    return found


def _experiment(motion: ProposedMotion, found: Separations, first: str) -> Experiment:
    """Return the experiment, in words that tell what separates the likeliest hypothesis, `first`, from the others."""
    best = max(found, key=lambda pair: found[pair][0])
    pairs = sorted((pair for pair in found if first in pair), key=lambda pair: -found[pair][0])
    said = [f"{a} and {b} then differ by {times(found[a, b][0])} noise" for a, b in pairs[:1]]
    said += [f"{a} and {b} by {times(found[a, b][0])}" for a, b in pairs[1:]]
    separation, channel = found[best]
    sentence = f"{motion.text}: {', '.join(said)} ({words(found[pairs[0]][1])})."
    sizes = {pair: value for pair, (value, _) in found.items()}
    return Experiment(motion.name, sentence, separation, best, channel, sizes)
