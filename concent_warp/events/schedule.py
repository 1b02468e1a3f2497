"""Plot of the contact schedule: pairs of bodies in contact over time, stages and target events."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.events.sequence import ContactEventSequence, ContactInterval, Stage
from concent_warp.files import new_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#1f2933"
GREY = "#6b7785"
BAR = {"robot": "#2a78b5", "object": "#d1592a", "world": "#a9b2bc"}
"""Colour of a bar, by whether the robot, an object or the surroundings touch the object."""
BAND = ("#e3eef7", "#fbecdf", "#e4f1e4", "#f1e7f5", "#f6f1d8")
"""Colours of the stages, in turn."""
BAR_HEIGHT = 0.56
"""Height of a bar, in rows."""
LABEL_HEIGHT = 26
"""Height of a stage's label [points]."""


def plot_schedule(sequence: ContactEventSequence, path: Path | None = None, title: str | None = None) -> Figure:
    """Return a figure of the contact schedule.

    Rows are pairs of bodies: robot links on objects, objects on objects, objects on the surroundings. A bar is a
    contact after the chatter rule; its dark part is as high as the number of pairs of spheres (or links and spheres)
    that touch, against the largest number of its row. Shaded bands are the stages; a diamond marks the pairs of bodies
    in a stage's target event, at its time.

    Args:
        sequence: The sequence to plot.
        path: Where to write the picture, in one piece or not at all; its suffix gives the format (png, svg, pdf).
        title: Title; by default the demonstration's name.
    """
    from matplotlib.figure import Figure

    rows = schedule_rows(sequence)
    figure = Figure(figsize=(10, 1.7 + 0.44 * max(len(rows), 1)), layout="constrained")
    axes = figure.add_subplot()
    for row, key in enumerate(rows):
        _draw_row(axes, sequence, row, *key)
    levels = _label_levels([stage.start for stage in sequence.stages], 0.1 * sequence.duration)
    for k, (stage, level) in enumerate(zip(sequence.stages, levels, strict=True)):
        _draw_stage(axes, stage, BAND[k % len(BAND)], level)
        _mark_event(axes, sequence, stage, rows)
    axes.set_yticks(range(len(rows)), [_row_label(sequence, *key) for key in rows], color=INK)
    axes.set_ylim(max(len(rows), 1) - 0.4, -0.6)
    axes.set_xlim(0, max(sequence.duration, sequence.timestep))
    axes.set_xlabel("time [s]", color=INK)
    axes.annotate(
        "dark: spheres in contact    ◇ target event",
        (1, 0),
        xycoords="axes fraction",
        xytext=(0, -30),
        textcoords="offset points",
        ha="right",
        color=GREY,
        fontsize=8.5,
    )
    name = title if title is not None else sequence.demonstration
    axes.set_title(name, loc="left", color=INK, fontsize=12, pad=10 + LABEL_HEIGHT * (1 + max(levels, default=-1)))
    axes.tick_params(length=0, labelsize=9.5, colors=INK)
    axes.grid(axis="x", color="white", linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color(GREY)
    if path is not None:
        with new_file(path) as partial:
            figure.savefig(partial, format=path.suffix.lstrip(".") or "png", dpi=160)
    return figure


def schedule_rows(sequence: ContactEventSequence) -> list[tuple[str, str]]:
    """Return the pairs of bodies in contact with an object, by kind of pair, then by first contact."""
    role = {entity.body: entity.role for entity in sequence.entities}
    first: dict[tuple[str, str], float] = {}
    for contact in sequence.body_contacts:
        if "object" in (role[contact.a], role[contact.b]):
            first.setdefault((contact.a, contact.b), contact.start)
    order = list(BAR)
    return sorted(first, key=lambda key: (*(order.index(role[name]) for name in key), first[key], key))


def _row_label(sequence: ContactEventSequence, a: str, b: str) -> str:
    """Return the names of two bodies; of the surroundings, the names of the geoms that are touched."""
    entity = sequence.entity
    touched = {c.b for c in sequence.contacts if (entity[c.a].body, entity[c.b].body) == (a, b)}
    fixed = sorted(name for name in touched if entity[name].role == "world")
    return f"{a} · {', '.join(fixed) if 0 < len(fixed) <= 2 else b}"


def _label_levels(starts: list[float], room: float) -> list[int]:
    """Return how high to set each label, in rows of text, so that those closer than `room` [s] do not overlap."""
    levels: list[int] = []
    for k, start in enumerate(starts):
        near = {levels[j] for j in range(k) if start - starts[j] < room}
        levels.append(next(level for level in range(k + 1) if level not in near))
    return levels


def _draw_row(axes: Axes, sequence: ContactEventSequence, row: int, a: str, b: str) -> None:
    """Draw the contacts of one pair of bodies."""
    role = {entity.body: entity.role for entity in sequence.entities}
    kind = "world" if role[b] == "world" else role[a]
    spans = [(c.start, c.end - c.start) for c in sequence.body_contacts if (c.a, c.b) == (a, b)]
    axes.broken_barh(spans, (row - BAR_HEIGHT / 2, BAR_HEIGHT), facecolor=BAR[kind], alpha=0.35, linewidth=0, zorder=2)
    entity = sequence.entity
    parts = [c for c in sequence.contacts if (entity[c.a].body, entity[c.b].body) == (a, b)]
    time, count = contact_count(parts)
    if count.any():
        low = np.full(len(time), row + BAR_HEIGHT / 2)
        top = low - BAR_HEIGHT * count / count.max()
        axes.fill_between(time, low, top, step="post", facecolor=BAR[kind], linewidth=0, zorder=2.1)


def contact_count(contacts: list[ContactInterval]) -> tuple[np.ndarray, np.ndarray]:
    """Return how many of the contacts are on from each time [s] to the next, shape (n,) each."""
    time = np.unique([t for c in contacts for t in (c.start, c.end)])
    start, end = np.sort([c.start for c in contacts]), np.sort([c.end for c in contacts])
    return time, np.searchsorted(start, time, side="right") - np.searchsorted(end, time, side="right")


def _draw_stage(axes: Axes, stage: Stage, colour: str, level: int) -> None:
    """Draw the band of one stage, with its name and start above."""
    axes.axvspan(stage.start, stage.end, color=colour, linewidth=0, zorder=0)
    axes.axvline(stage.start, color=GREY, linewidth=0.9, zorder=1)
    for text, height, style in (
        (stage.name, 13, {"color": INK, "fontsize": 10, "fontweight": "bold"}),
        (f"{stage.start:.2f} s", 3, {"color": GREY, "fontsize": 8}),
    ):
        axes.annotate(
            text,
            (stage.start, 1),
            xycoords=("data", "axes fraction"),
            xytext=(1, height + LABEL_HEIGHT * level),
            textcoords="offset points",
            **style,
        )


def _mark_event(axes: Axes, sequence: ContactEventSequence, stage: Stage, rows: list[tuple[str, str]]) -> None:
    """Mark the pairs of bodies in a target event with diamonds."""
    entity = sequence.entity
    touched = {(entity[p.a].body, entity[p.b].body) for p in stage.event.pairs}
    marked = [row for row, key in enumerate(rows) if key in touched]
    axes.plot(
        [stage.event.time] * len(marked),
        marked,
        marker="D",
        markersize=6,
        markerfacecolor="white",
        markeredgecolor=INK,
        markeredgewidth=1.2,
        linestyle=(0, (2, 2)),
        linewidth=1,
        color=INK,
        zorder=3,
    )
