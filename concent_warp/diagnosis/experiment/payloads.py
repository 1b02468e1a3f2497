"""Motions with known weights: a payload on a link, or two on opposite sides of an object.

Weight and inertia then change by known amounts, which separates effects that are alike in one set-up: the mass of a
body from the gain of its drive, friction from adhesion, friction against spinning from inertia.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from concent_warp.comparison.units import channel_text
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.effects.select import driven_joints, outermost_links
from concent_warp.scene.payloads import Payload

LEVEL = 0.7
"""Largest height of an axis of unit length that counts as level [-]: 45 degrees."""


def loaded(motion: ProposedMotion, payloads: tuple[Payload, ...]) -> ProposedMotion:
    """Return a motion in which a body carries weights as well."""
    text = f"with {payload_text(payloads)}, {motion.text}"
    return replace(motion, name=f"{motion.name} with payload", text=text, payloads=(*motion.payloads, *payloads))


def payload_text(payloads: Sequence[Payload]) -> str:
    """Return what is fastened where, in words."""
    parts = [f"{p.mass:g} kg at ({', '.join(f'{x:g}' for x in p.position)}) m" for p in payloads]
    return f"{' and '.join(parts)} fastened to {channel_text(payloads[0].body)}"


def on_link(recorded: RecordedRange, link: str) -> tuple[Payload, ...]:
    """Return a weight at the centre of mass of a link."""
    m, body = recorded.m, recorded.m.body(link).id
    return (_weight(link, recorded.cfg.extra_mass * float(m.body_mass[body]), m.body_ipos[body]),)


def on_object(recorded: RecordedRange, body: int) -> tuple[Payload, ...]:
    """Return two equal weights on opposite sides of an object, at the height of its centre of mass.

    They are at the ends of the longest of its principal axes that are level as the recording begins, as long as those
    of a box of the same inertia: the weights change the moments of inertia as well as the weight.
    """
    m = recorded.m
    moment, mass = m.body_inertia[body], float(m.body_mass[body])
    half = np.sqrt(np.maximum(1.5 * (moment.sum() - 2 * moment) / max(mass, 1e-9), 0.0))
    inertial, turned = np.zeros(9), np.zeros(9)
    mujoco.mju_quat2Mat(inertial, m.body_iquat[body])
    first = int(m.jnt_qposadr[m.body_jntadr[body]])
    mujoco.mju_quat2Mat(turned, recorded.starts[0][0][first + 3 : first + 7])
    axes = inertial.reshape(3, 3)
    height = np.abs((turned.reshape(3, 3) @ axes)[2])
    chosen = int(np.argmax(np.where(height <= max(LEVEL, float(np.sort(height)[1])), half, -1.0)))
    arm = half[chosen] * axes[:, chosen]
    each = 0.5 * recorded.cfg.extra_mass * mass
    return tuple(_weight(m.body(body).name, each, m.body_ipos[body] + sign * arm) for sign in (1.0, -1.0))


def _weight(body: str, mass: float, position: np.ndarray) -> Payload:
    """Return a payload of a mass of two digits, at a place in whole millimetres."""
    x, y, z = (round(float(v), 3) + 0.0 for v in position)
    return Payload(body, float(f"{mass:.2g}"), (x, y, z))


def payload_links(recorded: RecordedRange, drives: Sequence[int]) -> list[str]:
    """Return the names of the last links that some drives, by id, carry and that can carry a payload."""
    m = recorded.m
    moved = {int(m.jnt_bodyid[j]) for a in drives for j in driven_joints(m, a)}
    return [
        m.body(b).name for b in outermost_links(m) if m.body(b).name and m.body_mass[b] > 0 and _above(m, b) & moved
    ]


def _above(m: mujoco.MjModel, body: int) -> set[int]:
    """Return the ids of a body and of those that carry it."""
    found = {0}
    while body:
        found.add(body)
        body = int(m.body_parentid[body])
    return found
