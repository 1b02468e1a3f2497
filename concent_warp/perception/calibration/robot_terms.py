"""Distances of a frame from the robot's rendered surface and outline, their derivatives, and steps that lessen them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from concent_warp.perception.calibration.robot_surface import Surface

POSE, CLOCK, SCALE, EDGE, SHIFT, COUNT = 6, 6, 7, 8, 9, 10
"""Number of a pose's parameters, the places of the others, and the number of all: clock offset [s], logarithm of the
scale of depth, how far edges of brightness lie outside the outline [px], and how much too long depth reads [m]."""
KNOWN = {EDGE: 0.3}
"""Standard deviations of what is known of some in advance."""
TUKEY = 4.685
"""Width of Tukey's weight over the standard deviation: 95 % as efficient as least squares with normal errors."""
EDGE_WIDTH = 2.0
"""Distance from the steepest place of a profile up to which its slope counts [px]."""
MAX_SLANT = 0.15
"""Cosine of the angle of view and normal up to which a point of the outline is on a rounded part [-]."""
PROFILE = np.arange(-5.0, 5.01, 0.25)
"""Places across the outline at which brightness is read [px]."""


@dataclass(frozen=True)
class State:
    """Values that are fitted."""

    pose: np.ndarray
    """Camera-to-world, shape (4, 4)."""
    other: np.ndarray = field(default_factory=lambda: np.zeros(COUNT - POSE))
    """Clock offset [s], logarithm of the scale of depth [-], outward shift of edges [px], shift of depth [m], shape
    (4,)."""

    @property
    def offset(self) -> float:
        """Time to be added to those of frames [s]."""
        return float(self.other[CLOCK - POSE])

    @property
    def scale(self) -> float:
        """Reported over true depth [-], besides the shift."""
        return float(np.exp(self.other[SCALE - POSE]))

    @property
    def edge(self) -> float:
        """How far edges of brightness lie outside the outline [px]."""
        return float(self.other[EDGE - POSE])

    def true_depth(self, depth: np.ndarray) -> np.ndarray:
        """Return what depth would read without shift and scale [m]; 0 stays 0."""
        return np.where(depth > 0, (depth - self.other[SHIFT - POSE]) / self.scale, 0.0)

    def moved(self, step: np.ndarray) -> State:
        """Return the state after a step (10,)."""
        pose = self.pose.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(step[:3]).as_matrix()
        pose[:3, 3] += step[3:POSE]
        return replace(self, pose=pose, other=self.other + step[POSE:])


@dataclass(frozen=True)
class Equations:
    """Normal equations of one frame."""

    matrix: np.ndarray
    """Shape (10, 10)."""
    vector: np.ndarray
    """Shape (10,)."""


def depth_terms(measured: np.ndarray, surface: Surface, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances of measured points from the surface's planes [m], shape (n,), and their derivatives (n, 10).

    Args:
        measured: Points, camera frame [m], shape (n, 3).
        surface: The points that they belong to.
        pose: Camera-to-world, shape (4, 4).
    """
    world = measured @ pose[:3, :3].T + pose[:3, 3]
    residual = np.einsum("ni,ni->n", surface.normals, world - surface.points)
    in_camera = surface.normals @ pose[:3, :3]
    turn = np.cross(measured, in_camera)
    slide = -np.einsum("ni,ni->n", surface.normals, surface.velocities)
    stretch = -np.einsum("ni,ni->n", in_camera, measured)
    shift = stretch / measured[:, 2]
    return residual, np.column_stack([turn, surface.normals, slide, stretch, np.zeros(len(turn)), shift])


def outline_terms(
    brightness: np.ndarray, outline: Surface, intrinsics: np.ndarray, state: State, min_contrast: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances of edges of brightness from the robot's outline [px], shape (n,), and their derivatives (n, 10).

    Only rounded parts are used: there the normal of the surface points across the outline.

    Args:
        brightness: Image, shape (H, W).
        outline: Points of the surface on the outline.
        intrinsics: Pinhole matrix [px], shape (3, 3).
        state: The pose and the shift of edges.
        min_contrast: Change of brightness from which on an edge counts [1/255].
    """
    pose = state.pose
    local = (outline.points - pose[:3, 3]) @ pose[:3, :3]
    normals = outline.normals @ pose[:3, :3]
    grazing = np.abs(np.einsum("ni,ni->n", normals, local)) < MAX_SLANT * np.linalg.norm(local, axis=1)
    across = normals[:, :2]
    length = np.linalg.norm(across, axis=1)
    across = across / np.maximum(length, 1e-9)[:, None]
    place = outline.pixels[:, None] + PROFILE[None, :, None] * across[:, None]
    height, width = brightness.shape
    inside = ((place >= 0) & (place <= [width - 1, height - 1])).all(axis=(1, 2))
    profile = map_coordinates(brightness, [place[..., 1].ravel(), place[..., 0].ravel()], order=1, mode="nearest")
    slope = np.abs(np.diff(profile.reshape(place.shape[:2]), axis=1))
    centre = (PROFILE[:-1] + PROFILE[1:]) / 2
    peak = centre[np.argmax(slope, axis=1)]
    # The centroid of the slope about its peak; lesser slopes are shading and noise.
    near = np.abs(centre - peak[:, None]) < EDGE_WIDTH
    near &= slope > 0.25 * slope.max(axis=1, keepdims=True)
    rise = np.where(near, slope, 0.0)
    good = inside & grazing & (np.abs(peak) < PROFILE[-1] - EDGE_WIDTH) & (rise.sum(axis=1) > min_contrast)
    found = (rise @ centre) / np.maximum(rise.sum(axis=1), 1e-9)
    z = local[:, 2]
    focal = intrinsics[[0, 1], [0, 1]]
    gradient = np.column_stack(
        [across[:, 0] * focal[0] / z, across[:, 1] * focal[1] / z, -(across * focal * local[:, :2]).sum(axis=1) / z**2]
    )
    turn = np.cross(gradient, local)
    slide = np.einsum("ni,ni->n", gradient, outline.velocities @ pose[:3, :3])
    nothing = np.zeros(len(z))
    moved = np.column_stack([turn, -gradient @ pose[:3, :3].T, slide, nothing, nothing + 1, nothing])
    return found[good] - state.edge, -moved[good]


def normal_equations(residual: np.ndarray, jacobian: np.ndarray, std: float) -> Equations:
    """Return the normal equations of residuals with Tukey's weights for their standard deviation."""
    share = np.clip(np.abs(residual) / (TUKEY * std), 0, 1)
    weight = (1 - share**2) ** 2 / std**2
    return Equations((jacobian.T * weight) @ jacobian, (jacobian.T * weight) @ residual)


def spread(residual: np.ndarray) -> float:
    """Return a robust standard deviation about 0."""
    return 1.4826 * float(np.median(np.abs(residual))) if len(residual) else 0.0


def solve(
    equations: Sequence[Equations], free: Sequence[int], state: State, known: Mapping[int, float], without: int = -1
) -> np.ndarray:
    """Return the step (10,) that the equations of all frames give, with what is known in advance.

    Args:
        equations: Of each frame.
        free: Parameters that may change.
        state: The present values.
        known: Standard deviations about 0 of some parameters.
        without: A frame that is left out.
    """
    used = [e for k, e in enumerate(equations) if k != without]
    matrix, vector = sum(e.matrix for e in used), sum(e.vector for e in used)
    matrix, vector = np.array(matrix), np.array(vector)
    for place, std in known.items():
        matrix[place, place] += 1 / std**2
        vector[place] += state.other[place - POSE] / std**2
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix)[free], 1e-12))
    # Directions that no frame determines keep still; their intervals say so.
    scaled = matrix[np.ix_(free, free)] * scale * scale[:, None] + 1e-9 * np.eye(len(free))
    step = np.zeros(COUNT)
    step[free] = scale * np.linalg.solve(scaled, -scale * vector[free])
    for part, most in ((slice(0, 3), 0.1), (slice(3, POSE), 0.1), (slice(CLOCK, CLOCK + 1), 0.05)):
        step[part] *= min(1.0, most / max(float(np.linalg.norm(step[part])), 1e-12))
    return step


def half_widths(
    equations: Sequence[Equations], free: Sequence[int], state: State, known: Mapping[int, float]
) -> np.ndarray:
    """Return half widths of the 95 % intervals (10,) by a jackknife over frames."""
    count = len(equations)
    steps = np.array([solve(equations, free, state, known, without=k) for k in range(count)])
    variance = (count - 1) / count * ((steps - steps.mean(axis=0)) ** 2).sum(axis=0)
    return float(stdtrit(count - 1, 0.975)) * np.sqrt(variance)
