"""Shapes that differ from the nominal ones: worn edges, tilted faces, chamfers, a hole of another size."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from concent_warp.reality.hidden.hidden_effect import fixed_inertia
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.world import chamfered_box

Edit = Callable[[mujoco.MjSpec], None]
Corners = Callable[[np.ndarray], np.ndarray]
"""Given half sizes of a box (3,), returns the corners of the convex shape in its place (n, 3) [m]."""


def _with_corners(rig: Rig, name: str, corners: Corners) -> Edit:
    """Return the edit that replaces the box of the rig's body by a convex mesh; mass and inertia stay."""
    geom = rig.scene.model.body(rig.body).geomadr[0]
    half = np.array(rig.scene.model.geom_size[geom])

    def edit(spec: mujoco.MjSpec) -> None:
        body = fixed_inertia(spec, rig.body)
        changed = body.geoms[0]
        size = np.array(changed.size) if changed.type == mujoco.mjtGeom.mjGEOM_BOX else half
        mesh = spec.add_mesh(name=f"{changed.name}_{name}")
        mesh.uservert = corners(size).ravel()
        changed.type, changed.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name

    return edit


def _box(half: np.ndarray) -> np.ndarray:
    """Return the corners of a box, shape (8, 3)."""
    return half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T


def worn_edge(rig: Rig, magnitude: float) -> Edit:
    """Return a lower edge, at +x, cut at 45 degrees by a width [m] on both faces."""

    def corners(half: np.ndarray) -> np.ndarray:
        box = _box(half)
        edge = (box[:, 0] > 0) & (box[:, 2] < 0)
        return np.concatenate([
            box[~edge], box[edge] - [magnitude, 0, 0], box[edge] + [0, 0, magnitude]
        ])  # fmt: skip

    return _with_corners(rig, "worn_edge", corners)


def tilted_face(rig: Rig, magnitude: float) -> Edit:
    """Return faces at +x and -x that are not square to the others: one end further out [m], one further in."""

    def corners(half: np.ndarray) -> np.ndarray:
        box = _box(half)
        box[:, 0] += magnitude * np.sign(box[:, 1])
        box[:, 1] += 0.5 * magnitude * np.sign(box[:, 0])
        return box

    return _with_corners(rig, "tilted_face", corners)


def tilted_base(rig: Rig, magnitude: float) -> Edit:
    """Return a lower face that is not square to the others: lower at +x by a length [m], higher at -x."""

    def corners(half: np.ndarray) -> np.ndarray:
        box = _box(half)
        box[:, 2] -= np.where(box[:, 2] < 0, magnitude * np.sign(box[:, 0]), 0.0)
        return box

    return _with_corners(rig, "tilted_base", corners)


def chamfer(rig: Rig, magnitude: float) -> Edit:
    """Return edges that are all cut at 45 degrees by a width [m]."""
    return _with_corners(rig, "chamfer", lambda half: chamfered_box(half, magnitude))


def wrong_hole(rig: Rig, magnitude: float) -> Edit:
    """Return a square hole whose edge is longer by a length [m], or shorter; outer edges stay."""
    del rig

    def edit(spec: mujoco.MjSpec) -> None:
        for name, axis in (("px", 0), ("nx", 0), ("py", 1), ("ny", 1)):
            wall = spec.geom(f"box_wall_{name}")
            position, size = np.array(wall.pos), np.array(wall.size)
            position[axis] += np.sign(position[axis]) * magnitude / 4
            size[axis] -= magnitude / 4
            wall.pos, wall.size = position, size

    return edit


SHAPES: dict[str, Callable[[Rig, float], Edit]] = {
    f.__name__: f for f in (worn_edge, tilted_face, tilted_base, chamfer, wrong_hole)
}
"""By name; the magnitude is a length [m]."""
