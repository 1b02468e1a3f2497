"""Contacts of a replay as the staging reads them: ordered pairs of entities, normal forces, motion of bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.errors import EventsError
from concent_warp.events.cfg import StagingCfg
from concent_warp.events.filter import debounce, steps_of
from concent_warp.events.roles import Roles
from concent_warp.simulate.engine import ContactLog, Rollout

ROLE_ORDER = {"robot": 0, "object": 1, "world": 2}


@dataclass(frozen=True)
class BodyPoses:
    """Poses of all bodies at every step."""

    timestep: float
    """Time step [s]."""
    position: np.ndarray
    """Body frame origins [m], world frame, shape (K, nbody, 3)."""
    rotation: np.ndarray
    """Body-to-world rotations, shape (K, nbody, 3, 3)."""

    @staticmethod
    def of(rollout: Rollout, bodies: Sequence[str], timestep: float, steps: int, variant: int = 0) -> BodyPoses:
        """Read the motion off a NumPy rollout that records steps 0..K-1 and the poses of all `bodies`."""
        if len(rollout.step) < steps or not np.array_equal(rollout.step[:steps], np.arange(steps)):
            raise EventsError("the rollout does not record every step", expected=f"steps 0..{steps - 1}")
        if missing := [name for name in bodies if name not in rollout.bodies]:
            raise EventsError("the rollout lacks poses of bodies", expected=f"all of {list(bodies)}", found=missing)
        rows = [rollout.bodies.index(name) for name in bodies]
        position = np.asarray(rollout.body_position[variant][:steps, rows], dtype=float)
        quaternion = np.asarray(rollout.body_quaternion[variant][:steps, rows], dtype=float)
        return BodyPoses(timestep, position, _rotation_matrix(quaternion))

    @property
    def steps(self) -> int:
        """Number of steps K."""
        return len(self.position)

    def into(self, body: np.ndarray | int, step: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Return world points [m], shape (C, 3), in the frames of `body` (C,) at `step` (C,), shape (C, 3)."""
        return np.einsum("cji,cj->ci", self.rotation[step, body], point - self.position[step, body])

    def turn_into(self, body: np.ndarray | int, step: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return world directions, shape (C, 3), in the frames of `body` (C,) at `step` (C,), shape (C, 3)."""
        return np.einsum("cji,cj->ci", self.rotation[step, body], direction)

    def relative(self, body: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of a body in the frame of another: origin [m] (K, 3) and rotation (K, 3, 3)."""
        origin = self.into(frame, np.arange(self.steps), self.position[:, body])
        return origin, np.einsum("kji,kjl->kil", self.rotation[:, frame], self.rotation[:, body])


@dataclass(frozen=True)
class ReplayContacts:
    """C contacts between a pair (a, b) each, `a` before `b` in the order that `ContactInterval` says."""

    step: np.ndarray
    """Simulation step, shape (C,)."""
    body: np.ndarray
    """Body ids of a and b, shape (C, 2)."""
    entity: np.ndarray
    """Indices into `Roles.entities` of a and b, shape (C, 2)."""
    point: np.ndarray
    """Contact point [m], world frame, shape (C, 3)."""
    normal: np.ndarray
    """Unit normal from b to a, world frame, shape (C, 3)."""
    force: np.ndarray
    """Normal force [N], shape (C,)."""
    pull: np.ndarray
    """Force of adhesion that draws the two together [N], shape (C,)."""

    def __getitem__(self, rows: np.ndarray) -> ReplayContacts:
        return ReplayContacts(**{name: value[rows] for name, value in vars(self).items()})

    @staticmethod
    def of(log: ContactLog, roles: Roles, variant: int = 0, pull: np.ndarray | None = None) -> ReplayContacts:
        """Order the contacts of one variant; contacts within the robot are left out.

        Args:
            log: Every contact of every step.
            roles: Names and roles of what the log's geom ids mean.
            variant: Which variant of the log.
            pull: Force of adhesion on each contact of the log [N], shape (C,); none by default.
        """
        kept = log.variant == variant
        geom, normal = log.geom[kept], np.asarray(log.normal[kept], dtype=float)
        if geom.size and geom.max() >= len(roles.geom_body):
            raise EventsError(
                "the contacts name geoms that the model lacks",
                expected=f"ids below {len(roles.geom_body)}",
                found=int(geom.max()),
            )
        body = roles.geom_body[geom]
        role = np.array([ROLE_ORDER[r] for r in roles.body_role])[body]
        force = np.abs(np.einsum("ci,ci->c", np.asarray(log.force[kept], dtype=float), normal))
        step = np.asarray(log.step[kept], dtype=int)
        rank = _body_rank(roles, step, body, role)
        swap = rank[body[:, 0]] > rank[body[:, 1]]
        columns = np.where(swap[:, None], [[1, 0]], [[0, 1]])
        touches = ReplayContacts(
            step=step,
            body=np.take_along_axis(body, columns, axis=1),
            entity=np.take_along_axis(roles.geom_entity[geom], columns, axis=1),
            point=np.asarray(log.position[kept], dtype=float),
            normal=np.where(swap[:, None], normal, -normal),
            force=force,
            pull=np.zeros(len(force)) if pull is None else pull[kept],
        )
        return touches[(role != ROLE_ORDER["robot"]).any(axis=1) & (body[:, 0] != body[:, 1])]

    def between(self, a: int, b: int) -> ReplayContacts:
        """Return the contacts of two bodies."""
        return self[(self.body == (a, b)).all(axis=1)]

    def frames(self, steps: int) -> np.ndarray:
        """Return whether there is any contact at each of K steps, shape (K,) bool."""
        return np.bincount(self.step, minlength=steps)[:steps] > 0

    def debounced_pairs(self, steps: int, timestep: float, cfg: StagingCfg) -> dict[tuple[int, int], np.ndarray]:
        """Return for each pair of bodies when it is in contact after the chatter rule, shape (K,) bool."""
        max_gap, shortest = steps_of(cfg.max_gap, timestep), steps_of(cfg.min_contact_duration, timestep)
        pairs = {(int(a), int(b)) for a, b in np.unique(self.body, axis=0)}
        in_contact = {pair: debounce(self.between(*pair).frames(steps), max_gap, shortest) for pair in sorted(pairs)}
        return {pair: touching for pair, touching in in_contact.items() if touching.any()}

    def within(self, in_contact: dict[tuple[int, int], np.ndarray]) -> ReplayContacts:
        """Return the contacts at steps at which their pair of bodies is in contact, `in_contact[pair]` (K,) bool."""
        kept = np.zeros(len(self.step), dtype=bool)
        for pair, touching in in_contact.items():
            kept |= (self.body == pair).all(axis=1) & touching[self.step]
        return self[kept]


def _body_rank(roles: Roles, step: np.ndarray, body: np.ndarray, role: np.ndarray) -> np.ndarray:
    """Return the rank of each body, (nbody,): robot, objects by time in contact with the robot, world; then name."""
    contact_steps = dict.fromkeys(roles.ids("object"), 0)
    for b in contact_steps:
        by_robot = ((body == b) & (role[:, ::-1] == ROLE_ORDER["robot"])).any(axis=1)
        contact_steps[b] = len(np.unique(step[by_robot]))
    order = sorted(
        range(len(roles.bodies)),
        key=lambda i: (ROLE_ORDER[roles.body_role[i]], -contact_steps.get(i, 0), roles.bodies[i]),
    )
    rank = np.empty(len(order), dtype=int)
    rank[order] = np.arange(len(order))
    return rank


def _rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return rotation matrices, shape (..., 3, 3), of unit quaternions wxyz, shape (..., 4)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
