"""The experiment that best distinguishes hypotheses: the motion in which their predictions differ most.

Each hypothesis is a model with its parameters as fitted to the present recording. Every motion of a menu is simulated
in each of them, as the same sensors would measure it; the RMS difference of two predictions is taken in units of the
sensors' noise, after what errors of the initial state could account for is projected out. Cf. Hunter and Reiner,
"Designs for discriminating between two rival models", Technometrics 7, 1965.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.checks import check_settings
from concent_warp.comparison.units import channel_text, ratio_text
from concent_warp.diagnosis.experiment.cfg import SuggestExperimentCfg
from concent_warp.diagnosis.experiment.future_window import difference_in_noise, future_window, predicted_readings
from concent_warp.diagnosis.experiment.joint_motions import drive_motions
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.diagnosis.experiment.object_motions import body_motions
from concent_warp.diagnosis.experiment.suggested import SuggestedExperiment, TimeSeries
from concent_warp.diagnosis.experiment.trajectory import motion_trajectory
from concent_warp.errors import ConcentError
from concent_warp.estimation.sensors import kind_and_unit
from concent_warp.files import write_json
from concent_warp.fit.effects.observation import ObservedRecording, Window
from concent_warp.fit.effects.observe import channel_noises, keeps_close
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.model import Model, check_inputs
from concent_warp.recording.recording import Recording
from concent_warp.simulate.select import EngineName


def suggest_experiment(
    models: Mapping[str, Model],
    recording: Recording,
    cfg: SuggestExperimentCfg | None = None,
    *,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> SuggestedExperiment | None:
    """Return the motion in which the predictions of models differ most, None where no motion distinguishes them.

    Args:
        models: Hypotheses by name, fitted to the recording, the likeliest first.
        recording: What was commanded and measured.
        cfg: Settings.
        engine: Which engine simulates.
        out: JSON file for the motion with its arrays; not written where there is none.
        progress: Called with the share done, 0..1.

    Raises:
        RecordingError: The models do not predict what was measured.
        EngineError: A model cannot be simulated.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> model = cw.Model.from_recording(recording)
        >>> damped = model.add(cw.effect_class("joint_damping")("hinge"), [0.015])
        >>> rubbed = model.add(cw.effect_class("joint_friction")("hinge"), [0.03])
        >>> found = cw.suggest_experiment({"joint_damping": damped, "joint_friction": rubbed}, recording)
        >>> next(iter(found.motion.commands.values())).unit, found.separation > 5
        ('rad', True)
    """
    cfg = cfg or SuggestExperimentCfg()
    check_settings(cfg)
    chosen = dict(list(models.items())[: cfg.max_hypotheses])
    for model in chosen.values():
        check_inputs(model, recording)
    if len(chosen) < 2:
        return None
    first = next(iter(chosen.values()))
    noise = channel_noises(first, recording, cfg.observation)
    recorded = RecordedRange(first, recording, noise, cfg.menu, cfg.observation)
    tilted = any(a.effect.name == "gravity_tilt" for model in chosen.values() for a in model.effects)
    menu = [*drive_motions(recorded, tilted), *body_motions(recorded, engine, tilted)]
    report, count = progress or _ignore, len(menu) + cfg.finalists
    ranked = []
    for k, motion in enumerate(menu):
        if found := _known_start_separations(chosen, recorded, motion, engine):
            ranked.append((_score(found), k))
        report((k + 1) / count)
    best = None
    for i, (_, k) in enumerate(sorted(ranked, key=lambda pair: (-pair[0], pair[1]))[: cfg.finalists]):
        found = _uncertain_start_separations(chosen, recorded, menu[k], engine, cfg)
        if found and (best is None or _score(found) > _score(best[1])):
            best = menu[k], found
        report((len(menu) + i + 1) / count)
    report(1.0)
    if best is None or max(value for value, _ in best[1].values()) < cfg.min_separation:
        return None
    experiment = _experiment(*best, chosen, recorded, engine)
    if out is not None:
        write_json(Path(out), experiment.to_json())
    return experiment


def _ignore(share: float) -> None:
    """Ignore the progress."""
    del share


Separations = dict[tuple[str, str], tuple[float, str]]
"""RMS difference of two hypotheses over the noise [-], and the channel where it is largest, by their names."""


def _score(found: Separations) -> float:
    """Return a score that grows with all separations, each with diminishing returns."""
    return float(np.mean([np.log1p(value) for value, _ in found.values()]))


def _known_start_separations(
    models: Mapping[str, Model], recorded: RecordedRange, motion: ProposedMotion, engine: EngineName
) -> Separations | None:
    """Return how far hypotheses differ in a motion from the very same start; None where one cannot be simulated."""
    window = future_window(recorded, motion, motion.duration)
    return None if window is None else _separations(models, motion, window, engine)


def _uncertain_start_separations(
    models: Mapping[str, Model],
    recorded: RecordedRange,
    motion: ProposedMotion,
    engine: EngineName,
    cfg: SuggestExperimentCfg,
) -> Separations | None:
    """Return how far hypotheses differ in a motion whose start is known only as well as it is measured.

    Over the time in which errors of the start have proportional effects: chaotic motion cannot be predicted.
    """
    whole = future_window(recorded, motion, motion.duration)
    if whole is None:
        return None
    model = motion.change(recorded.model)
    source = ObservedRecording(model, recorded.recording, recorded.noise, cfg.observation)
    reach = keeps_close(source, whole.demonstration, 0.0, whole.end, engine, cfg.seed)
    if (window := future_window(recorded, motion, reach)) is None:
        return None
    starts = _start_effects(model, window, engine, cfg.probe)
    return None if starts is None else _separations(models, motion, window, engine, starts)


def _start_effects(model: Model, window: Window, engine: EngineName, probe: float) -> np.ndarray | None:
    """Return the change of the readings per standard deviation of the start, over the noise, shape (count, 2 nv).

    None where a motion with such an error cannot be simulated.

    Args:
        model: The model.
        window: The motion.
        engine: Which engine simulates.
        probe: Step of the finite difference [standard deviations].
    """
    values = predicted_readings(model, window, engine)
    if not all(np.isfinite(v).all() for v in values):
        return None
    filled = tuple(replace(r, value=v) for r, v in zip(window.readings, values, strict=True))
    prediction = Prediction(model, (), [replace(window, readings=filled)], engine=engine)
    steps = probe * np.diag(window.spread)
    found = prediction.residuals([SimulationRequest(0, prediction.start, step) for step in steps])
    return np.stack(found, axis=1) / probe


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
        motion: The motion.
        window: The same as a window.
        engine: Which engine simulates.
        starts: Dependence of the residuals on the initial state in units of its standard deviation, shape
            (count, 2 nv), which is projected out.
    """
    try:
        seen = {name: predicted_readings(motion.change(model), window, engine) for name, model in models.items()}
    except (ConcentError, ValueError, mujoco.FatalError):
        # A payload may break a rule of the scene on its bodies; the motion is left out.
        return None
    if not all(np.isfinite(value).all() for values in seen.values() for value in values):
        return None
    found: Separations = {}
    for a, b in itertools.combinations(models, 2):
        residual = difference_in_noise(window, seen[a], seen[b])
        if starts is not None:
            normal = starts.T @ starts + np.eye(starts.shape[1])
            residual = residual - starts @ np.linalg.solve(normal, starts.T @ residual)
        sizes = [(float(np.sqrt(np.mean(residual[r.rows] ** 2))), r.channel) for r in window.readings]
        found[a, b] = max(sizes)
    return found


def _experiment(
    motion: ProposedMotion,
    found: Separations,
    models: Mapping[str, Model],
    recorded: RecordedRange,
    engine: EngineName,
) -> SuggestedExperiment:
    """Return the experiment, with a sentence on what distinguishes the likeliest hypothesis from the others."""
    first = next(iter(models))
    best = max(found, key=lambda pair: found[pair][0])
    pairs = sorted((pair for pair in found if first in pair), key=lambda pair: -found[pair][0])
    differ = [f"{a} and {b} then differ by {ratio_text(found[a, b][0])} noise" for a, b in pairs[:1]]
    differ += [f"{a} and {b} by {ratio_text(found[a, b][0])}" for a, b in pairs[1:]]
    separation, channel = found[best]
    return SuggestedExperiment(
        name=motion.name,
        sentence=f"{motion.text}: {', '.join(differ)} ({channel_text(found[pairs[0]][1])}).",
        separation=separation,
        pair=best,
        channel=channel,
        separations={pair: value for pair, (value, _) in found.items()},
        motion=motion_trajectory(models[first], motion, engine, recorded.cfg.rate),
        predictions=_predictions(motion, models, recorded, channel, engine),
    )


def _predictions(
    motion: ProposedMotion, models: Mapping[str, Model], recorded: RecordedRange, channel: str, engine: EngineName
) -> dict[str, TimeSeries]:
    """Return what each hypothesis predicts for the readings of a channel during a motion."""
    window = future_window(recorded, motion, motion.duration)
    assert window is not None
    (k,) = [i for i, r in enumerate(window.readings) if r.channel == channel]
    kind, unit = kind_and_unit(recorded.m, recorded.m.sensor(channel).id)
    unit = "-" if kind == "orientation" else unit  # readings are quaternions
    return {
        name: TimeSeries(window.readings[k].time, predicted_readings(motion.change(model), window, engine)[k], unit)
        for name, model in models.items()
    }
