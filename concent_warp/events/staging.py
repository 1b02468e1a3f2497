"""Stages from the contact-phase transitions of a demonstration (paper, appendix B).

Each new kind of contact that involves an object opens a stage. What a kind is needs no knowledge of the task:

- the robot grasps an object ("pick"), or pushes it;
- an object touches another ("align" where the robot holds one of them);
- an object in contact goes on into the other ("insert" where that surrounds it).

A kind counts once for each object or pair of objects: losing and regaining a contact is no new one. Contacts in which
the task starts, contacts with the surroundings, and an object that rests on another's floor after entering it open no
stage. An object that enters another without touching it first gives no "align".
"""

from __future__ import annotations

from collections import Counter
from typing import get_args

import numpy as np

from concent_warp.events.cfg import StagingCfg
from concent_warp.events.grasp import robot_onsets
from concent_warp.events.insertion import object_onsets
from concent_warp.events.onset import Kind, Onset
from concent_warp.events.roles import Roles
from concent_warp.events.sequence import Stage
from concent_warp.events.target import target_event
from concent_warp.events.touches import BodyPoses, ReplayContacts
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

KINDS = get_args(Kind)
NAMED = ("pick", "align", "insert")
ROBOT = "robot"


def find_stages(
    touches: ReplayContacts,
    in_contact: dict[tuple[int, int], np.ndarray],
    motion: BodyPoses,
    roles: Roles,
    geometry: ContactGeometry | None,
    cfg: StagingCfg,
) -> tuple[Stage, ...]:
    """Return the stages with their target events.

    Args:
        touches: Contacts within `in_contact`.
        in_contact: When each pair of bodies is in contact, shape (K,) bool each.
        motion: Poses at every step.
        roles: Names and roles.
        geometry: Spheres of the objects, where they have any.
        cfg: Settings.
    """
    onsets, grasped = robot_onsets(touches, motion, roles, cfg)
    objects = set(roles.ids("object"))
    for (a, b), touching in in_contact.items():
        if a in objects and b in objects:
            carried = grasped[a] | grasped[b]
            spheres = np.zeros((0, 3))
            if geometry is not None and roles.bodies[b] in geometry.bodies:
                spheres = geometry.position[geometry.of(roles.bodies[b])]
            onsets += object_onsets(touches.between(a, b), touching, (a, b), motion, carried, spheres, cfg)
    onsets.sort(key=lambda onset: (onset.step, KINDS.index(onset.kind), _body_names(onset, roles)))
    ends = [onset.step for onset in onsets[1:]] + [motion.steps] * bool(onsets)
    names = _stage_names(onsets, roles)
    return tuple(
        Stage(
            name=name,
            start=round(onset.step * motion.timestep, 6),
            end=round(end * motion.timestep, 6),
            bodies=_body_names(onset, roles),
            event=target_event(touches, motion, roles, onset.step, end, _steady(onset, grasped), cfg),
        )
        for onset, end, name in zip(onsets, ends, names, strict=True)
    )


def _steady(onset: Onset, grasped: dict[int, np.ndarray]) -> np.ndarray:
    """Return when the contact of a stage exists and the robot still grasps what it grasped at the onset, (K,) bool."""
    active = onset.active.copy()
    for body in onset.body:
        if body is not None and grasped[body][onset.step]:
            active &= grasped[body]
    return active


def _body_names(onset: Onset, roles: Roles) -> tuple[str, str]:
    """Return the names of the two sides of an onset."""
    a, b = onset.body
    return ROBOT if a is None else roles.bodies[a], roles.bodies[b]


def _stage_names(onsets: list[Onset], roles: Roles) -> list[str]:
    """Return a name for each onset, numbered from the second of a name on."""
    count: Counter[str] = Counter()
    names = []
    for onset in onsets:
        name = onset.kind if onset.kind in NAMED else "contact " + "-".join(_body_names(onset, roles))
        count[name] += 1
        names.append(name if count[name] == 1 else f"{name} {count[name]}")
    return names
