"""Object on object: the first contact, and the move of this contact onto a new region, inside the other object.

Contact normals vary over a surface of spheres: a single normal does not distinguish a rim from a wall. The
kinds of contact are therefore distinguished by position, and by forces summed over windows:

- The *first contact* has a plane. Its normal is the reverse of the motion that the contact stopped (the approach, or
  the way that the object goes on while in contact), turned into the layer of spheres that the contact is on: both are
  far smoother than contact normals, which are only used to decide whether the contact opposed the motion.
- An object is *beyond* this plane once the foremost of its points that ever touch has passed it by
  `inside_depth`. If it then touches surfaces across the plane, or any surface beyond it, it has entered; if the other
  object surrounds it there, that is insertion, and these surfaces are inner ones.
- A first contact that did not oppose the motion, or that is deep within the other object, did not block it: the
  object has entered directly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from concent_warp.events.cfg import InsertionCfg, StagingCfg
from concent_warp.events.filter import debounce, steps_of, true_runs, window_sums
from concent_warp.events.onset import Onset
from concent_warp.events.touches import BodyPoses, ReplayContacts


@dataclass(frozen=True)
class Plane:
    """The plane of the first contact, in the frame of the second object."""

    point: np.ndarray
    """A point of it [m], shape (3,)."""
    normal: np.ndarray
    """Its unit normal, against the approach, shape (3,)."""
    barred: bool
    """Whether the contact blocked the motion; if not, the plane is normal to the approach, at the first touch."""


@dataclass(frozen=True)
class PairContact:
    """The contacts of object `a` on object `b`, in the frame of b."""

    step: np.ndarray
    """Shape (C,)."""
    normal: np.ndarray
    """Unit normals from b to a, shape (C, 3)."""
    force: np.ndarray
    """Normal forces [N], shape (C,)."""
    point: np.ndarray
    """Contact points [m], shape (C, 3)."""
    feelers: np.ndarray
    """Points of a that ever touch b [m], frame of a, shape (M, 3)."""
    origin: np.ndarray
    """Origin of a at every step [m], shape (K, 3)."""
    rotation: np.ndarray
    """Rotation of a at every step, shape (K, 3, 3)."""
    spheres: np.ndarray
    """Sphere centres of b [m], shape (n, 3); empty where b collides through its own geoms."""
    layout: np.ndarray
    """Where b is [m]: its sphere centres, or if it has none the places where a touches it, shape (n, 3)."""

    @staticmethod
    def of(
        rows: ReplayContacts, motion: BodyPoses, pair: tuple[int, int], spheres: np.ndarray, grid: float
    ) -> PairContact:
        """Return contacts of a pair of bodies in the frame of the second.

        Args:
            rows: The contacts.
            motion: Poses.
            pair: Ids of the bodies.
            spheres: Sphere centres of the second [m], in its frame, shape (n, 3).
            grid: Size of the grid to which touching points are thinned out [m].
        """
        a, b = pair
        point = motion.into(b, rows.step, rows.point)
        origin, rotation = motion.relative(a, b)
        return PairContact(
            step=rows.step,
            normal=motion.turn_into(b, rows.step, rows.normal),
            force=rows.force,
            point=point,
            feelers=_thinned(motion.into(a, rows.step, rows.point), grid),
            origin=origin,
            rotation=rotation,
            spheres=spheres,
            layout=spheres if len(spheres) else _thinned(point, grid),
        )

    def mean(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return point [m] and unit normal, shape (3,) each, of contacts `rows`, weighted by force."""
        weight = self.force[rows] + 1e-9
        normal = weight @ self.normal[rows]
        return weight @ self.point[rows] / weight.sum(), normal / max(np.linalg.norm(normal), 1e-12)

    def height(self, plane: Plane) -> np.ndarray:
        """Return how far the foremost feeler is in front of a plane at each step [m], shape (K,)."""
        reach = np.einsum("kij,i->kj", self.rotation, plane.normal) @ self.feelers.T
        return (self.origin - plane.point) @ plane.normal + reach.min(axis=1)


def _thinned(points: np.ndarray, grid: float) -> np.ndarray:
    """Return points [m], shape (C, 3), one for each cell of a grid [m] that has any, shape (n, 3)."""
    return np.unique(np.round(points / grid), axis=0) * grid


def object_onsets(
    touches: ReplayContacts,
    in_contact: np.ndarray,
    pair: tuple[int, int],
    motion: BodyPoses,
    grasped: np.ndarray,
    spheres: np.ndarray,
    cfg: StagingCfg,
) -> list[Onset]:
    """Return the onsets of contact between two objects: touch, align, enter, insert.

    Args:
        touches: Contacts of the two, a before b.
        in_contact: When they are in contact, shape (K,) bool.
        pair: Their body ids.
        motion: Poses.
        grasped: When the robot grasps one of them, shape (K,) bool.
        spheres: Sphere centres of b [m], frame of b, shape (n, 3).
        cfg: Settings.
    """
    touching = in_contact.copy()
    for start, end in true_runs(in_contact):
        if start <= cfg.initial_duration / motion.timestep:
            touching[start:end] = False
    rows = touches[touching[touches.step]]
    if not len(rows.step):
        return []
    contact = PairContact.of(rows, motion, pair, spheres, cfg.insertion.grid)
    first = int(rows.step[0])
    plane = _first_plane(contact, touching, steps_of(cfg.window, motion.timestep), cfg)
    beyond, inside = _passage(contact, touching, plane, motion.timestep, cfg)
    entered = int(np.flatnonzero(inside)[0]) if inside.any() else motion.steps
    onsets = []
    if entered - first >= steps_of(cfg.min_contact_duration, motion.timestep):
        onsets.append(Onset("align" if grasped[first] else "touch", first, pair, touching & ~beyond))
    if inside.any():
        deepest = entered + int(np.argmin(contact.height(plane)[entered : contact.step[-1] + 1]))
        kind = "insert" if _surrounded(contact, plane, deepest, cfg.inside_depth) else "enter"
        onsets.append(Onset(kind, entered, pair, touching & beyond))
    return onsets


def _first_plane(contact: PairContact, touching: np.ndarray, width: int, cfg: StagingCfg) -> Plane:
    """Return the plane of the first contact, judged by the first `width` steps from it on."""
    first, last = int(contact.step[0]), int(np.flatnonzero(touching)[-1])
    point, normal = contact.mean(contact.step < first + width)
    approach = _approach_direction(contact.origin, first, cfg.approach_length)
    ways = [-approach, _unit(contact.origin[first] - contact.origin[last], cfg.inside_depth)]
    opposed = [way for way in ways if way @ normal > np.cos(np.radians(cfg.insertion.opposing_angle))]
    if not opposed:
        return Plane(point, -approach if approach.any() else normal, barred=not approach.any())
    if len(contact.spheres):
        normal = _fit_normal(contact.spheres, point, opposed[0], cfg.insertion)
    plane = Plane(point, normal, barred=True)
    return replace(plane, barred=not _surrounded(contact, plane, first, cfg.inside_depth))


def _approach_direction(origin: np.ndarray, first: int, length: float) -> np.ndarray:
    """Return the unit direction of the last `length` [m] of path before step `first`; zero if it has not moved."""
    travelled = np.cumsum(np.linalg.norm(np.diff(origin[: first + 1], axis=0), axis=1)[::-1])
    back = int(np.searchsorted(travelled, length)) + 1
    return _unit(origin[first] - origin[max(first - back, 0)], 0.1 * length)


def _unit(vector: np.ndarray, least: float) -> np.ndarray:
    """Return a vector (3,) at length 1, or zero if it is not longer than `least`."""
    length = np.linalg.norm(vector)
    return vector / length if length > least else np.zeros(3)


def _fit_normal(spheres: np.ndarray, point: np.ndarray, normal: np.ndarray, cfg: InsertionCfg) -> np.ndarray:
    """Turn a direction (3,) into the normal of the layer of spheres (n, 3) that a contact at `point` (3,) is on.

    Of the directions around `normal`, the one is taken that has most spheres level with the touched one, the more of
    them the farther it is from `normal`, and turned into the normal of their plane of least squares. Where they are too
    few, or in a line, it stays as it is.
    """
    near = spheres[np.linalg.norm(spheres - point, axis=1) < cfg.plane_radius]
    if len(near) < cfg.plane_min_spheres:
        return normal
    from_touched = near - near[np.argmin(np.linalg.norm(near - point, axis=1))]
    tilts = np.radians(cfg.plane_tilts)
    candidates = _cone(normal, tilts)
    level = np.abs(from_touched @ candidates.T) < cfg.plane_band
    nearness = 2 * (candidates @ normal) ** 2 - 1  # cosine of twice the tilt
    layer = from_touched[level[:, np.argmax(level.sum(axis=0) * nearness)]]
    if len(layer) < cfg.plane_min_spheres:
        return normal
    spread, axes = np.linalg.svd(layer - layer.mean(axis=0), full_matrices=False)[1:]
    turned = axes[2] * (1.0 if axes[2] @ normal > 0 else -1.0)
    return turned if spread[1] > cfg.plane_flatness * spread[2] and turned @ normal > np.cos(tilts[-1]) else normal


def _cone(axis: np.ndarray, tilts: np.ndarray) -> np.ndarray:
    """Return unit vectors around an axis (3,) at some tilts [rad], the axis first, shape (n, 3)."""
    across = np.linalg.svd(axis[None])[2][1:]
    tilt, turn = np.meshgrid(tilts, np.linspace(0, 2 * np.pi, 24, endpoint=False), indexing="ij")
    sideways = np.cos(turn)[..., None] * across[0] + np.sin(turn)[..., None] * across[1]
    vectors = np.cos(tilt)[..., None] * axis + np.sin(tilt)[..., None] * sideways
    return np.concatenate([axis[None], vectors.reshape(-1, 3)])


def _passage(
    contact: PairContact, touching: np.ndarray, plane: Plane, timestep: float, cfg: StagingCfg
) -> tuple[np.ndarray, np.ndarray]:
    """Return when a is in contact beyond the plane, and when on inner surfaces, shape (K,) bool each.

    Contact on inner surfaces counts once it has lasted `min_state_duration`.
    """
    steps, width = len(touching), steps_of(cfg.window, timestep)
    across = np.abs(contact.normal @ plane.normal) < np.cos(np.radians(cfg.insertion.across_angle))
    deep = (contact.point - plane.point) @ plane.normal < -cfg.inside_depth
    inner = across | deep if plane.barred else np.ones(len(contact.step), dtype=bool)
    beyond = touching & (contact.height(plane) < -cfg.inside_depth) if plane.barred else touching.copy()
    on_inner = window_sums(np.bincount(contact.step, contact.force * inner, minlength=steps), width)
    total = window_sums(np.bincount(contact.step, contact.force, minlength=steps), width)
    now = np.bincount(contact.step, inner, minlength=steps) > 0
    inside = beyond & now & (on_inner > cfg.insertion.inner_share * total)
    return beyond, debounce(inside, steps_of(cfg.max_gap, timestep), steps_of(cfg.min_state_duration, timestep))


def _surrounded(contact: PairContact, plane: Plane, step: int, margin: float) -> bool:
    """Return whether b is all around a at a step.

    Seen along the plane's normal from the middle of a's feelers, what b has above the foremost feeler, by more than
    `margin` [m], leaves no gap of half a turn.
    """
    across = np.linalg.svd(plane.normal[None])[2][1:]
    middle = contact.origin[step] + contact.rotation[step] @ contact.feelers.mean(axis=0)
    above = (contact.layout - plane.point) @ plane.normal > contact.height(plane)[step] + margin
    flat = (contact.layout[above] - middle) @ across.T
    angle = np.sort(np.arctan2(flat[:, 1], flat[:, 0]))
    return len(angle) > 2 and bool(np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() < np.pi)
