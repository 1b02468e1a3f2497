"""Where a diagnosed model fails: the worst places of its replay, and forces that it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import TimeoutError as TooLong
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.result import finite
from concent_warp.comparison.worst_spans import WorstSpan, alike
from concent_warp.diagnosis.forces.describe import body_sentence, joint_sentence
from concent_warp.diagnosis.forces.locate import locate_forces
from concent_warp.diagnosis.forces.result import UnexplainedForces
from concent_warp.errors import ConcentError
from concent_warp.simulate.select import EngineName

if TYPE_CHECKING:
    from concent_warp.fit.effects.observation import Window
    from concent_warp.model import Model
    from concent_warp.recording.recording import Recording

MOST_PLACES = 5
"""Places that are named."""
MOST_FORCES = 3
"""Forces that are named."""


def where(
    model: Model,
    recording: Recording,
    engine: EngineName = "mujoco",
    *,
    windows: Sequence[Window] = (),
    offsets: Sequence[np.ndarray] = (),
    seconds: float = 0.0,
) -> list[dict[str, Any]]:
    """Return where a model is farthest off, then where it lacks forces.

    A place has `demonstration`, `channel`, `phase`, `start`, `end` [s], `body`, `direction`, `ratio` (error over noise)
    and `sentence`; a force the same, with the joint's name as `channel`, `ratio` (force over what noise leaves of it),
    and without a time. What does not apply is None.

    Args:
        model: The model.
        recording: What was commanded and measured.
        engine: Which engine simulates.
        windows: Windows whose initial states were fitted; replays start where those of time 0 do.
        offsets: Errors of the windows' initial states in units of their spread, one (2 nv,) a window.
        seconds: Longest that the search for forces may take; they are left out where it takes longer or fails.
    """
    started = _with_starts(model, recording, windows, offsets)
    try:
        found = compare_replays({"model": model}, started, engine).places
    except ConcentError:
        found = ()
    kept: dict[tuple, WorstSpan] = {}
    for place in found:
        kept.setdefault(alike(place), place)
    several = len(recording.demonstrations) > 1
    said = [_place_entry(p, several) for p in list(kept.values())[:MOST_PLACES]]
    if seconds > 0 and (location := _located(model, recording, engine, seconds)) is not None:
        said += _force_entries(location)[:MOST_FORCES]
    return finite(said)


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


def _place_entry(place: WorstSpan, several: bool) -> dict[str, Any]:
    """Return a place of the error; the sentence names the demonstration where there are `several`."""
    return {
        "demonstration": place.demonstration,
        "channel": place.channels[0],
        "phase": place.phase,
        "start": place.start,
        "end": place.end,
        "body": place.body,
        "direction": place.direction or None,
        "ratio": place.ratio,
        "sentence": place.sentence(demonstration=several),
    }


def _located(model: Model, recording: Recording, engine: EngineName, seconds: float) -> UnexplainedForces | None:
    """Return where forces are missing, None where that cannot be told or takes longer than `seconds`.

    In a process of its own, so that it can be stopped.
    """
    from joblib.externals.loky.process_executor import ProcessPoolExecutor

    pool = ProcessPoolExecutor(max_workers=1)
    try:
        return pool.submit(locate_forces, model, recording, engine=engine).result(timeout=seconds)
    except (ConcentError, BrokenProcessPool, TooLong, ValueError, np.linalg.LinAlgError, mujoco.FatalError):
        return None
    finally:
        pool.shutdown(wait=False, kill_workers=True)


def _force_entries(location: UnexplainedForces) -> list[dict[str, Any]]:
    """Return the forces that stand out, those farthest above noise first."""
    blank = dict.fromkeys(("demonstration", "channel", "phase", "start", "end", "body", "direction"))
    found = []
    for joint in location.joints:
        if joint.significant:
            found.append({**blank, "channel": joint.joint, "ratio": joint.ratio, "sentence": joint_sentence(joint)})
    for body in location.bodies:
        for phase in body.phases:
            if phase.significant:
                said = {"body": body.body, "phase": phase.phase, "ratio": body.ratio}
                found.append({**blank, **said, "sentence": body_sentence(body.body, phase)})
    return sorted(found, key=lambda entry: -entry["ratio"])
