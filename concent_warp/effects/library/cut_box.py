"""A box with tilted faces and cut edges, and spheres that follow its faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import HalfspaceIntersection

AXES = "xyz"
SIDES, SIGNS = "+-", (1.0, -1.0)
FACE_PARTS = tuple(f"face_{a}{s}" for s in SIDES for a in AXES)
"""One face that is tilted."""
PAIR_PARTS = tuple(f"faces_{a}" for a in AXES)
"""Two opposite faces that are tilted alike: the box is skew."""
EDGE_PARTS = tuple(f"edge_{a}{s}{b}{t}" for a, b in ("xy", "xz", "yz") for s in SIDES for t in SIDES)
"""One edge that is cut, named after its two faces."""
ALL_EDGES = "edges"
PARTS = (*FACE_PARTS, *PAIR_PARTS, *EDGE_PARTS, ALL_EDGES)
"""What of a box is off."""
MAX_TILT = 0.3
"""Largest tilt of a face over the half size of the box across it [-]: two at once leave the middle inside."""
MAX_CUT = 0.8
"""Largest width of a cut over the smaller half size across the edge [-]."""
MIN_GAP = 1e-7
"""Distance over the size of a box below which two corners are one [-]."""


@dataclass(frozen=True)
class CutBox:
    """The points of a box between tilted faces and within cuts of its edges at 45 degrees, in the frame of the box."""

    half: np.ndarray
    """Half sizes of the box [m], shape (3,)."""
    tilt: np.ndarray
    """How far each face lies further out at the positive end of each other axis, and further in at its negative end
    [m]: by the side of the face (+, -), the axis across it and the other axis, shape (2, 3, 3)."""
    cut: np.ndarray
    """Width of the cut of each edge on both of its faces [m]: by the axis along it and its sides (+, -) along the
    two others, in order, shape (3, 2, 2)."""

    @staticmethod
    def of(half: np.ndarray, part: str, values: np.ndarray) -> CutBox:
        """Return the box whose part has some values, in the order of `names`."""
        tilt, cut = np.zeros((2, 3, 3)), np.zeros((3, 2, 2))
        if part == ALL_EDGES:
            cut[:] = values[0]
        elif part in EDGE_PARTS:
            along, a, b = _edge(part)
            cut[along, a, b] = values[0]
        else:
            across, sides = _faces(part)
            for side in sides:
                # Opposite faces that are tilted alike lie further out at opposite ends.
                tilt[side, across, _others(across)] = values if len(sides) == 1 or not side else -values
        return CutBox(half, tilt, cut)

    @property
    def is_plain(self) -> bool:
        """Whether it is the box itself."""
        return not self.tilt.any() and not self.cut.any()

    def corners(self) -> np.ndarray:
        """Return the corners, shape (n, 3)."""
        planes = [self._face(s, k) for s in range(2) for k in range(3)]
        for along in range(3):
            for a in range(2):
                for b in range(2):
                    if self.cut[along, a, b] > 0:
                        planes.append(self._cut_plane(along, a, b))
        size = float(self.half.max())
        found = HalfspaceIntersection(np.array(planes) / [1, 1, 1, size], np.zeros(3)).intersections
        kept: list[np.ndarray] = []
        for corner in found:  # several planes through one corner give it several times
            if all(np.abs(corner - other).max() > MIN_GAP for other in kept):
                kept.append(corner)
        return size * np.array(kept)

    def moved(self, points: np.ndarray, radius: np.ndarray, skin: float) -> np.ndarray:
        """Return where spheres lie that follow the faces and stay within the cuts, shape (n, 3).

        Args:
            points: Their centres [m], shape (n, 3).
            radius: Their radii [m], shape (n,).
            skin: Distance from a face, in radii, below which a sphere moves with the face [-]; inside of that it moves
                by a share that falls linearly to 0 at the opposite face.
        """
        found, place = points.copy(), points / self.half
        for k in range(3):
            inside = 2 * self.half[k] - 2 * skin * radius
            share = np.clip((points[:, k] + self.half[k] - skin * radius) / np.maximum(inside, 1e-12), 0.0, 1.0)
            share = np.where(inside > 0, share, 0.5)
            found[:, k] += share * (place @ self.tilt[0, k]) - (1 - share) * (place @ self.tilt[1, k])
        for along in range(3):
            for a in range(2):
                for b in range(2):
                    if self.cut[along, a, b] > 0:
                        *normal, offset = self._cut_plane(along, a, b)
                        out = np.maximum(found @ normal + np.sqrt(2) * radius + offset, 0.0)
                        found -= 0.5 * out[:, None] * normal
        return found

    def _face(self, side: int, across: int) -> np.ndarray:
        """Return the plane of a face: the half space n x + d <= 0 as (n, d), shape (4,)."""
        plane = np.append(-self.tilt[side, across] / self.half, -self.half[across])
        plane[across] = SIGNS[side]
        return plane

    def _cut_plane(self, along: int, a: int, b: int) -> np.ndarray:
        """Return the plane of a cut, as that of a face; its normal has the length sqrt(2)."""
        one, other = _others(along)
        plane = np.zeros(4)
        plane[one], plane[other] = SIGNS[a], SIGNS[b]
        plane[3] = self.cut[along, a, b] - self.half[one] - self.half[other]
        return plane


def names(part: str) -> tuple[str, ...]:
    """Return the names of the parameters of a part: the other axes along which a face is tilted, or ``cut``."""
    if part == ALL_EDGES or part in EDGE_PARTS:
        return ("cut",)
    return tuple(f"tilt_{AXES[k]}" for k in _others(_faces(part)[0]))


def largest(half: np.ndarray, part: str) -> float:
    """Return the largest value of each parameter of a part of a box with half sizes (3,) [m]."""
    if part == ALL_EDGES:
        return float(MAX_CUT * half.min())
    if part in EDGE_PARTS:
        return float(MAX_CUT * half[_others(_edge(part)[0])].min())
    return float(MAX_TILT * half[_faces(part)[0]])


def _faces(part: str) -> tuple[int, tuple[int, ...]]:
    """Return the axis across one or two faces, and their sides."""
    word = part.partition("_")[2]
    return AXES.index(word[0]), (SIDES.index(word[1]),) if part in FACE_PARTS else (0, 1)


def _edge(part: str) -> tuple[int, int, int]:
    """Return the axis along an edge, and its sides along the two others."""
    a, s, b, t = part.partition("_")[2]
    (along,) = {0, 1, 2} - {AXES.index(a), AXES.index(b)}
    return along, SIDES.index(s), SIDES.index(t)


def _others(axis: int) -> list[int]:
    """Return the two other axes, in order."""
    return [k for k in range(3) if k != axis]
