"""What a body touches in a replay, by name and place: "box, +x +z edge"."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.checks import Share
from concent_warp.events.roles import Roles
from concent_warp.events.touches import BodyPoses, ReplayContacts

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.simulate.engine import Rollout

ROLE_ORDER = {"object": 0, "robot": 1, "world": 2}


@dataclass(frozen=True)
class ContactNameCfg:
    """Settings of the naming of contacts."""

    max_names: int = 2
    """Most partners named at a time."""
    min_force_share: Share = 0.1
    """Share of the forces on a body below which a partner is not named, unless it is another object [-]: a gripper
    presses harder than what the object is brought against."""
    min_time_share: Share = 0.15
    """Share of a span below which a contact is not named [-]."""
    side_share: Share = 0.85
    """Share of the half extent of a body beyond which a point lies on its side [-]."""


@dataclass(frozen=True)
class ContactPartner:
    """What a body touches over a span of time."""

    names: tuple[str, ...]
    """Objects first, then the robot, then the surroundings."""
    point: tuple[float, float, float]
    """Mean contact point with the first of them [m], in the frame of the body."""


@dataclass(frozen=True)
class ContactPartners:
    """Who touches whom in a replay."""

    compiled: mujoco.MjModel
    roles: Roles
    motion: BodyPoses
    touches: ReplayContacts
    spheres: frozenset[str]
    """Names of the geoms that are spheres of a contact geometry: a place on the body says more than their numbers."""
    cfg: ContactNameCfg = field(default_factory=ContactNameCfg)
    """Settings."""

    @staticmethod
    def of_replay(model: Model, compiled: mujoco.MjModel, rollout: Rollout) -> ContactPartners | None:
        """Read a replay; None where it did not stay finite or recorded no contacts.

        Args:
            model: The model.
            compiled: The same as the engine compiled it.
            rollout: One variant, NumPy, all steps and bodies recorded, contacts "all".
        """
        steps = len(rollout.step) - 1
        if rollout.diverged[0] or rollout.contacts is None or steps < 1:
            return None
        roles = Roles.of(compiled, model)
        motion = BodyPoses.of(rollout, roles.bodies, float(rollout.time[1] - rollout.time[0]), steps)
        spheres = frozenset(() if model.geometry is None else model.geometry.names())
        return ContactPartners(compiled, roles, motion, ReplayContacts.of(rollout.contacts, roles), spheres)

    def of(self, body: str, start: float, end: float) -> ContactPartner | None:
        """Return what a body, or what it carries along, touches from `start` to `end` [s]; None where nothing."""
        if body not in self.roles.bodies:
            return None
        row = self.roles.bodies.index(body)
        group = _subtree(self.compiled, row)
        step = self.touches.step * self.motion.timestep
        mine = np.isin(self.touches.body, group)
        chosen = np.asarray((mine.sum(axis=1) == 1) & (step >= start) & (step <= end))
        rows, side = self.touches[chosen], mine[chosen].argmin(axis=1)
        touched = len(np.unique(rows.step)) * self.motion.timestep
        if not len(rows.step) or touched < self.cfg.min_time_share * (end - start):
            return None
        entity = np.take_along_axis(rows.entity, side[:, None], axis=1)[:, 0]
        other = np.take_along_axis(rows.body, side[:, None], axis=1)[:, 0]
        force = rows.force + 1e-9
        found: dict[str, np.ndarray] = {}
        for e in np.unique(entity):
            name = self.name(int(e))
            found[name] = found.get(name, np.zeros(len(entity), dtype=bool)) | (entity == e)
        role = {name: self.roles.body_role[other[mask][0]] for name, mask in found.items()}
        lasting = {name: len(np.unique(rows.step[mask])) * self.motion.timestep for name, mask in found.items()}
        strong = [
            name
            for name, mask in found.items()
            if force[mask].sum() >= self.cfg.min_force_share * force.sum()
            or (role[name] == "object" and lasting[name] >= self.cfg.min_time_share * (end - start))
        ]
        strong.sort(key=lambda name: (ROLE_ORDER[role[name]], -force[found[name]].sum()))
        names = []
        for name in strong[: self.cfg.max_names]:
            mask = found[name]
            spot = self.spot(int(other[mask][0]), rows[mask], force[mask])
            names.append(f"{name} ({spot})" if spot else name)
        first = found[strong[0]]
        local = self.motion.into(row, rows.step[first], rows.point[first])
        point = np.average(local, axis=0, weights=force[first])
        return ContactPartner(tuple(names), (float(point[0]), float(point[1]), float(point[2])))

    def name(self, entity: int) -> str:
        """Return what to call an entity: its geom's name where it has one of its own, else its body's."""
        found = self.roles.entities[entity]
        own = mujoco.mj_name2id(self.compiled, mujoco.mjtObj.mjOBJ_GEOM, found.name) >= 0
        if own and found.name not in self.spheres and found.name != found.body:
            return (
                found.name if found.body == "world" else f"{found.body}'s {found.name.removeprefix(f'{found.body}_')}"
            )
        return "the surroundings" if found.body == "world" else found.body

    def spot(self, body: int, rows: ReplayContacts, force: np.ndarray) -> str:
        """Return the side, edge or corner of a body that contacts are at, empty where they are within it."""
        if body == 0:
            return ""
        low, high = _box_of(self.compiled, body)
        half = (high - low) / 2
        if (half <= 0).any():
            return ""
        local = self.motion.into(body, rows.step, rows.point)
        place = (np.average(local, axis=0, weights=force) - (low + high) / 2) / half
        sides = [f"{'+' if place[k] > 0 else '-'}{'xyz'[k]}" for k in range(3) if abs(place[k]) >= self.cfg.side_share]
        return f"{' '.join(sides)} {('side', 'edge', 'corner')[len(sides) - 1]}" if sides else ""


def _subtree(compiled: mujoco.MjModel, body: int) -> list[int]:
    """Return the ids of a body and of all that it carries."""
    found = {body}
    for b in range(body + 1, compiled.nbody):
        if int(compiled.body_parentid[b]) in found:
            found.add(b)
    return sorted(found)


def _box_of(compiled: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box about the geoms of a body [m], (3,) each, in its frame; both zero without geoms."""
    corners = []
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    first, count = int(compiled.body_geomadr[body]), int(compiled.body_geomnum[body])
    for g in range(first, first + count):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, compiled.geom_quat[g])
        local = compiled.geom_aabb[g, :3] + signs * compiled.geom_aabb[g, 3:]
        corners.append(compiled.geom_pos[g] + local @ matrix.reshape(3, 3).T)
    if not corners:
        return np.zeros(3), np.zeros(3)
    points = np.concatenate(corners)
    return points.min(axis=0), points.max(axis=0)
