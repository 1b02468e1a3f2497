"""From a diagnosis that leaves something open to the recording that decides it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.checks import check_settings
from concent_warp.comparison.units import channel_text, ratio_text
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.experiment.future_window import future_window, predicted_readings
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.diagnosis.experiment.suggested import TimeSeries
from concent_warp.diagnosis.experiment.trajectory import motion_trajectory
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.diagnosis.suggestion.candidate import Candidate
from concent_warp.diagnosis.suggestion.cfg import SuggestCfg
from concent_warp.diagnosis.suggestion.evaluations import Evaluations, key_of
from concent_warp.diagnosis.suggestion.forecast import Forecast, courses
from concent_warp.diagnosis.suggestion.hypotheses import (
    Hypothesis,
    OpenQuestion,
    fitted_hypotheses,
    open_question,
    read_diagnosis,
)
from concent_warp.diagnosis.suggestion.limits import MotionLimits, check_workspace
from concent_warp.diagnosis.suggestion.search import Search
from concent_warp.diagnosis.suggestion.suggestion import SuggestedPair, Suggestion
from concent_warp.effects.effect import AddedEffect
from concent_warp.estimation.sensors import kind_and_unit
from concent_warp.fit.effects.fit import fit_effects
from concent_warp.fit.effects.observe import channel_noises
from concent_warp.model import Model, check_inputs
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.run_folder import make_folder, plain, versions
from concent_warp.simulate.select import EngineName

EVALUATIONS_FILE = "evaluations.jsonl"
"""Scores of motions and fits of hypotheses in the folder of an unfinished search."""
WIDENED = 4.0
"""By how much limits may be widened at most, as is taken where no motion within them decides [-]."""

Progress = Callable[[float, str], None]


def suggest(
    model: Model,
    recording: Recording,
    cfg: SuggestCfg | None = None,
    *,
    diagnosis: Diagnosis | Mapping[str, Any] | str | Path | None = None,
    diagnose_cfg: DiagnoseCfg | None = None,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    state: str | Path | None = None,
    progress: Progress | None = None,
) -> Suggestion:
    """Return the motion to record next, so that a diagnosis can decide what it leaves open.

    Args:
        model: The model that was, or is to be, diagnosed.
        recording: The data at hand.
        cfg: Settings.
        diagnosis: Of the model with this recording; its JSON object; or a file, see `read_diagnosis`. Without, the
        model
            is diagnosed first.
        diagnose_cfg: Settings of that diagnosis.
        engine: Which engine simulates motions and fits; batches of motions are for "warp" on a CUDA device, too.
        out: Motion file (``.h5``) to write, with CSV files beside it, see `Suggestion.save`; none is written where
            nothing is suggested.
        state: Folder for finished parts, from which the same call continues after an interruption.
        progress: Called with the share done, 0..1, and what is being done.

    Raises:
        ModelError: The diagnosis is of another model, or a model does not stay finite.
        RecordingError: The recording has too few readings, or does not match the model.
        ConcentError: A setting is out of bounds.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> model = cw.Model.from_recording(recording)
        >>> names = ("joint_friction", "joint_damping")
        >>> found = {"verdict": "group", "groups": [list(names)], "effects": [
        ...     {"name": name, "target": ["hinge"], "accepted": name == names[0], "step": 0, "parameters": [
        ...         {"name": parameter, "value": 0.03, "interval": [0.02, 0.04], "null": 0.0}]}
        ...     for name, parameter in zip(names, ("torque[hinge]", "damping[hinge]"))]}
        >>> suggestion = cw.suggest(model, recording, cw.SuggestCfg(method="menu"), diagnosis=found)
        >>> suggestion.found, list(suggestion.models)
        (True, ['joint_friction', 'joint_damping'])
    """
    cfg, report = cfg or SuggestCfg(), progress or _ignore
    check_settings(cfg)
    check_workspace(cfg.limits)
    check_inputs(model, recording)
    folder = None if state is None else Path(state)
    if folder is not None:
        make_folder(folder)
    begin = 0.0
    if diagnosis is None:
        begin = 0.5
        settings = replace(diagnose_cfg or DiagnoseCfg(seed=cfg.seed), explain=False)
        diagnosis = diagnose(
            model,
            recording,
            settings,
            engine=engine,
            out=None if folder is None else folder / "diagnosis",
            progress=lambda share, text: report(begin * share, f"diagnosing: {text}"),
        )
    elif isinstance(diagnosis, str | Path):
        diagnosis = read_diagnosis(Path(diagnosis), model)
    question = open_question(model, diagnosis, cfg)
    if not question.models:
        return Suggestion(question.sentence, question.sentence)
    evaluations = Evaluations(None if folder is None else folder / EVALUATIONS_FILE)
    # Fits and ratings are the same whatever they are compared for.
    settings = plain(replace(cfg, method="best"))
    identity = key_of(model.scene.xml, settings, versions(), engine, *_arrays(recording), *_carried(recording))
    scaled = lambda share, text: report(begin + (1 - begin) * share, text)  # noqa: E731
    hypotheses = _fitted(question, recording, cfg, engine, evaluations, identity, scaled)
    suggestion = _searched(question, hypotheses, recording, cfg, engine, evaluations, identity, scaled)
    if out is not None and suggestion.found:
        suggestion.save(out)
    report(1.0, "done")
    return suggestion


def _ignore(share: float, text: str) -> None:
    """Ignore progress."""
    del share, text


def _carried(recording: Recording) -> list[str]:
    """Return in words what bodies carried, nothing where they never did."""
    return [f"{d.name}: {d.payloads}" for d in recording.demonstrations if d.payloads]


def _arrays(recording: Recording) -> list[np.ndarray]:
    """Return all numbers of a recording."""
    found = []
    for d in recording.demonstrations:
        found += [a for a in (d.qpos, d.qvel) if a is not None]
        for channels in (d.action, d.measured):
            found += [array for c in channels.values() for array in (c.time, c.value)]
    return [np.ascontiguousarray(a) for a in found]


def _fitted(
    question: OpenQuestion,
    recording: Recording,
    cfg: SuggestCfg,
    engine: EngineName,
    evaluations: Evaluations,
    identity: str,
    report: Progress,
) -> list[Hypothesis]:
    """Return the hypotheses fitted to the data at hand; those that are known are not fitted again."""
    done = 0

    def fit(one: Model) -> Model:
        nonlocal done
        names = [(a.effect.name, a.effect.target, a.values) for a in one.effects]
        key, at, span = key_of(identity, "fit", names), 0.3 * done / len(question.models), 0.3 / len(question.models)
        done += 1
        if key not in evaluations.known:
            found = fit_effects(
                one,
                recording,
                cfg.fit,
                engine=engine,
                progress=lambda share, _: report(at + span * share, f"fitting hypothesis {done} to the data at hand"),
            ).model
            evaluations.add(key, [[list(a.values), [list(pair) for pair in a.intervals]] for a in found.effects])
        effects = tuple(
            AddedEffect(a.effect, tuple(values), tuple((low, high) for low, high in pairs))
            for a, (values, pairs) in zip(one.effects, evaluations.known[key], strict=True)
        )
        return replace(one, effects=effects)

    return fitted_hypotheses(question, recording, cfg, engine, fit)


def _searched(
    question: OpenQuestion,
    hypotheses: list[Hypothesis],
    recording: Recording,
    cfg: SuggestCfg,
    engine: EngineName,
    evaluations: Evaluations,
    identity: str,
    report: Progress,
) -> Suggestion:
    """Return the suggestion of a search."""
    first, observation = hypotheses[0].model, cfg.fit.observation
    noise = channel_noises(first, recording, observation)
    recorded = RecordedRange(first, recording, noise, cfg.menu, observation)
    limits = MotionLimits(recorded, cfg.limits, engine)
    readings = sum(
        int(np.isfinite(d.measured[c].value).sum()) for d in recording.demonstrations for c in noise if c in d.measured
    )

    def needed(forecast: Forecast) -> float:
        if question.parameter is not None:
            return question.needed(cfg.max_interval)
        return 0.5 * cfg.decisive * (forecast.count + readings)

    values = [(a.effect.name, a.effect.target, a.values) for h in hypotheses for a in h.model.effects]
    scored = _Prefixed(evaluations, key_of(identity, values, question.width))
    sub = lambda share, text: report(0.3 + 0.65 * share, text)  # noqa: E731
    search = Search(hypotheses, recorded, limits, cfg, engine, needed, scored, sub)
    found = search.run()
    models = {h.name: h.model for h in hypotheses}
    if found.best is None:
        why = f": the nearest one exceeds {', '.join(found.exceeded[:4])}" if found.exceeded else ""
        return Suggestion(f"No motion is within the limits{why}.", question.sentence, models=models)
    candidate, forecast = found.best
    pairs, enough = _pairs(hypotheses, forecast, needed(forecast)), needed(forecast)
    if cfg.method != "random" and not any(pair.resolved for pair in pairs):
        most = max(pairs, key=lambda pair: pair.evidence)
        return Suggestion(
            f"No motion within the limits separates {' and '.join(models)}: the best, {candidate.name}, is "
            f"expected to bring {most.evidence:.2g} nat, of {enough:.2g} needed. {_wider(most.evidence / enough)}",
            question.sentence,
            pairs=pairs,
            needed=enough,
            models=models,
        )
    report(0.98, "writing down the motion")
    return _suggestion(question, candidate, enough, pairs, hypotheses, recorded, limits, engine)


class _Prefixed(Evaluations):
    """Results of one search among those of others."""

    def __init__(self, evaluations: Evaluations, prefix: str) -> None:
        self.prefix, self.all = prefix, evaluations
        self.path = evaluations.path
        mark = len(prefix) + 1
        self.known = {key[mark:]: found for key, found in evaluations.known.items() if key.startswith(f"{prefix}:")}

    def add(self, key: str, found: Any) -> None:
        """Keep a result."""
        self.known[key] = found
        self.all.add(f"{self.prefix}:{key}", found)


def _pairs(hypotheses: list[Hypothesis], forecast: Forecast, needed: float) -> tuple[SuggestedPair, ...]:
    """Return how well each two hypotheses are distinguished."""
    return tuple(
        SuggestedPair(
            a.name,
            b.name,
            float(forecast.evidence[i, j]),
            float(forecast.separation[i, j]),
            forecast.channels[i][j],
            bool(forecast.evidence[i, j] >= needed),
        )
        for i, a in enumerate(hypotheses)
        for j, b in enumerate(hypotheses)
        if i != j
    )


def _suggestion(
    question: OpenQuestion,
    candidate: Candidate,
    needed: float,
    pairs: tuple[SuggestedPair, ...],
    hypotheses: list[Hypothesis],
    recorded: RecordedRange,
    limits: MotionLimits,
    engine: EngineName,
) -> Suggestion:
    """Return the suggestion of a candidate."""
    first = hypotheses[0]
    strongest = max(pairs, key=lambda pair: pair.evidence)
    motions = tuple(motion_trajectory(first.model, m, engine, recorded.cfg.rate) for m in candidate.motions)
    moved = courses(hypotheses, recorded, candidate.motions, engine)
    parts = [(m, c) for m, c in zip(candidate.motions, moved, strict=True) if c is not None]
    duration = sum(m.duration for m in candidate.motions)
    text = f"{candidate.text[0].upper()}{candidate.text[1:]} ({duration:.1f} s)."
    if question.parameter is not None:
        weakest = min(pair.evidence for pair in pairs)
        brings = (
            f"It is expected to narrow the interval from {100 * question.width:.0f} % to "
            f"{100 * question.narrowed(weakest):.0f} %."
        )
    else:
        brings = _brings([h.name for h in hypotheses], pairs, needed)
    sentence = (
        f"{text} {brings} The predictions of {strongest.true} and {strongest.other} differ by "
        f"{ratio_text(strongest.separation)} noise ({channel_text(strongest.channel)}), the second one refitted."
    )
    return Suggestion(
        sentence=sentence,
        question=question.sentence,
        name=candidate.name,
        source=candidate.source,
        pairs=pairs,
        needed=needed,
        motions=motions,
        texts=tuple(m.text for m in candidate.motions),
        used=limits.used(parts),
        predictions=_predictions(candidate.motions[0], hypotheses, recorded, strongest.channel, engine),
        channel=strongest.channel,
        models={h.name: h.model for h in hypotheses},
        recording=motion_recording(recorded, candidate, first.model, engine),
    )


def _wider(share: float) -> str:
    """Return what wider limits promise, in a sentence.

    Args:
        share: Evidence of the best motion within the limits over what is needed [-].
    """
    if share >= 1 / WIDENED**2:
        return "Wider limits may do."
    return (
        f"Limits {WIDENED:g} times as wide would hardly do either: evidence grows about with their square. A sensor "
        "that shows one of them apart from the other may, or a value that is measured by itself."
    )


def _brings(names: list[str], pairs: tuple[SuggestedPair, ...], needed: float) -> str:
    """Return which hypotheses a motion distinguishes, in a sentence."""
    decided = [pair for pair in pairs if pair.resolved]
    if not decided:
        most = max(pair.evidence for pair in pairs)
        return f"It is expected to decide nothing: it brings {most:.2g} nat at most, of {needed:.2g} needed."
    least = min(pair.evidence for pair in decided)
    if len(decided) == len(pairs):
        return (
            f"Whichever of {', '.join(names)} is true, it is expected to bring at least {least:.3g} nat against each "
            f"of the others, of {needed:.3g} needed."
        )
    left = sorted({tuple(sorted((p.true, p.other))) for p in pairs if not p.resolved})
    return (
        f"It is expected to decide {len(decided)} of {len(pairs)} questions, with at least {least:.3g} nat, of "
        f"{needed:.3g} needed, and to leave open {'; '.join(' or '.join(pair) for pair in left)}."
    )


def motion_recording(recorded: RecordedRange, candidate: Candidate, model: Model, engine: EngineName) -> Recording:
    """Return motions as a recording: scene, initial states and commands.

    Where nothing is commanded, as in throws, it has the readings that a model predicts in the place of measurements,
    since they tell how long a motion lasts.

    Args:
        recorded: The present recording.
        candidate: The motions.
        model: The likeliest hypothesis.
        engine: Which engine simulates.
    """
    demonstrations = []
    for k, motion in enumerate(candidate.motions):
        measured = {}
        if not motion.action and (window := future_window(recorded, motion, motion.duration)) is not None:
            seen = predicted_readings(model, window, engine)
            measured = {r.channel: Channel(r.time, v) for r, v in zip(window.readings, seen, strict=True)}
        action = {name: _within(channel, motion.duration) for name, channel in motion.action.items()}
        aside = f" (out of the way: {', '.join(motion.away)})" if motion.away else ""
        demonstrations.append(
            Demonstration(
                f"demo_{k}",
                f"{motion.text}{aside}",
                qpos=motion.qpos,
                qvel=motion.qvel,
                action=action,
                measured=measured,
                payloads=motion.payloads,
            )
        )
    return Recording(recorded.recording.scene, tuple(demonstrations), source="suggested motion")


def _within(channel: Channel, duration: float) -> Channel:
    """Return the commands up to the end of a motion, the last one repeated there."""
    value = np.asarray(channel.value, dtype=float).ravel()
    inside = channel.time < duration - 1e-9
    last = np.searchsorted(channel.time, duration + 1e-9, side="right") - 1
    return Channel(np.append(channel.time[inside], duration), np.append(value[inside], value[max(last, 0)]))


def _predictions(
    motion: ProposedMotion, hypotheses: list[Hypothesis], recorded: RecordedRange, channel: str, engine: EngineName
) -> dict[str, TimeSeries]:
    """Return what each hypothesis predicts for the readings of a channel during a motion."""
    window = future_window(recorded, motion, motion.duration)
    if window is None:
        return {}
    row = next(k for k, r in enumerate(window.readings) if r.channel == channel)
    kind, unit = kind_and_unit(recorded.m, recorded.m.sensor(channel).id)
    unit = "-" if kind == "orientation" else unit  # readings are quaternions
    time = window.readings[row].time
    return {h.name: TimeSeries(time, predicted_readings(h.model, window, engine)[row], unit) for h in hypotheses}


def suggestion_json(suggestion: Suggestion) -> str:
    """Return a suggestion as JSON text."""
    return json.dumps(suggestion.to_json(), indent=1, allow_nan=False)
