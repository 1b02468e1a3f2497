"""Agreement of two contact records: frames in contact, pairs of bodies, and the spheres of target events.

A simulator and a measurement share no geoms, so they are compared by bodies, on one time grid. A small error of motion
says little about contact: a fit can reach it by losing the contact, which gives an overlap near zero.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from concent_warp.errors import EventsError
from concent_warp.events.cfg import StagingCfg
from concent_warp.events.filter import debounce, steps_of
from concent_warp.events.sequence import ContactEventSequence

Pair = tuple[str, str]
"""Two body names in alphabetical order."""
Frames = Mapping[Pair, np.ndarray]
"""When pairs of bodies are in contact, shape (T,) bool each; a missing pair is never in contact."""


@dataclass(frozen=True)
class FrameOverlap:
    """Intersection over union of contact in time; 1 is perfect agreement."""

    pairs: dict[Pair, float]
    """Of each pair of bodies that is in contact in either record."""
    pooled: float
    """Over all frames and pairs together; 1 where neither record has any contact."""


@dataclass(frozen=True)
class SequenceOverlap:
    """How well two contact event sequences agree."""

    frames: FrameOverlap
    primitives: dict[str, float]
    """Intersection over union of the spheres of the target event, by stage; 0 for a stage that only one of them has."""
    links: dict[str, float]
    """The same of the robot links."""


def sorted_pair(a: str, b: str) -> Pair:
    """Return two body names in alphabetical order."""
    return (a, b) if a <= b else (b, a)


def time_grid(duration: float, period: float) -> np.ndarray:
    """Return the middles of frames of length `period` [s] that cover 0..duration [s], shape (T,)."""
    return (np.arange(max(1, int(np.ceil(duration / period - 1e-9)))) + 0.5) * period


def contact_frames(contacts: Iterable[tuple[float, str, str]], grid: np.ndarray) -> dict[Pair, np.ndarray]:
    """Return frames from a plain list of contacts.

    Args:
        contacts: Time [s] and the names of the two bodies, for every step in contact; the steps are no longer than a
            frame of the grid.
        grid: Middles of equal frames [s], shape (T,). A frame is in contact if any contact falls in it.
    """
    frames: dict[Pair, np.ndarray] = {}
    for time, a, b in contacts:
        row = _frame_of(np.array([time]), grid)[0]
        if 0 <= row < len(grid):
            frames.setdefault(sorted_pair(a, b), np.zeros(len(grid), dtype=bool))[row] = True
    return frames


def resample(frames: Frames, time: np.ndarray, grid: np.ndarray) -> dict[Pair, np.ndarray]:
    """Return frames, given at `time` (S,) [s], on another grid (T,) of equal frames no shorter than their steps."""
    row = _frame_of(time, grid)
    inside = (row >= 0) & (row < len(grid))
    result = {}
    for (a, b), touching in frames.items():
        if np.shape(touching) != np.shape(time):
            raise EventsError(
                f"contact of {a!r} and {b!r} has the wrong shape", expected=np.shape(time), found=np.shape(touching)
            )
        result[sorted_pair(a, b)] = np.bincount(row[inside & touching], minlength=len(grid)) > 0
    return result


def _frame_of(time: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the index of the frame that each time [s] falls in, shape (S,) int; outside the grid if there is none."""
    if len(grid) < 2:
        raise EventsError("the time grid is too short", expected="at least 2 frames", found=len(grid))
    period = (grid[-1] - grid[0]) / (len(grid) - 1)
    return np.floor((np.asarray(time) - grid[0]) / period + 0.5 + 1e-9).astype(int)


def sequence_frames(sequence: ContactEventSequence, grid: np.ndarray) -> dict[Pair, np.ndarray]:
    """Return the frames of a sequence at the times of a grid (T,) [s]."""
    frames: dict[Pair, np.ndarray] = {}
    for contact in sequence.body_contacts:
        touching = frames.setdefault(sorted_pair(contact.a, contact.b), np.zeros(len(grid), dtype=bool))
        touching |= (grid >= contact.start) & (grid < contact.end)
    return frames


def debounce_frames(frames: Frames, period: float, cfg: StagingCfg | None = None) -> dict[Pair, np.ndarray]:
    """Return frames of length `period` [s] after the chatter rule, as sequences have them."""
    cfg = cfg or StagingCfg()
    max_gap, shortest = steps_of(cfg.max_gap, period), steps_of(cfg.min_contact_duration, period)
    return {key: debounce(np.asarray(touching, dtype=bool), max_gap, shortest) for key, touching in frames.items()}


def iou(a: Frames, b: Frames, pairs: Iterable[Pair] | None = None) -> FrameOverlap:
    """Return the intersection over union of two contact records on the same grid.

    Args:
        a: One contact record.
        b: The other.
        pairs: Pairs to compare; all by default.
    """
    a, b = ({sorted_pair(*key): np.asarray(value, dtype=bool) for key, value in frames.items()} for frames in (a, b))
    if len({len(value) for value in (*a.values(), *b.values())}) > 1:
        raise EventsError("the contact records are not on the same time grid")
    chosen = sorted({sorted_pair(*key) for key in pairs} if pairs is not None else set(a) | set(b))
    scores: dict[Pair, float] = {}
    common = total = 0
    for key in chosen:
        one, other = a.get(key, np.zeros(1, dtype=bool)), b.get(key, np.zeros(1, dtype=bool))
        both, either = int((one & other).sum()), int((one | other).sum())
        if either:
            scores[key] = both / either
        common, total = common + both, total + either
    return FrameOverlap(scores, common / total if total else 1.0)


def overlap(a: ContactEventSequence, b: ContactEventSequence, period: float | None = None) -> SequenceOverlap:
    """Return how well two sequences agree.

    Args:
        a: One sequence.
        b: The other.
        period: Length of the frames that are compared [s]; by default the longer time step of the two.
    """
    grid = time_grid(max(a.duration, b.duration), period or max(a.timestep, b.timestep))
    events = [{stage.name: stage.event for stage in sequence.stages} for sequence in (a, b)]
    names = [stage.name for stage in a.stages] + [stage.name for stage in b.stages if stage.name not in events[0]]
    both = [name for name in names if all(name in found for found in events)]
    return SequenceOverlap(
        frames=iou(sequence_frames(a, grid), sequence_frames(b, grid)),
        primitives=dict.fromkeys(names, 0.0)
        | {name: _set_iou(events[0][name].primitives, events[1][name].primitives) for name in both},
        links=dict.fromkeys(names, 0.0)
        | {name: _set_iou(events[0][name].links, events[1][name].links) for name in both},
    )


def _set_iou(a: Iterable[str], b: Iterable[str]) -> float:
    """Return the intersection over union of two sets of names; 1 where both are empty."""
    one, other = set(a), set(b)
    return len(one & other) / len(one | other) if one | other else 1.0
