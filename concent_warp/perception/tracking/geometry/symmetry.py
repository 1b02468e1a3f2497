"""Turns of a shape about its middle that leave it as it is: those rotations depth and outline cannot tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.perception.tracking.geometry.pose import rotation_angle
from concent_warp.perception.tracking.geometry.shape import TrackedShape

ORDERS = (2, 3, 4, 5, 6, 8)
"""Parts of a turn that are tried about each axis."""
ANY_ANGLE = 2.0
"""Turn [rad] that is a part of no such order: a shape unchanged by it is round about the axis."""
ROUND_STEPS = 24
"""Turns that stand for all about a round axis."""
SPREAD_SAMPLES = 20_000
"""Surface points whose principal axes are tried."""
SPHERE = "sphere"
"""First word of the class of a shape that is round about every axis."""
MAX_TURNS = 120
"""Most turns listed: the icosahedron's are 60."""


@dataclass(frozen=True)
class Symmetry:
    """Turns that leave a shape as it is."""

    turns: np.ndarray
    """Rotation matrices in the body frame, shape (k, 3, 3), the first the identity; of round shapes a fine choice."""
    centre: np.ndarray
    """Point that they turn about [m], body frame, shape (3,)."""
    name: str
    """Class in words."""
    axis: np.ndarray | None = None
    """Axis about which the shape is round, shape (3,), where there is one."""
    sphere: bool = False
    """Whether the shape is round about every axis."""

    def equivalents(self, pose: np.ndarray) -> np.ndarray:
        """Return all poses that look like a pose, shape (k, 4, 4)."""
        result = np.repeat(np.eye(4)[None], len(self.turns), axis=0)
        result[:, :3, :3] = pose[:3, :3] @ self.turns
        offset = self.centre - self.turns @ self.centre
        result[:, :3, 3] = pose[:3, 3] + offset @ pose[:3, :3].T
        return result

    def chosen_turns(self) -> np.ndarray:
        """Return the projection on the axes about which every turn looks alike, body frame, shape (3, 3)."""
        if self.sphere:
            return np.eye(3)
        return np.zeros((3, 3)) if self.axis is None else np.outer(self.axis, self.axis)

    def nearest(self, pose: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return that pose of those which look like `pose` whose orientation is nearest to the target's."""
        if self.sphere:
            result = target.copy()
            result[:3, 3] = pose[:3, 3] + (pose[:3, :3] - target[:3, :3]) @ self.centre
            return result
        others = self.equivalents(pose)
        cosine = np.einsum("kij,ij->k", others[:, :3, :3], target[:3, :3])
        best = others[int(np.argmax(cosine))]
        if self.axis is None:
            return best
        # Turn about the round axis so that what is left to the target is perpendicular to it.
        rest = Rotation.from_matrix(best[:3, :3].T @ target[:3, :3]).as_quat()
        along = 2 * np.arctan2(rest[:3] @ self.axis, rest[3])
        turn = Rotation.from_rotvec(along * self.axis).as_matrix()
        result = best.copy()
        result[:3, :3] = best[:3, :3] @ turn
        result[:3, 3] += best[:3, :3] @ (self.centre - turn @ self.centre)
        return result


def symmetry_of(shape: TrackedShape, tolerance: float) -> Symmetry:
    """Return the symmetries of a shape; `tolerance` [-] is the largest change over the shape's radius that is none."""
    normals = _face_directions(shape)
    many = shape.surface.sample(SPREAD_SAMPLES, np.random.default_rng(0))[0]
    spread = np.linalg.eigh(np.cov(many.T))[1].T
    corners = _combinations(normals[: min(len(normals), 8)])
    axes = _distinct(np.concatenate([np.eye(3), normals, corners, spread]))
    slack = tolerance * shape.reach
    # The mean of sampled points is not exact; axes of symmetry pass through the middle of the support along each.
    centre = _middle(shape)
    about = [axis for axis in axes if _unchanged(shape, centre, _turn(ANY_ANGLE * axis), slack)]
    if about:
        return _round(shape, centre, about, slack)
    turns = [np.eye(3)]
    for axis in axes:
        for order in ORDERS:
            if _unchanged(shape, centre, _turn(2 * np.pi / order * axis), slack):
                turns += [_turn(2 * np.pi * k / order * axis) for k in range(1, order)]
    group = _group(turns)
    names = {1: "none", 2: "half a turn", 4: "4 rotations", 24: "cube: 24 rotations"}
    return Symmetry(np.array(group), centre, names.get(len(group), f"{len(group)} rotations"))


def _round(shape: TrackedShape, centre: np.ndarray, about: list[np.ndarray], slack: float) -> Symmetry:
    """Return the symmetry of a shape that is round about some axes, each of shape (3,)."""
    if len(about) > 1:
        every = Rotation.random(MAX_TURNS, rng=np.random.default_rng(0)).as_matrix()
        turns = np.concatenate([np.eye(3)[None], every])
        return Symmetry(turns, centre, f"{SPHERE}: no rotation can be observed", None, True)
    axis = about[0]
    across = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    over = _turn(np.pi * across / np.linalg.norm(across))
    turns = [_turn(2 * np.pi * k / ROUND_STEPS * axis) for k in range(ROUND_STEPS)]
    name = f"round about {_axis_text(axis)}"
    if _unchanged(shape, centre, over, slack):
        turns += [over @ turn for turn in turns]
        name += ", and may be turned over"
    return Symmetry(np.array(turns), centre, name, axis)


def _turn(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a rotation vector [rad]."""
    return Rotation.from_rotvec(vector).as_matrix()


def _axis_text(axis: np.ndarray) -> str:
    """Return an axis in words."""
    return "the axis (" + ", ".join(f"{v:.2g}" for v in np.round(axis, 2) + 0.0) + ")"


def _middle(shape: TrackedShape) -> np.ndarray:
    """Return the mean of many surface points [m], shape (3,), each coordinate moved to the bounds' middle if near."""
    points = np.concatenate([shape.points, shape.edges.point])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.where(np.abs(middle - shape.centre) < 0.1 * shape.radius, middle, shape.centre)


def _face_directions(shape: TrackedShape) -> np.ndarray:
    """Return up to 12 frequent normals, shape (k, 3)."""
    left = shape.normals
    found: list[np.ndarray] = []
    while len(left) and len(found) < 12:
        near = np.abs(left @ left.T) > 0.999
        best = int(near.sum(axis=1).argmax())
        if near[best].sum() < 0.02 * len(shape.normals):
            break
        found.append(left[best])
        left = left[~near[best]]
    return np.array(found).reshape(-1, 3)


def _combinations(normals: np.ndarray) -> np.ndarray:
    """Return directions between two or three normals, to edges and corners, shape (k, 3)."""
    signed = np.concatenate([normals, -normals])
    pairs = (signed[:, None] + signed[None]).reshape(-1, 3)
    triples = (signed[:, None, None] + signed[None, :, None] + signed[None, None]).reshape(-1, 3)
    every = np.concatenate([pairs, triples]) if len(normals) <= 4 else pairs
    length = np.linalg.norm(every, axis=1)
    return every[length > 0.3] / length[length > 0.3][:, None]


def _distinct(axes: np.ndarray) -> np.ndarray:
    """Return unit vectors without those along another, shape (k, 3)."""
    found: list[np.ndarray] = []
    for axis in axes:
        if all(abs(axis @ other) < 0.999 for other in found):
            found.append(axis / np.linalg.norm(axis))
    return np.array(found)


def _unchanged(shape: TrackedShape, centre: np.ndarray, turn: np.ndarray, slack: float) -> bool:
    """Return whether surface points and edges, after a turn, lie on the surface within `slack` [m]."""
    points = np.concatenate([shape.points, shape.edges.point[shape.edges.crease]])
    distance = np.abs(shape.surface.signed_distance((points - centre) @ turn.T + centre))
    return bool(np.quantile(distance, 0.99) < slack)


def _group(turns: list[np.ndarray]) -> list[np.ndarray]:
    """Return all products of turns."""
    found = [np.eye(3)]
    for turn in turns:
        if all(rotation_angle(turn, other) > 0.01 for other in found):
            found.append(turn)
    grown = True
    while grown and len(found) < MAX_TURNS:
        grown = False
        for a in list(found):
            for b in list(found):
                product = a @ b
                if all(rotation_angle(product, other) > 0.01 for other in found):
                    found.append(product)
                    grown = True
    return found
