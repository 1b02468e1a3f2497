"""Where a diagnosed model fails: the spans of its replay with the largest errors, and unexplained forces."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import TimeoutError as FutureTimeoutError
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.checks import check_settings
from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.result import finite
from concent_warp.comparison.worst_spans import WorstSpan, span_kind
from concent_warp.diagnosis.cfg import FailureCfg
from concent_warp.diagnosis.forces.describe import body_sentence, joint_sentence
from concent_warp.diagnosis.forces.locate import locate_forces
from concent_warp.diagnosis.forces.result import UnexplainedForces
from concent_warp.errors import ConcentError
from concent_warp.simulate.select import EngineName

if TYPE_CHECKING:
    from concent_warp.fit.effects.observation import Window
    from concent_warp.model import Model
    from concent_warp.recording.recording import Recording


def locate_failures(
    model: Model,
    recording: Recording,
    cfg: FailureCfg | None = None,
    *,
    engine: EngineName = "mujoco",
    windows: Sequence[Window] = (),
    offsets: Sequence[np.ndarray] = (),
) -> list[dict[str, Any]]:
    """Return the spans of time in which a model's error is largest, then the forces that it lacks.

    A span has `demonstration`, `channel`, `phase`, `start`, `end` [s], `body`, `direction`, `ratio` (RMS error over
    noise) and `sentence`; a force the same, with the joint's name as `channel`, `ratio` (RMS force over what noise
    leaves of it), and without a time. What does not apply is None.

    Args:
        model: The model.
        recording: What was commanded and measured.
        cfg: Settings; forces are left out where they take longer than `max_seconds`, or fail.
        engine: Which engine simulates.
        windows: Windows whose initial states were fitted; replays start from those at time 0.
        offsets: Errors of the windows' initial states in units of their standard deviation, one (2 nv,) a window.
    """
    cfg = cfg or FailureCfg()
    check_settings(cfg)
    started = _with_starts(model, recording, windows, offsets)
    try:
        spans = compare_replays({"model": model}, started, engine).worst_spans
    except ConcentError:
        spans = ()
    distinct: dict[tuple, WorstSpan] = {}
    for span in spans:
        distinct.setdefault(span_kind(span), span)
    several = len(recording.demonstrations) > 1
    found = [_span_entry(span, several) for span in list(distinct.values())[: cfg.max_spans]]
    if cfg.max_seconds > 0 and (forces := _unexplained_forces(model, recording, engine, cfg)) is not None:
        found += _force_entries(forces)[: cfg.max_forces]
    return finite(found)


def _with_starts(
    model: Model, recording: Recording, windows: Sequence[Window], offsets: Sequence[np.ndarray]
) -> Recording:
    """Return a recording whose demonstrations start where windows from time 0 were fitted to start."""
    m = model.scene.model
    starts = {}
    for w, offset in zip(windows, offsets, strict=True):
        if w.start > 0:
            continue
        qpos, step = w.qpos.copy(), offset * w.spread
        mujoco.mj_integratePos(m, qpos, step[: m.nv], 1.0)
        starts[w.number] = qpos, w.qvel + step[m.nv :]
    moved = []
    for number, d in enumerate(recording.demonstrations):
        qpos, qvel = starts.get(number, (d.qpos, d.qvel))
        moved.append(replace(d, qpos=qpos, qvel=qvel))
    return replace(recording, demonstrations=tuple(moved))


def _span_entry(span: WorstSpan, several: bool) -> dict[str, Any]:
    """Return the entry of a span; the sentence names the demonstration where there are `several`."""
    return {
        "demonstration": span.demonstration,
        "channel": span.channels[0],
        "phase": span.phase,
        "start": span.start,
        "end": span.end,
        "body": span.body,
        "direction": span.direction or None,
        "ratio": span.ratio,
        "sentence": span.sentence(demonstration=several),
    }


def _unexplained_forces(
    model: Model, recording: Recording, engine: EngineName, cfg: FailureCfg
) -> UnexplainedForces | None:
    """Return the forces that a model lacks, None where they cannot be estimated or take too long.

    In a process of its own, so that it can be stopped.
    """
    from joblib.externals.loky.process_executor import ProcessPoolExecutor

    pool = ProcessPoolExecutor(max_workers=1)
    try:
        return pool.submit(locate_forces, model, recording, cfg.forces, engine=engine).result(cfg.max_seconds)
    except (ConcentError, BrokenProcessPool, FutureTimeoutError, ValueError, np.linalg.LinAlgError, mujoco.FatalError):
        return None
    finally:
        pool.shutdown(wait=False, kill_workers=True)


def _force_entries(forces: UnexplainedForces) -> list[dict[str, Any]]:
    """Return the significant forces, those farthest above noise first."""
    blank = dict.fromkeys(("demonstration", "channel", "phase", "start", "end", "body", "direction"))
    found = []
    for joint in forces.joints:
        if joint.significant:
            found.append({**blank, "channel": joint.joint, "ratio": joint.ratio, "sentence": joint_sentence(joint)})
    for body in forces.bodies:
        for phase in body.phases:
            if phase.significant:
                entry = {"body": body.body, "phase": phase.phase, "ratio": body.ratio}
                found.append({**blank, **entry, "sentence": body_sentence(body.body, phase)})
    return sorted(found, key=lambda entry: -entry["ratio"])
