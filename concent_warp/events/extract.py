"""Extraction of the contact event sequence from the replay of a demonstration (paper, section 3.1.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from concent_warp.errors import EventsError
from concent_warp.events.adhesion import adhesion_pull
from concent_warp.events.cfg import StagingCfg
from concent_warp.events.filter import close_gaps, steps_of, true_runs
from concent_warp.events.roles import Roles
from concent_warp.events.sequence import ContactEventSequence, ContactInterval
from concent_warp.events.staging import find_stages
from concent_warp.events.target import rounded_direction, rounded_number, rounded_vector
from concent_warp.events.touches import BodyPoses, ReplayContacts
from concent_warp.simulate.replay import commands, replay, step_count

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration
    from concent_warp.scene.spheres.contact_geometry import ContactGeometry
    from concent_warp.simulate.engine import ContactLog, Engine


def extract(
    model: Model, demonstration: Demonstration, engine: Engine, cfg: StagingCfg | None = None
) -> ContactEventSequence:
    """Return the contact event sequence of a demonstration, from its replay through a model.

    Args:
        model: Scene and contact geometry.
        demonstration: Commands and initial state.
        engine: An engine for `model`.
        cfg: Settings of the filter and of the staging.

    Raises:
        EventsError: The replay does not stay finite.
    """
    rollout = replay(model, demonstration, engine, contacts="all").numpy()
    if rollout.diverged[0] or rollout.contacts is None:
        raise EventsError(
            "the replay does not stay finite, so that there are no contacts to read",
            where=demonstration.name,
            fix="shorten the time step, or check for spheres that overlap in the initial state",
        )
    roles = Roles.of(engine.compiled, model)
    steps = step_count(demonstration, engine.timestep)
    motion = BodyPoses.of(rollout, roles.bodies, engine.timestep, steps)
    pull = adhesion_pull(engine.compiled, rollout.contacts, commands(engine.compiled, demonstration, steps))
    return _from_log(rollout.contacts, roles, motion, model.geometry, name=demonstration.name, cfg=cfg, pull=pull)


def _from_log(
    log: ContactLog,
    roles: Roles,
    motion: BodyPoses,
    geometry: ContactGeometry | None = None,
    *,
    name: str = "",
    cfg: StagingCfg | None = None,
    variant: int = 0,
    pull: np.ndarray | None = None,
) -> ContactEventSequence:
    """Return the contact event sequence of one variant of a rollout.

    Args:
        log: Every contact of every step.
        roles: Names and roles of what the log's geom ids mean.
        motion: Poses of all bodies at every step.
        geometry: Spheres of the objects, where they have any.
        name: Name of the demonstration.
        cfg: Settings of the filter and of the staging.
        variant: Which variant of the log.
        pull: Force of adhesion on each contact of the log [N], shape (C,); none by default.
    """
    cfg = cfg or StagingCfg()
    everything = ReplayContacts.of(log, roles, variant, pull)
    in_contact = everything.debounced_pairs(motion.steps, motion.timestep, cfg)
    touches = everything.within(in_contact)
    used = sorted({int(i) for i in touches.entity.ravel()}, key=lambda i: roles.entities[i].name)
    return ContactEventSequence(
        demonstration=name,
        timestep=motion.timestep,
        steps=motion.steps,
        settings=cfg,
        entities=tuple(roles.entities[i] for i in used),
        body_contacts=_body_intervals(touches, in_contact, motion, roles),
        contacts=_entity_intervals(touches, in_contact, motion, roles, steps_of(cfg.max_gap, motion.timestep)),
        stages=find_stages(touches, in_contact, motion, roles, geometry, cfg),
    )


def _body_intervals(
    touches: ReplayContacts, in_contact: dict[tuple[int, int], np.ndarray], motion: BodyPoses, roles: Roles
) -> tuple[ContactInterval, ...]:
    """Return the contacts of pairs of bodies."""
    found = []
    for (a, b), touching in in_contact.items():
        names = roles.bodies[a], roles.bodies[b]
        found += _intervals(touches.between(a, b), touching, motion, names)
    return _in_order(found)


def _entity_intervals(
    touches: ReplayContacts, in_contact: dict[tuple[int, int], np.ndarray], motion: BodyPoses, roles: Roles, gap: int
) -> tuple[ContactInterval, ...]:
    """Return the contacts of pairs of entities: breaks closed, within the contacts of their bodies."""
    found = []
    order = np.lexsort((touches.step, touches.entity[:, 1], touches.entity[:, 0]))
    ordered = touches[order]
    edges = np.flatnonzero((np.diff(ordered.entity, axis=0) != 0).any(axis=1)) + 1
    for rows in np.split(np.arange(len(order)), edges) if len(order) else []:
        group = ordered[rows]
        a, b = group.body[0].tolist()
        touching = close_gaps(group.frames(motion.steps), gap) & in_contact[a, b]
        first, second = (roles.entities[i].name for i in group.entity[0])
        found += _intervals(group, touching, motion, (first, second))
    return _in_order(found)


def _intervals(
    rows: ReplayContacts, touching: np.ndarray, motion: BodyPoses, names: tuple[str, str]
) -> list[ContactInterval]:
    """Return an interval for each run of `touching` (K,) with the means of the contacts `rows` within it."""
    found = []
    for start, end in true_runs(touching):
        part = rows[(rows.step >= start) & (rows.step < end)]
        if not len(part.step):
            continue
        weight = part.force + 1e-9
        weight = weight / weight.sum()
        b = part.body[0, 1]
        found.append(
            ContactInterval(
                a=names[0],
                b=names[1],
                start=rounded_number(start * motion.timestep),
                end=rounded_number(end * motion.timestep),
                force=rounded_number(np.bincount(part.step - start, part.force).max()),
                point=rounded_vector(weight @ motion.into(b, part.step, part.point)),
                normal=rounded_direction(weight @ motion.turn_into(b, part.step, part.normal)),
            )
        )
    return found


def _in_order(found: list[ContactInterval]) -> tuple[ContactInterval, ...]:
    """Return intervals in the order of their start, then of their names."""
    return tuple(sorted(found, key=lambda item: (item.start, item.a, item.b)))
