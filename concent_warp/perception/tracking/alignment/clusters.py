"""What a frame shows in front of all that is known, in clusters, and the part of it that a user pointed at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from concent_warp.perception.pinhole import pixel_grid
from concent_warp.perception.tracking.alignment.rows import MAD
from concent_warp.perception.tracking.cfg import SearchCfg, TrackCfg
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.view import View

MAX_CLUSTERS = 6
"""Clusters, the largest, that are looked at."""
LEAST_SPREAD = 0.25
"""Spread of a cluster over the shape's radius below which it is too small to be the shape [-]."""
CLICK_RADIUS = 12.0
"""Distance of a click from the pixels of the cluster that it names, at most, per 640 pixels of the width [px]."""
BOX_SLACK = 0.05
"""Widening of a drawn box on each side, over its size, within which the body's outline has to lie [-]."""
MIN_IN_BOX = 0.8
"""Least share of a body's visible pixels that lie in the widened box [-]."""


@dataclass(frozen=True)
class Cluster:
    """Measured points of one unknown thing, or of several that are near one another."""

    points: np.ndarray
    """Points [m], world frame, shape (n, 3)."""
    pixels: np.ndarray
    """Their pixels (column, row), shape (n, 2)."""


@dataclass(frozen=True)
class Region:
    """Where a user says that a body is in one camera's image."""

    click: tuple[float, float] | None = None
    """A pixel on the body (column, row) [px]."""
    box: tuple[float, float, float, float] | None = None
    """A box around the body: left, top, right, bottom [px]."""

    def restricted(self, clusters: list[Cluster], view: View, shape: TrackedShape) -> list[Cluster]:
        """Return what of some clusters may be the body: for a click, what is near it in the image and in space."""
        if self.box is not None:
            inside = [_in_box(c.pixels, self.box, 0.0) for c in clusters]
            return [Cluster(c.points[k], c.pixels[k]) for c, k in zip(clusters, inside, strict=True) if k.any()]
        if self.click is None or not clusters:
            return clusters
        distances = [np.linalg.norm(c.pixels - np.array(self.click), axis=1) for c in clusters]
        nearest = int(np.argmin([d.min() for d in distances]))
        if distances[nearest].min() > CLICK_RADIUS * view.shape[1] / 640:
            return []
        cluster = clusters[nearest]
        here = cluster.points[distances[nearest].argmin()]
        near = np.linalg.norm(cluster.points - here, axis=1) < 2 * shape.reach
        return [Cluster(cluster.points[near], cluster.pixels[near])]

    def admits(self, renderer: RayRenderer, view: View, shape: TrackedShape) -> bool:
        """Return whether the body, which the renderer has at its pose, is seen where the user says."""
        if self.click is not None:
            # A click beside the outline by a pixel or two is one on the body.
            reach = np.arange(-2.0, 3.0)
            around = np.array(self.click) + np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
            return bool((renderer.cast(view.camera, around).body == shape.row).any())
        if self.box is None:
            return True
        stride = max(1, view.shape[1] // 320)
        pixels = pixel_grid(*view.shape)[::stride, ::stride].reshape(-1, 2)
        own = pixels[renderer.cast(view.camera, pixels).body == shape.row]
        return len(own) > 0 and bool(_in_box(own, self.box, BOX_SLACK).mean() >= MIN_IN_BOX)

    def text(self) -> str:
        """Return this in words."""
        if self.click is not None:
            return f"the click at {self.click[0]:g}, {self.click[1]:g}"
        return "the box " + ", ".join(f"{v:g}" for v in self.box or ())


def _in_box(pixels: np.ndarray, box: tuple[float, float, float, float], slack: float) -> np.ndarray:
    """Return which pixels (n, 2) lie in a box that is widened on each side by a share of its size, shape (n,)."""
    low, high = np.array(box[:2]), np.array(box[2:])
    wider = slack * (high - low)
    return np.asarray(((pixels >= low - wider) & (pixels <= high + wider)).all(axis=1))


@dataclass(frozen=True)
class Foreground:
    """A frame's depth against that of all that is known, on a regular grid of pixels."""

    grid: np.ndarray
    """Pixels (column, row), shape (h, w, 2)."""
    measured: np.ndarray
    """Measured depth [m], shape (h, w), 0 where there is none."""
    misfit: np.ndarray
    """Square of the difference to what is known, over the tolerance, at most 1, shape (h, w)."""
    tolerance: float
    """Difference of depth that counts as full disagreement [m]."""
    clusters: list[Cluster]
    """What is in front of all that is known and may be the shape, largest first."""

    def gain(self, renderer: RayRenderer, view: View, shape: TrackedShape, pose: np.ndarray) -> float:
        """Return how many pixels more a body at a pose explains than the known things alone: those on it that agree,
        less those on it that see something else.
        """
        window = view.window(pose[:3, :3] @ shape.centre + pose[:3, 3], shape.reach)
        if window is None:
            return 0.0
        rows, columns = self.grid[:, 0, 1], self.grid[0, :, 0]
        part = np.ix_(
            (rows >= window[0].start) & (rows < window[0].stop),
            (columns >= window[1].start) & (columns < window[1].stop),
        )
        pixels, measured = self.grid[part].reshape(-1, 2), self.measured[part].ravel()
        renderer.place(shape.row, pose)
        hits = renderer.cast(view.camera, pixels)
        own = (hits.body == shape.row) & (measured > 0)
        misfit = np.minimum(((measured[own] - hits.depth[own]) / self.tolerance) ** 2, 1.0)
        return float((self.misfit[part].ravel()[own] - misfit).sum())


def foreground(renderer: RayRenderer, view: View, shape: TrackedShape, cfg: TrackCfg) -> Foreground:
    """Return what is measured in front of all that the renderer knows.

    Bodies before it may cut what is seen of it into parts: clusters are listed alone, and together with all others
    that are within its size.
    """
    import cv2

    height, width = view.shape
    search = cfg.search
    stride = grid_stride(view, shape, search)
    grid = pixel_grid(height, width)[stride // 2 :: stride, stride // 2 :: stride]
    size = grid.shape[:2]
    hits = renderer.cast(view.camera, grid.reshape(-1, 2))
    expected = hits.depth.reshape(size)
    columns, rows = grid[..., 0].astype(int), grid[..., 1].astype(int)
    measured = view.depth[rows, columns].astype(float)
    flat = np.where(np.isfinite(expected), expected, 1e3)
    noise = search.foreground_noise * view.depth_noise(measured)
    front = (measured > 0) & (measured < expected - np.maximum(search.foreground, noise))
    front &= ~_rim(expected, search.depth_jump) & view.may_show(grid.reshape(-1, 2)).reshape(size)
    # A kernel of even size moves what it opens by a pixel, onto some that are not in front.
    front &= cv2.morphologyEx(front.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
    # Where depth jumps from pixel to pixel, one thing ends and another begins.
    shown = np.where(measured > 0, measured, np.nan)
    jump = np.zeros(size, dtype=bool)
    with np.errstate(invalid="ignore"):
        # The noise of a difference is that of a depth times the root of 2.
        step = np.maximum(search.depth_jump, np.sqrt(2) * noise)
        jump[:, 1:] |= np.abs(np.diff(shown, axis=1)) > step[:, 1:]
        jump[1:] |= np.abs(np.diff(shown, axis=0)) > step[1:]
    count, label = cv2.connectedComponents((front & ~jump).astype(np.uint8), connectivity=4)
    found = []
    for k in range(1, count):
        inside = label == k
        if inside.sum() >= search.min_cluster:
            at = grid[inside]
            found.append(Cluster(view.camera.lift(at, measured[inside]), at))
    found = sorted(found, key=lambda c: -len(c.points))[:MAX_CLUSTERS]
    clusters = [c for c in (*found, *_joined(found, shape)) if _may_be(c, shape)]
    known = np.abs(measured - flat)[(measured > 0) & (np.abs(measured - flat) < search.foreground)]
    scatter = MAD * float(np.median(known)) if len(known) else 0.0
    tolerance = max(cfg.accept.depth_tolerance, 4 * scatter)
    misfit = np.where(measured > 0, np.minimum(((measured - flat) / tolerance) ** 2, 1.0), 0.0)
    return Foreground(grid, measured, misfit, tolerance, clusters)


def _rim(depth: np.ndarray, jump: float) -> np.ndarray:
    """Return the rims of what is known, which are not where they should be by a pixel or so, shape (h, w).

    They are where depth [m], infinite beside everything, deviates from a plane by more than `jump` [m] from pixel to
    pixel; inverse depth is linear on a plane, however slanted.
    """
    inverse = 1 / depth
    nearest = maximum_filter(inverse, 3)
    rim = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        edge = np.pad(inverse, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="reflect", reflect_type="odd")
        second = np.abs(np.diff(edge, 2, axis=axis))
        rim |= second > jump * nearest**2
    return rim


def grid_stride(view: View, shape: TrackedShape, cfg: SearchCfg) -> int:
    """Return the distance of the pixels that a search looks at [px], by the shape's size at the scene's depth."""
    coarse = view.depth[::8, ::8]
    known = coarse[coarse > 0]
    if not len(known):
        return 1
    size = 2 * shape.reach * float(view.camera.intrinsics[0, 0]) / float(np.median(known))
    return int(np.clip(size / cfg.across, 1, max(view.shape[1] // 80, 1)))


def _joined(clusters: list[Cluster], shape: TrackedShape) -> list[Cluster]:
    """Return each cluster with those points of the others that one body could show together with it."""
    result, seen = [], set()
    for k, cluster in enumerate(clusters):
        middle = np.median(cluster.points, axis=0)
        near = [np.linalg.norm(c.points - middle, axis=1) < 2 * shape.reach for c in clusters]
        parts = tuple(j for j in range(len(clusters)) if j == k or near[j].mean() > 0.5)
        if len(parts) > 1 and parts not in seen:
            seen.add(parts)
            result.append(
                Cluster(
                    np.concatenate([clusters[j].points for j in parts]),
                    np.concatenate([clusters[j].pixels for j in parts]),
                )
            )
    return result


def _may_be(cluster: Cluster, shape: TrackedShape) -> bool:
    """Return whether a cluster may be the shape, or hold it together with what it touches."""
    spread = np.linalg.norm(cluster.points - np.median(cluster.points, axis=0), axis=1)
    return bool(np.quantile(spread, 0.9) > LEAST_SPREAD * shape.radius)
