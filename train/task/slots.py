"""Contact slots: a fixed number of contact pairs of each stage's target event (paper, appendix C)."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from concent_warp.events.sequence import ContactEventSequence, ContactPair, Stage
from concent_warp.kernels.contact_pairs import PairTable


def slot_table(compiled: mujoco.MjModel, events: ContactEventSequence, count: int) -> tuple[PairTable, np.ndarray]:
    """Return the contact pairs of all S stages of a sequence in `count` slots.

    Returns:
        The table, and whether side a of a slot is a robot link, shape (S, count) bool.
    """
    shape = (len(events.stages), count)
    active, robot = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    body = np.zeros((2, *shape), dtype=int)
    vectors = np.zeros((3, *shape, 3))
    for s, stage in enumerate(events.stages):
        for k, pair in enumerate(_select_pairs(events, stage, count)):
            sides = events.entity[pair.a], events.entity[pair.b]
            active[s, k] = True
            robot[s, k] = sides[0].role == "robot"
            body[:, s, k] = [compiled.body(side.body).id for side in sides]
            vectors[:, s, k] = pair.point_a, pair.point_b, pair.normal
    # The points of an event are contact points: their radii are zero.
    none = np.zeros(shape)
    return PairTable(body[0], vectors[0], none, body[1], vectors[1], none, vectors[2], active), robot


def _select_pairs(events: ContactEventSequence, stage: Stage, count: int) -> list[ContactPair]:
    """Return at most `count` pairs of a stage's target event.

    Each pair of bodies keeps one contact; the remaining slots go to the bodies whose contact starts the stage, then to
    the others. Contacts of one pair of bodies are selected by farthest point sampling from the strongest one, so that a
    few of them determine the relative pose.
    """
    groups: dict[tuple[str, str], list[ContactPair]] = {}
    for pair in stage.event.pairs:
        groups.setdefault((events.entity[pair.a].body, events.entity[pair.b].body), []).append(pair)
    ordered = {bodies: _by_spread(pairs) for bodies, pairs in groups.items()}
    robot = {e.body for e in events.entities if e.role == "robot"}
    opening = [bodies for bodies in ordered if tuple("robot" if b in robot else b for b in bodies) == stage.bodies]
    ranked = [*opening, *(bodies for bodies in ordered if bodies not in opening)]
    share = dict.fromkeys(ranked[:count], 1)
    for group in (opening, ranked):
        while room := [b for b in group if b in share and share[b] < len(ordered[b])]:
            if sum(share.values()) == count:
                break
            share[min(room, key=lambda bodies: share[bodies])] += 1
    return [pair for bodies in ranked for pair in ordered[bodies][: share.get(bodies, 0)]]


def _by_spread(pairs: Sequence[ContactPair]) -> list[ContactPair]:
    """Return pairs ordered by farthest point sampling of their target points, the strongest first."""
    points = np.array([pair.point_b for pair in pairs])
    order = [int(np.argmax([pair.force for pair in pairs]))]
    distance = np.linalg.norm(points - points[order[0]], axis=1)
    while len(order) < len(pairs):
        distance[order] = -1.0
        order.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[order[-1]], axis=1))
    return [pairs[i] for i in order]
