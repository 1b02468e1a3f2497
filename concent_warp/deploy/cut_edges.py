"""Objects drawn with cut edges, as real ones have: a box as three smaller boxes, a cylinder as two.

Only the size of primitives can differ between the worlds of a ray tracer. Boxes that are each shorter by the width of
the cut along two axes leave out the edges of the whole box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

SHORTENED = {
    mujoco.mjtGeom.mjGEOM_BOX: ((0, 1, 1), (1, 0, 1), (1, 1, 0)),
    mujoco.mjtGeom.mjGEOM_CYLINDER: ((0, 1, 0), (1, 0, 0)),
}
"""For each part that a geom is drawn as, the entries of its size that are shorter."""
SEEN_GROUPS = 3
"""Geoms of MuJoCo's groups below this one are seen."""


@dataclass(frozen=True)
class CutEdges:
    """Which geoms of a compiled model are parts of one that is drawn with cut edges."""

    whole: np.ndarray
    """The geom that each one is a part of, itself where it is none, shape (ngeom,) int."""
    shortened: np.ndarray
    """Which entries of its size are shorter by the cut, 0 or 1, shape (ngeom, 3)."""


def add_parts(spec: mujoco.MjSpec, bodies: Sequence[str]) -> dict[str, list[str]]:
    """Add the parts of the boxes and cylinders that are all that is seen of a body; the spec is changed.

    Geoms that are one of several, as the walls of a box, meet where their edges are, and stay whole.

    Args:
        spec: The scene.
        bodies: Names of the bodies.

    Returns:
        Names of the parts by that of the geom, which is the first of them.
    """
    parts: dict[str, list[str]] = {}
    for name in bodies:
        seen = [geom for geom in spec.body(name).geoms if geom.group < SEEN_GROUPS and geom.rgba[3] > 0]
        if len(seen) != 1 or seen[0].type not in SHORTENED:
            continue
        whole = seen[0]
        whole.name = whole.name or f"{name}_whole"
        parts[whole.name] = [whole.name]
        for k in range(1, len(SHORTENED[whole.type])):
            part = spec.body(name).add_geom(
                name=f"{whole.name}_part_{k}", type=whole.type, size=whole.size, pos=whole.pos, quat=whole.quat,
                rgba=whole.rgba, group=whole.group, contype=0, conaffinity=0, mass=0,
            )  # fmt: skip
            part.material = whole.material
            parts[whole.name].append(part.name)
    return parts


def cut_edges(model: mujoco.MjModel, parts: dict[str, list[str]]) -> CutEdges:
    """Return the parts that `add_parts` made in the compiled model."""
    whole, shortened = np.arange(model.ngeom), np.zeros((model.ngeom, 3))
    for first, names in parts.items():
        for name, short in zip(names, SHORTENED[mujoco.mjtGeom(model.geom(first).type[0])], strict=True):
            whole[model.geom(name).id], shortened[model.geom(name).id] = model.geom(first).id, short
    return CutEdges(whole, shortened)
