"""Contact geometry as an effect: offsets of the faces of an object from the nominal model."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.effects.effect import Parameter
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
AXIS_TOLERANCE = 1e-6
"""Largest entry, off 0 and 1, of the rotation of a shape whose axes are those of the body."""


class ContactGeometryOffset(BodyEffect):
    """Outward offsets of the faces of a body from the nominal model."""

    name = "contact_geometry"
    requirement = "a body with colliding spheres, boxes, cylinders, capsules or ellipsoids"
    summary = (
        "Each face of the box about the body's colliding shapes lies outward of the model's by an offset; spheres and"
        " shapes at a face move with it, those inside by a share that falls linearly to 0 at the opposite face; mass"
        " and inertia stay."
    )
    source = "geometry"
    signature = "contacts come early or late on some sides of the body, whose resting height is off on others"
    confusions = ("size", "frame_offset", "center_of_mass", "length_scale")

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return each free body with shapes that can be moved."""
        return tuple(
            (n,) for b in free_bodies(m) if len(_shapes(m, b)) and (n := element_name(m, mujoco.mjtObj.mjOBJ_BODY, b))
        )

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether a body has shapes that can be moved."""
        return i > 0 and len(_shapes(m, i)) > 0

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return an outward offset of each face."""
        return tuple(Parameter(face, "m", 0.0, -5e-3, 5e-3, 5e-4) for face in FACES)

    def edit(self, spec: mujoco.MjSpec, values: np.ndarray) -> None:
        """Move and resize the colliding shapes of the body; what MuJoCo would derive from them is fixed first."""
        compiled = spec.copy().compile()
        for n in self.target:
            body, b = spec.body(n), compiled.body(n).id
            keep_inertia(body, compiled)
            offsets = Offsets.of(compiled, b, values)
            geoms, first = list(body.geoms), int(compiled.body_geomadr[b])
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
