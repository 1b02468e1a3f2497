"""Camera and target pose in closed form from the motion of the bodies that carry them.

With the camera at X on its body, the target at Y on its own, H(t) the pose of the camera's body in that of the
target's, and C(t) the pose of the target in the camera's frame: H(t) X C(t) = Y, so A X = X B for pairs of frames,
with A = H_j^-1 H_i and B = C_j C_i^-1. Solved by Park and Martin, "Robot sensor calibration: solving AX = XB on the
Euclidean group", IEEE Transactions on Robotics and Automation 10(5), 1994. Camera on the hand and target in the
world, or the reverse, are the same here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.perception.calibration.targets import TargetView

SIZE_WEIGHT = 0.02
"""Weight of a target of its stated size, as the translation of a pair that it outweighs [m]."""
MAX_PAIRS = 4000
"""Pairs of frames that are used."""
DISTINCT = 1.5
"""Reprojection error of the second solution of a planar pose over that of the first, above which the first is sure."""


@dataclass(frozen=True)
class HandEye:
    """A closed-form solution."""

    camera: np.ndarray
    """Camera to its body, shape (4, 4)."""
    target: np.ndarray
    """Target to its body, shape (4, 4)."""
    size: float
    """True over stated size of the target [-]."""
    angle_error: float
    """Median disagreement of the views about the target's orientation [rad]."""
    position_error: float
    """The same about its position [m]."""


def target_poses(view: TargetView, intrinsics: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Return the possible poses (4, 4) of a target in the camera's frame, with reprojection errors [px], best first.

    A planar target has two (Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109, 2014).
    """
    import cv2

    middle = view.points.mean(axis=0)
    _, turns, shifts, errors = cv2.solvePnPGeneric(
        view.points - middle, view.pixels, intrinsics, None, flags=cv2.SOLVEPNP_IPPE
    )
    found = []
    for turn, shift, error in zip(turns, shifts, np.ravel(errors), strict=True):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(np.ravel(turn)).as_matrix()
        pose[:3, 3] = np.ravel(shift) - pose[:3, :3] @ middle
        found.append((pose, float(error)))
    return sorted(found, key=lambda one: one[1])


def is_distinct(solutions: list[tuple[np.ndarray, float]]) -> bool:
    """Return whether the first of the poses of a target is clearly better than the second."""
    return len(solutions) < 2 or solutions[1][1] > DISTINCT * solutions[0][1] + 0.05


def pairs_of(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of pairs of views, evenly thinned where there are many."""
    first, second = np.triu_indices(count, 1)
    step = max(len(first) // MAX_PAIRS, 1)
    return first[::step], second[::step]


def rotation_spread(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return root mean square rotation [rad] between views about three perpendicular axes, and the axes as rows.

    Args:
        poses: Relative poses H of the two bodies, shape (n, 4, 4); axes are in the frame of the camera's body.
    """
    first, second = pairs_of(len(poses))
    turn = Rotation.from_matrix(np.swapaxes(poses[second, :3, :3], 1, 2) @ poses[first, :3, :3]).as_rotvec()
    _, size, axes = np.linalg.svd(turn, full_matrices=False)
    size = np.pad(size, (0, 3 - len(size)))
    return size / np.sqrt(len(first)), axes


def park_martin(relative: np.ndarray, seen: np.ndarray) -> HandEye:
    """Return camera and target pose from views.

    Args:
        relative: Poses H of the camera's body in the frame of the target's body, shape (n, 4, 4).
        seen: Poses C of the target in the camera's frame, shape (n, 4, 4).
    """
    first, second = pairs_of(len(relative))
    back, ahead = np.linalg.inv(relative), np.linalg.inv(seen)
    a, b = back[second] @ relative[first], seen[second] @ ahead[first]
    alpha, beta = (Rotation.from_matrix(m[:, :3, :3]).as_rotvec() for m in (a, b))
    lengths = np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)
    # The angle of a rotation is the same for hand and eye; near half a turn its axis may flip.
    fits = np.abs(lengths[0] - lengths[1]) < 3 * np.median(np.abs(lengths[0] - lengths[1])) + np.radians(0.5)
    fits &= np.maximum(*lengths) < np.radians(170)
    # Park and Martin's (M'M)^-1/2 M' is the orthogonal factor of the correlation of the rotation vectors.
    left, _, right = np.linalg.svd(alpha[fits].T @ beta[fits])
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    camera = np.eye(4)
    camera[:3, :3] = turn
    # Unknowns are the camera's position and the size of the target, which scales what the camera sees of translations.
    left = np.concatenate([a[fits, :3, :3] - np.eye(3), -(b[fits, :3, 3] @ turn.T)[:, :, None]], axis=2).reshape(-1, 4)
    right = -a[fits, :3, 3].ravel()
    left = np.concatenate([left, [[0, 0, 0, SIZE_WEIGHT * np.sqrt(len(right))]]])
    right = np.append(right, left[-1, 3])
    weight, solution = np.ones(len(right)), np.zeros(4)
    for _ in range(5):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(root[:, None] * left, root * right, rcond=None)[0]
        off = np.abs(left @ solution - right)
        weight = 1 / np.maximum(off, 1e-3)  # least absolute deviations
        weight[-1] = np.median(weight)
    camera[:3, 3], size = solution[:3], float(solution[3])
    target, errors = placed_target(relative, camera, seen, size)
    return HandEye(camera, target, size, *errors)


def placed_target(
    relative: np.ndarray, camera: np.ndarray, seen: np.ndarray, size: float = 1.0
) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the pose of a target on its body that the middle of the views gives, and the views' median errors.

    Args:
        relative: Poses H of the camera's body in the frame of the target's body, shape (n, 4, 4).
        camera: Camera to its body, shape (4, 4).
        seen: Poses of the target in the camera's frame, as of its stated size, shape (n, 4, 4).
        size: True over stated size [-].

    Returns:
        The pose (4, 4), and the errors of orientation [rad] and position [m].
    """
    scaled = seen.copy()
    scaled[:, :3, 3] *= size
    placed = relative @ camera @ scaled
    target = np.eye(4)
    middle = Rotation.from_matrix(placed[:, :3, :3])
    centre = middle.mean()
    for _ in range(5):
        off = (centre.inv() * middle).magnitude()
        centre = Rotation.from_matrix(placed[off <= np.median(off) + 1e-9, :3, :3]).mean()
    target[:3, :3], target[:3, 3] = centre.as_matrix(), np.median(placed[:, :3, 3], axis=0)
    angle = float(np.median((centre.inv() * middle).magnitude()))
    distance = float(np.median(np.linalg.norm(placed[:, :3, 3] - target[:3, 3], axis=1)))
    return target, (angle, distance)
