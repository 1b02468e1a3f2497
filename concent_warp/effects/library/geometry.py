"""Contact geometry as an effect: faces of an object that lie off or are tilted, and edges that are worn."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.effects.effect import Parameter
from concent_warp.effects.library.cut_box import ALL_EDGES, EDGE_PARTS, PARTS, CutBox, largest, names
from concent_warp.effects.library.objects import BodyEffect, keep_inertia
from concent_warp.effects.select import element_name, free_bodies

GEOM = mujoco.mjtGeom
SPHERE = int(GEOM.mjGEOM_SPHERE)
SHAPES = (
    SPHERE,
    *(int(g) for g in (GEOM.mjGEOM_BOX, GEOM.mjGEOM_CYLINDER, GEOM.mjGEOM_CAPSULE, GEOM.mjGEOM_ELLIPSOID)),
)
"""Shapes that can be moved and resized."""
FACES = ("x+", "y+", "z+", "x-", "y-", "z-")
FACE_DEPTH = 1.5
"""Distance from a face, in radii, below which a sphere moves with the face [-]."""
MAX_MOVED_SIZE = 0.5
"""Size of a shape over that of the body along each axis below which it is moved and not resized [-]."""
MIN_SIZE = 0.1
"""Least size of a resized shape over its nominal one [-]."""
TILT = 1e-3
"""Typical tilt of a face: how far its ends lie off [m]."""
CUT = 2e-3
"""Typical width of the cut of a worn edge [m]."""
SCANNED = (0.15, 0.4)
"""Widths of cuts that are scanned, over the largest one [-]: an edge that a motion touches once is lost in contacts."""
SCANNED_TILT = 0.35
"""Tilts of faces that are scanned, to both sides, over the largest one [-]."""
MIN_SPHERES = 8
"""Fewest spheres that have faces and edges: one a corner."""
AXIS_TOLERANCE = 1e-6
"""Largest entry, off 0 and 1, of the rotation of a shape whose axes are those of the body."""


class ContactGeometryOffset(BodyEffect):
    """Contact geometry of a body that is not the model's: its faces lie off or are tilted, or its edges are worn.

    The target is a body, whose faces lie off, or a body and one of `PARTS`. Each part is a candidate by itself: most
    objects differ from their model in one place, and few parameters leave less room for what another effect explains.
    """

    name = "contact_geometry"
    requirement = (
        "a body with colliding spheres, boxes, cylinders, capsules or ellipsoids; for tilted faces and worn edges, with"
        " one box or with spheres alone"
    )
    summary = (
        "Each face of the box about the body's colliding shapes lies outward of the model's by an offset; spheres and"
        " shapes at a face move with it, those inside by a share that falls linearly to 0 at the opposite face. Or, by"
        f" a second target, one of {', '.join(PARTS)}: the two faces across an axis of the box are tilted, each by how"
        " far it lies further out at the positive end of another axis and further in at the negative; or the four edges"
        " along an axis, or all edges alike, are cut at 45 degrees by a width on both faces. Mass and inertia stay."
    )
    source = "geometry"
    signature = (
        "contacts come early or late on some sides of the body, whose resting height is off on others; it rests or is"
        " pushed at an angle where faces are tilted, and lands turned where edges are worn"
    )
    confusions = ("size", "frame_offset", "center_of_mass", "length_scale")
    parts = PARTS

    def __init__(self, *target: str) -> None:
        super().__init__(*target)
        if self.part:  # any of the parts is as rare as the whole: one by itself is that much rarer
            self.rarity = 2 * float(np.log(len(PARTS)))  # pyright: ignore[reportAttributeAccessIssue]

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return each free body with shapes that can be moved; one box or spheres alone also with each part."""
        found: list[tuple[str, ...]] = []
        for b in free_bodies(m):
            if len(_shapes(m, b)) and (n := element_name(m, mujoco.mjtObj.mjOBJ_BODY, b)):
                found.append((n,))
                if _has_parts(m, b):
                    found += [(n, part) for part in PARTS]
        return tuple(found)

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether a body has shapes that can be moved, and the part that is off."""
        return i > 0 and len(_shapes(m, i)) > 0 and (not self.part or _has_parts(m, i))

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return an outward offset of each face, the tilts of two faces, or the widths of cuts."""
        part = self.part
        if not part:
            return tuple(Parameter(face, "m", 0.0, -5e-3, 5e-3, 5e-4) for face in FACES)
        most = min(largest(_box(m, int(b))[1], part) for b in self.ids(m))
        if part == ALL_EDGES or part in EDGE_PARTS:
            scan = tuple(share * most for share in SCANNED)
            return tuple(Parameter(name, "m", 0.0, 0.0, most, CUT, scan) for name in names(part))
        scan = (-SCANNED_TILT * most, SCANNED_TILT * most)
        return tuple(Parameter(name, "m", 0.0, -most, most, TILT, scan) for name in names(part))

    def edit(self, spec: mujoco.MjSpec, values: np.ndarray) -> None:
        """Move and resize the colliding shapes of the body; what MuJoCo would derive from them is fixed first."""
        compiled = spec.copy().compile()
        for n in self.elements:
            body, b = spec.body(n), compiled.body(n).id
            keep_inertia(body, compiled)
            geoms, first = list(body.geoms), int(compiled.body_geomadr[b])
            if self.part:
                _cut(spec, compiled, b, {int(i): geoms[i - first] for i in _shapes(compiled, b)}, self.part, values)
                continue
            offsets = Offsets.of(compiled, b, values)
            for i in _shapes(compiled, b):
                _write(body, geoms[i - first], *offsets.moved(compiled, int(i)))


@dataclass(frozen=True)
class Offsets:
    """Offsets of the faces of a box."""

    low: np.ndarray
    """Corner of the box [m], body frame, shape (3,)."""
    high: np.ndarray
    """Opposite corner, shape (3,)."""
    outward: np.ndarray
    """Offsets of the faces at `high` and at `low` [m], shape (2, 3)."""

    @staticmethod
    def of(m: mujoco.MjModel, body: int, values: np.ndarray) -> Offsets:
        """Return offsets by `values` (6,), in the order of `FACES`, of the box about a body's shapes."""
        ids = _shapes(m, body)
        reach = np.array([_extent(m, i) for i in ids])
        low, high = (m.geom_pos[ids] - reach).min(axis=0), (m.geom_pos[ids] + reach).max(axis=0)
        return Offsets(low, high, np.reshape(values, (2, 3)))

    def at(self, point: np.ndarray, skin: np.ndarray | float = 0.0) -> np.ndarray:
        """Return how far a point (3,) moves [m], shape (3,); as its face does within `skin` of one [m]."""
        inside = self.high - self.low - 2 * np.asarray(skin)
        share = np.where(inside > 0, (point - self.low - skin) / np.maximum(inside, 1e-12), 0.5)
        share = np.clip(share, 0.0, 1.0)
        return share * self.outward[0] - (1 - share) * self.outward[1]

    def moved(self, m: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position, orientation (wxyz) and size of a shape after the move, shapes (3,), (4,), (3,)."""
        position, size, reach = m.geom_pos[geom], m.geom_size[geom].copy(), _extent(m, geom)
        quaternion = m.geom_quat[geom]
        axes = np.abs(_rotation(m, geom))
        small = (reach < MAX_MOVED_SIZE * (self.high - self.low) / 2).all()
        aligned = m.geom_type[geom] == SPHERE or np.abs(axes - axes.round()).max() < AXIS_TOLERANCE
        if small or not aligned:
            return position + self.at(position, FACE_DEPTH * reach), quaternion, size
        ends = self.at(position + reach), self.at(position - reach)
        grown = _resized(int(m.geom_type[geom]), size, axes.round().T @ (ends[0] - ends[1]) / 2)
        return position + (ends[0] + ends[1]) / 2, quaternion, np.maximum(grown, MIN_SIZE * size)


def _resized(kind: int, size: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the size (3,) of a shape whose reach along its own axes changes by `change` (3,) [m]."""
    if kind == SPHERE:
        return size + np.array([change.mean(), 0.0, 0.0])
    if kind in (int(GEOM.mjGEOM_CYLINDER), int(GEOM.mjGEOM_CAPSULE)):
        radius = change[:2].mean()
        caps = radius if kind == int(GEOM.mjGEOM_CAPSULE) else 0.0
        return size + np.array([radius, change[2] - caps, 0.0])
    return size + change


def _shapes(m: mujoco.MjModel, body: int) -> np.ndarray:
    """Return the colliding geoms of a body that can be moved, shape (n,) int."""
    ids = np.flatnonzero(m.geom_bodyid == body)
    collides = (m.geom_contype[ids] != 0) | (m.geom_conaffinity[ids] != 0)
    return ids[collides & np.isin(m.geom_type[ids], SHAPES)]


def _has_parts(m: mujoco.MjModel, body: int) -> bool:
    """Return whether a body collides as one box, or as spheres on all sides of its middle."""
    ids = np.flatnonzero(m.geom_bodyid == body)
    ids = ids[(m.geom_contype[ids] != 0) | (m.geom_conaffinity[ids] != 0)]
    if len(ids) == 1:
        return bool(m.geom_type[ids[0]] == int(GEOM.mjGEOM_BOX))
    return len(ids) >= MIN_SPHERES and bool((m.geom_type[ids] == SPHERE).all())


def _box(m: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half sizes of the box that a body is, or of that about its spheres [m], shapes (3,)."""
    ids = _shapes(m, body)
    if len(ids) == 1:
        return m.geom_pos[ids[0]], m.geom_size[ids[0]].copy()
    reach = m.geom_size[ids, :1]
    low, high = (m.geom_pos[ids] - reach).min(axis=0), (m.geom_pos[ids] + reach).max(axis=0)
    return (low + high) / 2, (high - low) / 2


def _cut(
    spec: mujoco.MjSpec,
    m: mujoco.MjModel,
    body: int,
    geoms: dict[int, mujoco.MjsGeom],
    part: str,
    values: np.ndarray,
) -> None:
    """Tilt faces or cut edges of a body: its box becomes a convex mesh, its spheres move.

    Args:
        spec: The MJCF.
        m: The same, compiled.
        body: The body.
        geoms: Its colliding shapes by their ids.
        part: One of `PARTS`.
        values: Values of the parameters, shape (P,); the box stays one where all are 0.
    """
    middle, half = _box(m, body)
    found, ids = CutBox.of(half, part, values), list(geoms)
    if found.is_plain:
        return
    parent = spec.body(m.body(body).name)
    if len(ids) > 1:
        places = found.moved(m.geom_pos[ids] - middle, m.geom_size[ids, 0], FACE_DEPTH)
        for i, place in zip(ids, places, strict=True):
            _write(parent, geoms[i], middle + place, m.geom_quat[i], m.geom_size[i])
        return
    (i,), (geom,) = ids, geoms.values()
    _write(parent, geom, m.geom_pos[i], m.geom_quat[i], m.geom_size[i])
    mesh = spec.add_mesh(name=f"{parent.name}_{part}")
    mesh.uservert = found.corners().ravel()
    geom.type, geom.meshname = GEOM.mjGEOM_MESH, mesh.name


def _rotation(m: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the rotation of a geom in its body, shape (3, 3)."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, m.geom_quat[geom])
    return flat.reshape(3, 3)


def _extent(m: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return how far a geom reaches from its middle along the axes of its body [m], shape (3,)."""
    half = m.geom_aabb[geom, 3:]
    return half.copy() if m.geom_type[geom] == SPHERE else np.abs(_rotation(m, geom)) @ half


def _write(
    body: mujoco.MjsBody, geom: mujoco.MjsGeom, position: np.ndarray, quaternion: np.ndarray, size: np.ndarray
) -> None:
    """Give a geom position and orientation in the frame of its body, however the MJCF gives them, and a size."""
    if geom.frame is not None:
        geom.set_frame(body.add_frame())
    geom.fromto = np.full(6, np.nan)
    geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    geom.pos, geom.quat, geom.size = position, quaternion, size
