"""Lines that a camera sees of a body: its contour and the creases between its faces, as segments in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.view import View

ASIDE = 0.02
"""Distance from an edge, over the body's reach, at which is looked up what covers it [-]."""
SLACK = 0.04
"""Distance of another body in front, over the body's reach, from which on it covers an edge [-]."""
OWN_SLACK = 0.15
"""The same of the body itself [-]: at the contour of round shapes, triangles lie that far behind the exact surface."""
FARTHEST = 10.0
"""Places farther outside the image than this many of its sizes are left out."""


@dataclass(frozen=True)
class Outline:
    """Segments of the lines of a body in an image."""

    segments: np.ndarray
    """Ends (column, row) of the segments [px], shape (n, 2, 2)."""
    covered: np.ndarray
    """Whether another body covers the segment, shape (n,) bool."""


def outline(renderer: RayRenderer, view: View, shape: TrackedShape, pose: np.ndarray) -> Outline:
    """Return the lines of a body at a pose; those that it covers itself are left out.

    Args:
        renderer: Scene in the state of the frame, the body at `pose`.
        view: The frame.
        shape: The body.
        pose: Its pose, shape (4, 4).
    """
    edges, rotation = shape.edges, pose[:3, :3].T
    points = edges.point @ rotation + pose[:3, 3]
    facing = np.einsum("nfk,nk->nf", edges.normals, (points - view.camera.position) @ pose[:3, :3]) < 0
    contour = facing[:, 0] != facing[:, 1]
    use = np.flatnonzero(contour | (edges.crease & facing.any(axis=1)))
    # What lies over a contour is looked up beside it, on the face that is seen: beyond it is the background.
    front = np.where(facing[use, 0], 0, 1)
    beside = points[use] + ASIDE * shape.reach * edges.inward[use, front] @ rotation
    pixels, depth, _ = view.pixel_rows(beside)
    hits = renderer.cast(view.camera, pixels)
    own = hits.body == shape.row
    hidden = hits.depth < depth - np.where(own, OWN_SLACK, SLACK) * shape.reach
    half = edges.half[use, None] * edges.direction[use] @ rotation
    ends = np.concatenate([points[use] - half, points[use] + half])
    places, ahead, _ = view.pixel_rows(ends)
    near = (np.abs(places) < FARTHEST * max(view.shape)).all(axis=1) & (ahead > 1e-3)
    count = len(use)
    drawn = near[:count] & near[count:] & ~(hidden & own)
    segments = np.stack([places[:count], places[count:]], axis=1)[drawn]
    return _joined(segments, edges.edge[use][drawn], np.flatnonzero(drawn), hidden[drawn])


def _joined(segments: np.ndarray, edge: np.ndarray, row: np.ndarray, covered: np.ndarray) -> Outline:
    """Return an outline in which neighbouring pieces (n, 2, 2) of the same edge (n,) are one segment."""
    if not len(segments):
        return Outline(np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))
    new = (np.diff(edge) != 0) | (np.diff(row) != 1) | (np.diff(covered.astype(int)) != 0)
    first = np.concatenate([[0], np.flatnonzero(new) + 1])
    last = np.concatenate([first[1:] - 1, [len(segments) - 1]])
    return Outline(np.stack([segments[first, 0], segments[last, 1]], axis=1), covered[first])
