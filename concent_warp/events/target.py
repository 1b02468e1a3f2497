"""Target events e_s: the contact configuration that a stage is to achieve (paper, section 3.1.2 and appendix B)."""

from __future__ import annotations

import numpy as np

from concent_warp.events.cfg import StagingCfg
from concent_warp.events.filter import steps_of, true_runs
from concent_warp.events.roles import Roles
from concent_warp.events.sequence import ContactEvent, ContactPair, Vector
from concent_warp.events.touches import BodyPoses, ReplayContacts

DECIMALS = 6
"""Decimals kept of every number of a sequence: micrometres, microseconds, micronewtons."""


def target_event(
    touches: ReplayContacts, motion: BodyPoses, roles: Roles, start: int, end: int, steady: np.ndarray, cfg: StagingCfg
) -> ContactEvent:
    """Return the target event of a stage.

    It holds the pairs of entities, robot or object on object, that touch in a window of `cfg.window`, see
    `_event_window`: of each pair of bodies those that touch for at least `cfg.min_touch_share` as long as the one that
    touches longest. Points, normals and forces are means over the window.

    Args:
        touches: Contacts after the chatter rule.
        motion: Poses at every step.
        roles: Names and roles.
        start: First step of the stage.
        end: One past its last step.
        steady: When the contact of the stage holds and so does what carries it, shape (K,) bool.
        cfg: Settings.
    """
    low, high = _event_window(start, end, steady, steps_of(cfg.window, motion.timestep), cfg.target)
    world = roles.ids("world")
    rows = touches[(touches.step >= low) & (touches.step < high) & ~np.isin(touches.body, world).any(axis=1)]
    groups = [rows[(rows.entity == pair).all(axis=1)] for pair in np.unique(rows.entity, axis=0)]
    lasting = [len(np.unique(group.step)) for group in groups]
    longest: dict[tuple[int, ...], int] = {}
    for group, count in zip(groups, lasting, strict=True):
        bodies = tuple(group.body[0].tolist())
        longest[bodies] = max(longest.get(bodies, 0), count)
    pairs = [
        _contact_pair(group, motion, roles, high - low)
        for group, count in zip(groups, lasting, strict=True)
        if count >= cfg.min_touch_share * longest[tuple(group.body[0].tolist())]
    ]
    pairs.sort(key=lambda pair: (pair.a, pair.b))
    role = {entity.name: entity.role for entity in roles.entities}
    names = sorted({name for pair in pairs for name in (pair.a, pair.b)})
    return ContactEvent(
        time=rounded_number((low + high) / 2 * motion.timestep),
        links=tuple(name for name in names if role[name] == "robot"),
        primitives=tuple(name for name in names if role[name] == "object"),
        pairs=tuple(pairs),
    )


def _event_window(start: int, end: int, steady: np.ndarray, width: int, target: str) -> tuple[int, int]:
    """Return the steps that a target event is read from, first and one past the last.

    "transition" takes the first `width` steps of the stage; "settled" takes as many of the last steady run of the stage
    that is long enough, `width` before its end, so that letting go or moving on has not begun.
    """
    spans = true_runs(steady[start:end]) + start
    if target == "transition" or not len(spans):
        return start, min(start + width, end)
    long = spans[spans[:, 1] - spans[:, 0] >= width]
    low, high = long[-1] if len(long) else spans[np.argmax(spans[:, 1] - spans[:, 0])]
    high = max(high - width, min(low + width, high))
    return int(max(low, high - width)), int(high)


def _contact_pair(rows: ReplayContacts, motion: BodyPoses, roles: Roles, steps: int) -> ContactPair:
    """Return the pair of entities that `rows` are contacts of, with means over a window of `steps`."""
    a, b = rows.body[0]
    weight = rows.force + 1e-9
    weight = weight / weight.sum()
    first, second = (roles.entities[i].name for i in rows.entity[0])
    return ContactPair(
        a=first,
        b=second,
        point_a=rounded_vector(weight @ motion.into(a, rows.step, rows.point)),
        point_b=rounded_vector(weight @ motion.into(b, rows.step, rows.point)),
        normal=rounded_direction(weight @ motion.turn_into(b, rows.step, rows.normal)),
        force=rounded_number(rows.force.sum() / steps),
    )


def rounded_number(value: float) -> float:
    """Return a number at the precision of the file, without a negative zero."""
    return round(float(value), DECIMALS) + 0.0


def rounded_vector(value: np.ndarray) -> Vector:
    """Return a vector (3,) at the precision of the file."""
    x, y, z = (rounded_number(v) for v in value)
    return x, y, z


def rounded_direction(value: np.ndarray) -> Vector:
    """Return a vector (3,) at length 1 and at the precision of the file; zero where it cancels."""
    length = np.linalg.norm(value)
    return rounded_vector(value / length if length > 1e-6 else np.zeros(3))
