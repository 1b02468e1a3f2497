"""What the page's scripts draw: errors over time, contact schedules, motions and spheres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.comparison.initial_states import with_initial_states
from concent_warp.comparison.result import Comparison
from concent_warp.comparison.units import DISPLAY_UNITS, channel_text, unit_text
from concent_warp.comparison.worst_spans import WorstSpan, whole_rows
from concent_warp.events.schedule import contact_count, schedule_rows
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.recording.recording import Recording
from concent_warp.report.headline import headline_channel
from concent_warp.report.motion_data import motion_data
from concent_warp.report.opening import first_demonstration, openings
from concent_warp.report.scene_data import geometry_data, packed, scene_bodies
from concent_warp.report.worst_spans import numbered_spans
from concent_warp.simulate.replay import initial_state
from concent_warp.simulate.select import make_engine

if TYPE_CHECKING:
    from concent_warp.fit.geometry.search import FitResult
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration

MOST_SAMPLES = 3000
"""Samples of a line in a chart; longer series are thinned, each piece shown by its largest error."""
PHASE_COLOURS = 5
"""Colours of phases that the style sheet has."""


def page_data(
    models: Mapping[str, Model],
    demonstrations: Sequence[Demonstration],
    comparison: Comparison,
    events: Mapping[str, ContactEventSequence],
    fit: FitResult | None,
) -> dict[str, Any]:
    """Return what the page's scripts draw."""
    last = models[comparison.after]
    bodies, meshes = scene_bodies(last.scene.model)
    names = [body["name"] for body in bodies]
    engines = {name: make_engine("mujoco", model) for name, model in models.items()}
    opened = openings(comparison, [d.name for d in demonstrations])
    begun = {
        name: with_initial_states(model, Recording(model.scene.xml, tuple(demonstrations))).demonstrations
        for name, model in models.items()
    }
    found = [
        {
            "name": d.name,
            "duration": d.duration,
            "measured_until": max((float(c.time[-1]) for c in [*d.measured.values(), *d.points.values()]), default=0.0),
            "phases": _phase_bands(comparison, d),
            "channels": _channel_lines(comparison, d.name),
            "schedule": _schedule_data(events[d.name]) if d.name in events else None,
            "motion": motion_data(models, engines, d, names, {name: of[k] for name, of in begun.items()}),
            "opening": {"channel": opened[d.name].channel, "time": opened[d.name].time},
        }
        for k, d in enumerate(demonstrations)
    ]
    return {
        "models": [{"name": name, "kind": kind_of(comparison, name)} for name in comparison.models],
        "shown": list(models),
        "first": first_demonstration(opened),
        "bodies": [{"name": body["name"], "geoms": body["geoms"]} for body in bodies],
        "meshes": meshes,
        "geometry": geometry_data(models, events),
        "demonstrations": found,
        "history": [] if fit is None else fit.history,
        "view": camera_views(last, demonstrations[0]),
        "places": [_place_data(comparison, number, place) for number, place in numbered_spans(comparison)],
    }


def _place_data(comparison: Comparison, number: int, place: WorstSpan) -> dict[str, Any]:
    """Return what the page shows of a place: where it is in time and on which body, and which way it points."""
    found = [comparison.residual(comparison.after, place.demonstration, channel) for channel in place.channels]
    shift = next((r for r in found if r is not None and r.kind in ("position", "points")), None)
    arrow = None
    if shift is not None:
        within = whole_rows(shift.value[(shift.time >= place.start) & (shift.time <= place.end)])
        arrow = within.mean(axis=0).tolist() if len(within) else None
    return {
        "number": number,
        "demonstration": place.demonstration,
        "channels": list(place.channels),
        "body": place.body,
        "start": place.start,
        "end": place.end,
        "peak": place.peak,
        "point": place.point,
        "arrow": arrow,
    }


def _phase_bands(comparison: Comparison, demonstration: Demonstration) -> list[dict[str, Any]]:
    """Return the phases of a demonstration with the number of their colour."""
    found = []
    for phase in comparison.phases.get(demonstration.name, ()):
        start, end = max(phase.start, 0.0), min(phase.end, demonstration.duration + 1e-6)
        colour = comparison.phase_names.index(phase.name)
        found.append(
            {"name": phase.name, "start": start, "end": end, "band": (colour - 1) % PHASE_COLOURS + 1 if colour else 0}
        )
    return found


def _channel_lines(comparison: Comparison, demonstration: str) -> list[dict[str, Any]]:
    """Return the errors of every channel of a demonstration over time."""
    found = []
    for channel in ordered_channels(comparison):
        residuals = {model: comparison.residual(model, demonstration, channel) for model in comparison.models}
        first = residuals[comparison.before]
        if first is None:
            continue
        pieces = np.array_split(np.arange(len(first.time)), min(len(first.time), MOST_SAMPLES))
        errors = {model: r.error for model, r in residuals.items() if r is not None}
        found.append(
            {
                "name": channel,
                "unit": unit_text(first.unit),
                "factor": DISPLAY_UNITS.get(first.unit, (1.0, first.unit))[0],
                "noise": first.noise,
                "words": channel_text(channel),
                "time": packed(np.array([first.time[rows[0]] for rows in pieces])),
                "errors": {model: packed(np.array([e[rows].max() for rows in pieces])) for model, e in errors.items()},
            }
        )
    return found


def _schedule_data(sequence: ContactEventSequence) -> dict[str, Any]:
    """Return rows, bars, stages and target events of a contact schedule."""
    entity = sequence.entity
    role = {e.body: e.role for e in sequence.entities}
    rows, keys = [], schedule_rows(sequence)
    for a, b in keys:
        parts = [c for c in sequence.contacts if (entity[c.a].body, entity[c.b].body) == (a, b)]
        time, count = contact_count(parts)
        rows.append(
            {
                "label": f"{a} · {b}",
                "kind": "world" if role[b] == "world" else role[a],
                "bars": [[c.start, c.end] for c in sequence.body_contacts if (c.a, c.b) == (a, b)],
                "count": [[round(float(t), 4), int(n)] for t, n in zip(time, count, strict=True)],
            }
        )
    targets, stages = [], []
    for stage in sequence.stages:
        touched = {(entity[p.a].body, entity[p.b].body) for p in stage.event.pairs}
        marked = [i for i, key in enumerate(keys) if key in touched]
        targets.append({"name": stage.name, "time": stage.event.time, "rows": marked})
        stages.append(
            {
                "name": stage.name,
                "start": stage.start,
                "end": stage.end,
                "bodies": list(stage.bodies),
                "links": list(stage.event.links),
                "primitives": len(stage.event.primitives),
                "pairs": len(stage.event.pairs),
            }
        )
    return {"rows": rows, "targets": targets, "stages": stages}


def camera_views(model: Model, demonstration: Demonstration) -> dict[str, Any]:
    """Return where the camera of the replay may stand: before the whole scene, or with an object.

    Distances follow from the sizes of the objects and from how far apart they are at the start.
    """
    compiled = model.scene.model
    data = mujoco.MjData(compiled)
    data.qpos[:] = initial_state(compiled, demonstration)[0]
    mujoco.mj_kinematics(compiled, data)
    objects = {name: compiled.body(name).id for name in model.scene.objects() if name}
    moving = [i for i in range(1, compiled.nbody) if compiled.body_weldid[i] != 0] or list(range(1, compiled.nbody))
    objects = objects or {compiled.body(i).name or f"body{i}": i for i in moving}
    size = {name: _extent(compiled, i) for name, i in objects.items()}
    places = np.array([data.xpos[i] for i in objects.values()])
    spread = float(np.linalg.norm(np.ptp(places, axis=0))) + max(size.values())
    return {
        "scene": {"target": places.mean(axis=0).tolist(), "distance": 3.5 * spread},
        "bodies": {name: {"distance": 10 * size[name]} for name in objects},
        "azimuth": -0.75,
        "elevation": 0.45,
    }


def _extent(compiled: mujoco.MjModel, body: int) -> float:
    """Return the radius of a ball about a body's frame that holds its geoms [m]; 0.05 where it has none."""
    mine = (compiled.geom_bodyid == body) & (compiled.geom_rbound > 0)
    if not mine.any():
        return 0.05
    return float((np.linalg.norm(compiled.geom_pos[mine], axis=1) + compiled.geom_rbound[mine]).max())


def ordered_channels(comparison: Comparison) -> list[str]:
    """Return the channels with the headline one first."""
    main = headline_channel(comparison)
    return [main, *(channel for channel in comparison.channels if channel != main)]


def kind_of(comparison: Comparison, model: str) -> str:
    """Return the style of a model's line."""
    if model == comparison.after:
        return "after"
    return "before" if model == comparison.before else "null"
