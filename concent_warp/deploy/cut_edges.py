"""Objects drawn with cut edges, as real ones have: primitives whose sizes and places follow the width of the cut.

Only sizes and places of primitives can differ between the worlds of a ray tracer. A box is drawn as three boxes, each
shorter by the cut along two axes, and as a bar along each of its edges, turned by 45 degrees, whose outer face is the
face of the cut; at the corners a notch stays. A cylinder is drawn as two, whose edges are notches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np

SHORTENED = {
    mujoco.mjtGeom.mjGEOM_BOX: ((0, 1, 1), (1, 0, 1), (1, 1, 0)),
    mujoco.mjtGeom.mjGEOM_CYLINDER: ((0, 1, 0), (1, 0, 0)),
}
"""For each part of the shape of a geom, the entries of its size that are shorter."""
SEEN_GROUPS = 3
"""Geoms of MuJoCo's groups below this one are seen."""


@dataclass(frozen=True)
class Part:
    """A part that a geom is drawn as; all is linear in the geom's size [m] and the width of the cut [m]."""

    size: np.ndarray
    """Its size by that of the geom, shape (3, 3)."""
    size_cut: np.ndarray
    """And by the cut, shape (3,)."""
    place: np.ndarray
    """Its place in the geom's frame, likewise, shape (3, 3)."""
    place_cut: np.ndarray
    """And by the cut, shape (3,)."""
    turn: np.ndarray
    """Its orientation in the geom's frame, shape (3, 3)."""


@dataclass(frozen=True)
class CutEdges:
    """Sizes and places of the geoms of a compiled model by the sizes of the geoms that they are parts of."""

    whole: np.ndarray
    """The geom that each one is a part of, itself where it is none, shape (ngeom,) int."""
    size: np.ndarray
    """Size by that of the whole, shape (ngeom, 3, 3)."""
    size_cut: np.ndarray
    """Size by the width of the cut, shape (ngeom, 3)."""
    place: np.ndarray
    """What is added to the place of the whole in the body's frame, by its size, shape (ngeom, 3, 3)."""
    place_cut: np.ndarray
    """The same by the width of the cut, shape (ngeom, 3)."""


def parts_of(kind: mujoco.mjtGeom) -> list[Part]:
    """Return the parts that a geom of a kind is drawn as, of which the first takes its place; none of other kinds."""
    none, still = np.zeros((3, 3)), np.eye(3)
    found = [Part(still, -np.array(short, float), none, np.zeros(3), still) for short in SHORTENED.get(kind, ())]
    if kind != mujoco.mjtGeom.mjGEOM_BOX:
        return found
    for along, (a, b) in enumerate(((1, 2), (0, 2), (0, 1))):
        for signs in product((-1.0, 1.0), repeat=2):
            corner = np.zeros(3)
            corner[[a, b]] = signs
            across = np.zeros(3)
            across[[a, b]] = signs[0], -signs[1]
            outwards, sideways = corner / np.sqrt(2), across / np.sqrt(2)
            turn = np.column_stack([sideways, outwards, np.cross(sideways, outwards)])
            # Its outer face is the cut's: as wide as this is, half as thick as that, and inside the box besides.
            length = np.zeros((3, 3))
            length[2, along] = 1.0
            size_cut = np.array([1 / np.sqrt(2), 1 / np.sqrt(8), -1.0])
            found.append(Part(length, size_cut, np.diag(corner), -0.75 * corner, turn))
    return found


def add_parts(spec: mujoco.MjSpec, bodies: Sequence[str]) -> dict[str, list[str]]:
    """Add the parts of the boxes and cylinders that are all that is seen of a body; the spec is changed.

    Geoms that are one of several, as the walls of a box, meet where their edges are, and stay whole.

    Args:
        spec: The scene.
        bodies: Names of the bodies.

    Returns:
        Names of the parts by that of the geom, which is the first of them.
    """
    wholes: dict[str, mujoco.MjsGeom] = {}
    for name in bodies:
        seen = [geom for geom in spec.body(name).geoms if geom.group < SEEN_GROUPS and geom.rgba[3] > 0]
        if len(seen) == 1 and seen[0].type in SHORTENED:
            wholes[name], seen[0].name = seen[0], seen[0].name or f"{name}_whole"
    # A specification may give sizes and orientations in other ways than the compiled model.
    compiled = spec.copy().compile() if wholes else None
    parts: dict[str, list[str]] = {}
    for name, whole in wholes.items():
        assert compiled is not None
        given = compiled.geom(whole.name)
        parts[whole.name] = [whole.name]
        for k, part in enumerate(parts_of(whole.type)[1:], 1):
            turn, quat = np.zeros(4), np.zeros(4)
            mujoco.mju_mat2Quat(turn, part.turn.ravel())
            mujoco.mju_mulQuat(quat, given.quat, turn)
            geom = spec.body(name).add_geom(
                name=f"{whole.name}_part_{k}", type=whole.type, size=given.size, pos=given.pos, quat=quat,
                rgba=whole.rgba, group=whole.group, contype=0, conaffinity=0, mass=0,
            )  # fmt: skip
            geom.material = whole.material
            parts[whole.name].append(geom.name)
    return parts


def cut_edges(model: mujoco.MjModel, parts: dict[str, list[str]]) -> CutEdges:
    """Return sizes and places of the parts that `add_parts` made in the compiled model, and of all other geoms."""
    count = model.ngeom
    whole, size, place = np.arange(count), np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3, 3))
    size_cut, place_cut = np.zeros((count, 3)), np.zeros((count, 3))
    for first, names in parts.items():
        of, turn = model.geom(first).id, np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[of])
        frame = turn.reshape(3, 3)
        for name, part in zip(names, parts_of(mujoco.mjtGeom(model.geom_type[of])), strict=True):
            k = model.geom(name).id
            whole[k], size[k], size_cut[k] = of, part.size, part.size_cut
            place[k], place_cut[k] = frame @ part.place, frame @ part.place_cut
    return CutEdges(whole, size, size_cut, place, place_cut)
