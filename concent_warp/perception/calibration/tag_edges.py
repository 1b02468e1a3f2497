"""Corners of a tag as the intersections of lines fitted to its four edges.

Refinement of corners by their saddle point, as `cv2.cornerSubPix` does, is right for chessboards; the outer corners
of a black square it draws inwards, by 0.25 px in images with a blur of 0.6 px, which makes a tag of 90 px 0.5 % too
small. The edges between the corners have no such bias.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

SPAN = (0.08, 0.92)
"""Part of an edge that is sampled, away from its corners [-]."""
REACH = 3.5
"""Half length of the profiles across an edge [px]; less where the tag's border is thinner."""
STEP = 0.25
"""Distance of the samples of a profile [px]."""
MIN_CONTRAST = 20.0
"""Difference of brightness across an edge below which it is not used [1/255]."""
ROUNDS = 2


def refine_corners(image: np.ndarray, corners: np.ndarray, cells: int) -> np.ndarray | None:
    """Return the corners of a tag [px], shape (4, 2), from its edges; None where an edge is not clear.

    Args:
        image: Brightness, shape (H, W).
        corners: First estimate, clockwise [px], shape (4, 2).
        cells: Cells along an edge of the tag, its border included.
    """
    for _ in range(ROUNDS):
        found = [_edge_line(image, corners[i], corners[(i + 1) % 4], cells) for i in range(4)]
        lines = np.array([line for line in found if line is not None])
        if len(lines) < 4:
            return None
        refined = np.cross(np.roll(lines, 1, axis=0), lines)
        if (np.abs(refined[:, 2]) < 1e-9).any():
            return None
        refined = refined[:, :2] / refined[:, 2:]
        if np.abs(refined - corners).max() > REACH:
            return None
        corners = refined
    return corners


def _edge_line(image: np.ndarray, start: np.ndarray, end: np.ndarray, cells: int) -> np.ndarray | None:
    """Return the line a x + b y + c = 0 of an edge as (a, b, c), shape (3,); None where it is not clear."""
    along = end - start
    length = float(np.linalg.norm(along))
    normal = np.array([along[1], -along[0]]) / length  # outwards, for corners clockwise in an image with y down
    reach = min(REACH, 0.6 * length / cells)
    count = max(int((SPAN[1] - SPAN[0]) * length), 4)
    middle = start + np.linspace(*SPAN, count)[:, None] * along
    offset = np.arange(-reach, reach + STEP / 2, STEP)
    place = middle[:, None] + offset[:, None] * normal
    height, width = image.shape
    if (place < 0).any() or (place[..., 0] > width - 1).any() or (place[..., 1] > height - 1).any():
        return None
    profile = map_coordinates(image.astype(float), [place[..., 1].ravel(), place[..., 0].ravel()], order=1)
    slope = np.clip(np.diff(profile.reshape(place.shape[:2]), axis=1), 0, None)
    rise = slope.sum(axis=1)
    clear = rise > MIN_CONTRAST
    if clear.sum() < 4:
        return None
    # Slopes far below the steepest one are noise and shading.
    slope = np.where(slope > 0.25 * slope.max(axis=1, keepdims=True), slope, 0.0)[clear]
    centre = (slope @ (offset[:-1] + STEP / 2)) / slope.sum(axis=1)
    share = np.linspace(*SPAN, count)[clear]
    good = np.ones(len(centre), dtype=bool)
    line = np.zeros(2)
    for _ in range(3):
        line = np.polyfit(share[good], centre[good], 1)
        off = np.abs(centre - np.polyval(line, share))
        good = off <= max(3 * float(np.median(off)), 0.1)
        if good.sum() < 4:
            return None
    first, last = start + np.polyval(line, 0.0) * normal, end + np.polyval(line, 1.0) * normal
    return np.cross([*first, 1.0], [*last, 1.0])
