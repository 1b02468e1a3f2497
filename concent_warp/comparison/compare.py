"""Models against measurements: how far off each one is, by channel, phase and time, and what a change has gained."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from concent_warp.checks import check_settings
from concent_warp.comparison.bootstrap import BootstrapCfg
from concent_warp.comparison.contact_names import ContactPartners
from concent_warp.comparison.initial_states import with_initial_states
from concent_warp.comparison.phases import MotionPhaseCfg, Phase, StageLike, has_task, phases_by_body, stage_phases
from concent_warp.comparison.residuals import ResidualCfg, instrument_noise, residuals
from concent_warp.comparison.result import Comparison
from concent_warp.comparison.tolerances import ToleranceCfg, tolerance_ranges
from concent_warp.comparison.worst_spans import WorstSpanCfg, find_worst_spans, rank_worst_spans
from concent_warp.errors import EventsError, ModelError, RecordingError
from concent_warp.events.extract_events import events_of
from concent_warp.files import write_json
from concent_warp.model import Model, check_inputs
from concent_warp.simulate.replay import commands, replay
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.events.sequence import ContactEventSequence
    from concent_warp.recording.recording import Recording


@dataclass(frozen=True)
class CompareCfg:
    """Settings of a comparison.

    Example:
        >>> import concent_warp as cw
        >>> cw.CompareCfg(phases="motion").phases
        'motion'
    """

    phases: Literal["auto", "motion", "none"] = "auto"
    """How time is divided: "auto" takes the contact stages of a task found in the replay of the last model and, where
    there are none, phases of motion (free flight, impact, sliding, ...); "none" does not divide it."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations to compare on; all where empty."""
    seed: int = 0
    """Seed of the bootstrap."""
    bootstrap: BootstrapCfg = field(default_factory=BootstrapCfg)
    """Settings of the intervals of mean errors."""
    motion_phases: MotionPhaseCfg = field(default_factory=MotionPhaseCfg)
    """Settings of the phases of motion."""
    residuals: ResidualCfg = field(default_factory=ResidualCfg)
    """Settings of the residuals."""
    tolerances: ToleranceCfg = field(default_factory=ToleranceCfg)
    """Settings of what ordinary errors of nominal values would leave."""
    worst_spans: WorstSpanCfg = field(default_factory=WorstSpanCfg)
    """Settings of the search for spans of large error."""


def compare(
    models: Model | Mapping[str, Model],
    recording: Recording,
    cfg: CompareCfg | None = None,
    *,
    events: Mapping[str, ContactEventSequence] | None = None,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Comparison:
    """Replay demonstrations in one or more models and compare what they predict with what was measured.

    Each model keeps its own time step, integrator and solver.

    Args:
        models: A model, or several by name, the baseline first.
        recording: What was commanded and measured.
        cfg: Settings.
        events: Contact event sequences by demonstration, whose stages divide the time; extracted from the replay of the
            last model by default.
        engine: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device; single replays are fastest in
            C MuJoCo.
        out: JSON file for all figures, SI units.
        progress: Called with the share done, 0..1.

    Raises:
        ModelError: There is no model, or a model is of another robot than the recording.
        RecordingError: There is no such demonstration, or it measures nothing, or what a model does not; or the
            recording contradicts itself or its scene.
        EngineError: A model cannot be simulated.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> model = cw.Model.from_recording(recording)
        >>> better = model.add_effect("joint_friction", values={"torque[hinge]": 0.03})
        >>> comparison = cw.compare({"before": model, "after": better}, recording)
        >>> comparison.difference("hinge_position").verdict
        'fallen'
    """
    cfg = cfg or CompareCfg()
    check_settings(cfg)
    named = dict(models) if isinstance(models, Mapping) else {"model": models}
    for model in named.values():
        check_inputs(model, recording)
    chosen = recording.only(cfg.demonstrations)
    remarks: tuple[str, ...] = ()
    if events is None and cfg.phases == "auto" and named:
        try:
            last = list(named.values())[-1]
            events = events_of(last, with_initial_states(last, chosen, engine), engine=engine)
        except EventsError as error:
            remarks = (f"No contact stages: {error}",)
    stages = {name: sequence.stages for name, sequence in (events or {}).items()}
    moving = cfg.phases != "none" and not has_task(stages)
    found = compare_replays(
        named,
        chosen,
        engine,
        phases=None if moving else stages,
        seed=cfg.seed,
        bootstrap=cfg.bootstrap,
        motion_cfg=cfg.motion_phases,
        residual_cfg=cfg.residuals,
        span_cfg=cfg.worst_spans,
        tolerance_cfg=cfg.tolerances,
        progress=progress,
    )
    found = replace(found, events=events or {}, remarks=remarks)
    if out is not None:
        write_json(Path(out), found.to_json())
    return found


def compare_replays(
    models: Mapping[str, Model],
    recording: Recording,
    engine: EngineName = "mujoco",
    *,
    phases: Mapping[str, Sequence[StageLike]] | None = None,
    demonstrations: Sequence[str] | None = None,
    seed: int = 0,
    bootstrap: BootstrapCfg | None = None,
    motion_cfg: MotionPhaseCfg | None = None,
    residual_cfg: ResidualCfg | None = None,
    span_cfg: WorstSpanCfg | None = None,
    tolerance_cfg: ToleranceCfg | None = None,
    progress: Callable[[float], None] | None = None,
) -> Comparison:
    """Replay demonstrations in each model and compare what it predicts with what was measured.

    Each model keeps its own time step, integrator and solver.

    Args:
        models: One or more models by name, the baseline first.
        recording: What was commanded and measured.
        engine: Which engine simulates, see `make_engine`.
        phases: Contact stages by demonstration, as a contact event sequence has them; the same for every model. Where
            there is none in any demonstration, time is not divided. None takes the phases of motion in the replay of
            the last model instead (`phases_by_body`).
        demonstrations: Names of those to compare on; None takes all.
        seed: Seed of the bootstrap.
        bootstrap: Settings of the intervals of mean errors.
        motion_cfg: Settings of the phases of motion.
        residual_cfg: Settings of the residuals.
        span_cfg: Settings of the search for spans of large error.
        tolerance_cfg: Settings of what ordinary errors of the last model's nominal values would leave; None to leave
            that out.
        progress: Called with the share done, 0..1.

    Raises:
        ModelError: There is no model.
        RecordingError: There is no such demonstration, or it measures nothing, or what a model does not.
        EngineError: A model cannot be simulated.
    """
    if not models:
        raise ModelError("there is no model to compare")
    chosen = recording.only(demonstrations or ()).demonstrations
    span_cfg = span_cfg or WorstSpanCfg()
    found, diverged, partners = {}, {}, {}
    moving: dict[str, dict[str | None, tuple[Phase, ...]]] = {}
    last, tolerances = tuple(models)[-1], {}
    report = progress or (lambda _: None)
    whole = len(models) + (tolerance_cfg.draws if tolerance_cfg is not None else 0)
    for name, model in models.items():
        simulator = make_engine(engine, model)
        compiled = model.compile()
        noise = instrument_noise(compiled, recording.demonstrations)
        begun = with_initial_states(model, replace(recording, demonstrations=chosen), engine).demonstrations
        for d in begun:
            rollout = replay(model, d, simulator, contacts="all" if name == last else "none").numpy()
            found[name, d.name] = residuals(compiled, rollout, d, noise, model.effects, residual_cfg)
            if rollout.diverged[0]:
                bad = ~np.isfinite(rollout.qpos[0]).all(axis=1)
                diverged[name, d.name] = float(rollout.time[np.argmax(bad)] if bad.any() else rollout.time[-1])
            if name == last:
                partners[d.name] = ContactPartners.of_replay(model, compiled, rollout)
                ctrl = commands(compiled, d, len(rollout.step) - 1)
                moving[d.name] = phases_by_body(model, compiled, rollout, motion_cfg, ctrl)
            report(len(found) / (whole * len(chosen)))
        if name == last and tolerance_cfg is not None:
            mine = {d.name: found[last, d.name] for d in begun}
            replayed = len(models) / whole
            tolerances = tolerance_ranges(
                model,
                begun,
                mine,
                noise,
                engine,
                tolerance_cfg,
                residual_cfg,
                seed,
                lambda share, done=replayed: report(done + (1 - done) * share),
            )
    if not any(found.values()):
        raise RecordingError("nothing was measured that could be compared with a model", where=recording.source)
    staged = phases or {}
    if any(map(len, staged.values())):
        moving = {d.name: {None: stage_phases(staged[d.name], d.duration)} for d in chosen if d.name in staged}
    elif phases is not None:
        moving = {}
    spans = {name: by_body[None] for name, by_body in moving.items()}
    worst = [
        span
        for d in chosen
        for span in find_worst_spans(
            found[last, d.name], moving.get(d.name, {None: ()}), partners[d.name], d.name, span_cfg
        )
    ]
    report(1.0)
    return Comparison(
        models=dict(models),
        demonstrations=tuple(d.name for d in chosen),
        residuals=found,
        phases=spans,
        diverged=diverged,
        seed=seed,
        bootstrap=bootstrap or BootstrapCfg(),
        worst_spans=rank_worst_spans(worst, span_cfg),
        tolerances=tolerances,
        span_cfg=span_cfg,
        staged=phases is not None,
    )
