"""Linearised residuals of a pose in one frame: depth against the shape's surface, and edges of the image.

The pose's unknowns are a twist (`pose`). Depth is compared along the lines of sight, with the derivative of
point-to-plane ICP (Chen and Medioni, "Object modelling by registration of multiple range images", IVC 10(3), 1992) and
the association of projective ICP. Edges are searched along the normal of the projected contour and creases (Harris,
"Tracking with rigid models", 1992). Both are weighted by Tukey's function of residual over scatter, the scatter being
that of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from concent_warp.perception.tracking.cfg import AlignCfg
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.view import View

MAD = 1.4826
"""Standard deviation over median absolute deviation of normal noise."""
MAX_INFLATION = 30.0
"""Largest factor by which correlated residuals raise a variance."""
DEFAULT_INFLATION = 2.0
"""The same where there is too little to estimate it from."""
NOISE_WINDOW = 100
"""Rows and columns, at most, in which the noise of depth is looked at [px]."""
CORRELATED = 4
"""Distance from which on depth noise is independent [px]."""
PROFILE = (-1.0, -0.6, -0.3, 0.3, 0.6, 1.0)
"""Places along the line of search, over its half length, where what is rendered is looked up [-]."""
MIN_OWN_PLACE = 24
"""Edges from which on a place is fitted to them alone: eight for each of its unknowns."""
OWN_PLACE_ROUNDS = 3
"""Rounds of reweighting of that fit."""
NEAR = 0.015
"""Standard deviation of its distance from the given one [m]."""
INSIDE = 0.7
"""Distance inside a contour at which is looked up what covers it [px]."""
EDGE_SIDES = 8
"""Directions of an edge's normal in the image that have an error of their own."""
BIASES = 3 + EDGE_SIDES
"""Common errors of a frame: of inverse depth [1/m], of its change across the image in either direction [1/m], and of
the edges' places on each side [px]."""


def bias_stds(cfg: AlignCfg) -> np.ndarray:
    """Return the standard deviations of the common errors, shape (BIASES,)."""
    return np.array([cfg.depth_bias_std, *[cfg.depth_tilt_std] * 2, *[cfg.edge_bias_std] * EDGE_SIDES])


@dataclass(frozen=True)
class Normal:
    """Normal equations of a pose: ``information @ twist = gradient``."""

    information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    """Shape (6, 6)."""
    gradient: np.ndarray = field(default_factory=lambda: np.zeros(6))
    """Shape (6,)."""
    bias: np.ndarray = field(default_factory=lambda: np.zeros((6, BIASES)))
    """Change of the gradient per unit of a common error, shape (6, BIASES)."""

    def __add__(self, other: Normal) -> Normal:
        """Return the sum of two sets of independent residuals."""
        return Normal(self.information + other.information, self.gradient + other.gradient, self.bias + other.bias)


def weighted(
    jacobian: np.ndarray,
    residual: np.ndarray,
    least: float,
    cfg: AlignCfg,
    inflation: float = 1.0,
    left: np.ndarray | None = None,
) -> tuple[Normal, np.ndarray, float]:
    """Return normal equations, weights (n,) and scatter of residuals (n,) with derivatives (n, 6).

    Args:
        jacobian: Derivatives of the prediction, shape (n, 6).
        residual: Measurement minus prediction, shape (n,).
        least: Least scatter, in the residual's unit.
        cfg: Settings.
        inflation: Factor of the variance for correlated residuals.
        left: What another pose leaves of them, which scatter and weights are taken from, shape (n,); all by default.
    """
    left = residual if left is None else left
    scatter = max(MAD * float(np.median(np.abs(left))), least)
    ratio = left / (cfg.outlier_factor * scatter)
    weight = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
    scaled = jacobian * (weight / (scatter**2 * inflation))[:, None]
    return Normal(scaled.T @ jacobian, scaled.T @ residual), weight, scatter


def point_jacobian(points: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the derivative, shape (n, 6), of the points' motion along directions (n, 3), by the body's twist."""
    return np.concatenate([direction, np.cross(points - origin, direction)], axis=1)


@dataclass(frozen=True)
class Crop:
    """What a camera should see around a body, on a grid of pixels."""

    rows: np.ndarray
    """Image rows [px], shape (h,)."""
    columns: np.ndarray
    """Image columns [px], shape (w,)."""
    depth: np.ndarray
    """Depth of the first surface [m], shape (h, w)."""
    own: np.ndarray
    """Whether this is the body, shape (h, w) bool."""
    normal: np.ndarray
    """Normals, world frame, shape (h, w, 3)."""
    rays: np.ndarray
    """Rays scaled to a depth of 1, world frame, shape (h, w, 3)."""
    measured: np.ndarray
    """Measured depth [m], shape (h, w), 0 where there is none."""
    mask: np.ndarray
    """Pixels that may be the body's by the frame's mask, shape (h, w) bool; all where it has none."""
    centre: np.ndarray
    """Middle of the body [m], world frame, shape (3,)."""
    reach: float
    """The body's reach [m]."""


def rendered_crop(renderer: RayRenderer, view: View, shape: TrackedShape, pose: np.ndarray, most: int) -> Crop | None:
    """Return the surroundings of a body at a pose, which the renderer is set to; None where it is out of the image.

    Args:
        renderer: Scene in the state of this frame, the body at `pose`.
        view: The frame.
        shape: The body.
        pose: Its pose, shape (4, 4).
        most: Largest number of the body's pixels, about.
    """
    centre = pose[:3, :3] @ shape.centre + pose[:3, 3]
    window = view.window(centre, shape.reach)
    if window is None:
        return None
    area = (window[0].stop - window[0].start) * (window[1].stop - window[1].start)
    stride = max(1, round(np.sqrt(0.4 * area / most)))
    rows, columns = (
        np.arange(window[0].start, window[0].stop, stride),
        np.arange(window[1].start, window[1].stop, stride),
    )
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(float)
    hits = renderer.cast(view.camera, grid)
    size = (len(rows), len(columns))
    return Crop(
        rows,
        columns,
        hits.depth.reshape(size),
        (hits.body == shape.row).reshape(size),
        hits.normal.reshape(*size, 3),
        hits.rays.reshape(*size, 3),
        view.depth[np.ix_(rows, columns)].astype(float),
        np.ones(size, dtype=bool) if view.mask is None else view.mask[np.ix_(rows, columns)],
        centre,
        shape.reach,
    )


def depth_rows(
    renderer: RayRenderer, crop: Crop, view: View, pose: np.ndarray, gate: float, cfg: AlignCfg, *, final: bool
) -> tuple[Normal, float, int]:
    """Return the normal equations of depth, its scatter [m] and the number of pixels used.

    Args:
        renderer: Scene in the state of this frame.
        crop: What the camera should see.
        view: What it sees.
        pose: Of the body, shape (4, 4).
        gate: Difference above which a pixel is left out [m], unless the frame's noise is larger.
        cfg: Settings.
        final: Whether the covariance counts, so that the correlation of the noise is estimated.
    """
    import cv2

    inner = cv2.erode(crop.own.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    mask = inner if inner.sum() > 0.4 * crop.own.sum() else crop.own
    slope = -np.einsum("hwk,hwk->hw", crop.normal, crop.rays)
    difference = np.where(mask, crop.measured - np.where(mask, crop.depth, 0.0), 0.0)
    if mask.any():
        gate = max(gate, cfg.gate_noise * float(view.depth_noise(crop.depth[mask].mean())))
    used = mask & crop.mask & (crop.measured > 0) & (np.abs(difference) < gate)
    used &= slope > cfg.slant * np.linalg.norm(crop.rays, axis=2)
    count = int(used.sum())
    if count < 6:
        return Normal(), np.nan, count
    rays, depth = crop.rays[used], crop.depth[used]
    points = view.camera.position + depth[:, None] * rays
    direction = -crop.normal[used] / slope[used][:, None]
    jacobian = point_jacobian(points, pose[:3, 3], direction)
    residual = difference[used]
    inflation = 1.0
    if final:
        spread = max(MAD * float(np.median(np.abs(residual))), cfg.min_depth_std)
        inflation = noise_inflation(renderer, view, crop, spread)
    normal, weight, scatter = weighted(jacobian, residual, cfg.min_depth_std, cfg, inflation)
    scaled = jacobian * (weight / (scatter**2 * inflation))[:, None]
    normal.bias[:, 0] = scaled.T @ depth**2
    place = (points - crop.centre) @ view.camera.pose[:3, :2] / crop.reach
    normal.bias[:, 1:3] = scaled.T @ (depth[:, None] ** 2 * place)
    return normal, scatter, count


def noise_inflation(renderer: RayRenderer, view: View, crop: Crop, scatter: float) -> float:
    """Return the factor by which the correlation of depth noise raises the variance of a mean over a crop's grid.

    It is estimated in all pixels around the body that show what is rendered, because the body's alone are too few.

    Args:
        renderer: Scene in the state of this frame.
        view: The frame.
        crop: Surroundings of the body.
        scatter: Scatter of depth [m].
    """
    stride = int(crop.rows[1] - crop.rows[0]) if len(crop.rows) > 1 else 1
    rows = np.arange(crop.rows[0], crop.rows[-1] + 1)[:NOISE_WINDOW]
    columns = np.arange(crop.columns[0], crop.columns[-1] + 1)[:NOISE_WINDOW]
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(float)
    expected = renderer.cast(view.camera, grid).depth.reshape(len(rows), len(columns))
    measured = view.depth[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    difference = measured - np.where(np.isfinite(expected), expected, 0.0)
    known = (measured > 0) & (np.abs(difference) < 4 * scatter)
    if known.sum() < 100:
        return DEFAULT_INFLATION
    value = np.where(known, difference - difference[known].mean(), 0.0)
    variance = (value**2).sum() / known.sum()
    total, count = 1.0, max(1, CORRELATED // stride)
    for down in range(count + 1):
        for across in range(-count if down else 1, count + 1):
            i, j = down * stride, across * stride
            if i >= len(rows) or abs(j) >= len(columns):
                continue
            first = np.s_[: len(rows) - i, max(0, -j) : len(columns) - max(0, j)]
            second = np.s_[i:, max(0, j) : len(columns) + min(0, j)]
            pairs = (known[first] & known[second]).sum()
            if pairs > 50:
                total += 2 * (value[first] * value[second]).sum() / pairs / variance
    return float(np.clip(total, 1.0, MAX_INFLATION))


@dataclass(frozen=True)
class EdgeResult:
    """Edges found in a frame."""

    normal: Normal
    scatter: float
    """Scatter [px]; NaN where too few were found."""
    found: int
    """Samples of the contour at which the image has an edge nearby."""
    searched: int
    """Samples of the contour that were searched."""


def edge_rows(
    renderer: RayRenderer,
    view: View,
    shape: TrackedShape,
    pose: np.ndarray,
    reach: float,
    cfg: AlignCfg,
    *,
    is_round: bool = False,
) -> EdgeResult:
    """Return the normal equations of the image's edges within `reach` [px] of contour and creases.

    For bodies that are round about an axis the scatter of edges is what a shift of the body leaves of them.
    """
    edges = shape.edges
    points = edges.point @ pose[:3, :3].T + pose[:3, 3]
    sight = points - view.camera.position
    facing = np.einsum("nfk,nk->nf", edges.normals, sight @ pose[:3, :3]) < 0
    contour = facing[:, 0] != facing[:, 1]
    use = np.flatnonzero(contour | (edges.crease & facing.any(axis=1)))
    if len(use) < 6:
        return EdgeResult(Normal(), np.nan, 0, 0)
    if len(use) > cfg.max_edge_samples:
        use = use[np.linspace(0, len(use) - 1, cfg.max_edge_samples).astype(int)]
    pixels, depth, projection = view.pixel_rows(points[use])
    along = np.einsum("nij,nj->ni", projection, edges.direction[use] @ pose[:3, :3].T)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    length = np.linalg.norm(across, axis=1)
    across /= np.maximum(length, 1e-9)[:, None]
    # Away from the object: the face that is seen lies on the other side of its contour.
    front = np.where(facing[use, 0], 0, 1)
    inward = edges.inward[use, front] @ pose[:3, :3].T
    sign = np.einsum("ni,nij,nj->n", across, projection, inward)
    across *= np.where(sign > 0, -1.0, 1.0)[:, None]
    limit = np.array(view.shape[::-1]) - 1 - reach
    good = ((pixels >= reach) & (pixels <= limit)).all(axis=1) & (depth > 0) & (length > 1e-6)
    good &= view.may_show(pixels)
    slack = 0.03 * shape.reach
    steps = np.array(PROFILE) * (reach + 1)
    beside = pixels - INSIDE * across * contour[use, None]
    places = np.concatenate([beside, *(pixels + step * across for step in steps)])
    hits = renderer.cast(view.camera, places)
    # Just inside the contour of a round shape its own surface is nearer to the camera than the contour.
    step_inside = INSIDE * depth * float(1 / view.camera.intrinsics[[0, 1], [0, 1]].min())
    own = (hits.body[: len(use)] == shape.row) & is_round
    nearer = np.where(own, np.sqrt(2 * shape.reach * step_inside), 0.0)
    good &= hits.depth[: len(use)] > depth - slack - nearer * contour[use]
    label = hits.body[len(use) :].reshape(len(steps), -1)
    # Other edges that are known to cross the line of search would be taken for this one: those of what covers the body
    # or stands behind it, and the contour beside a crease.
    inside, outside = label[steps < 0], label[steps > 0]
    background = np.where(contour[use], outside[-1], shape.row)
    good &= ((outside == background) | ((outside == shape.row) & contour[use])).all(axis=0)
    good &= ((inside == shape.row) | (inside == background)).all(axis=0)
    return _matched_edges(
        view,
        pose,
        points[use],
        pixels,
        across,
        projection,
        contour[use],
        good,
        edges.edge[use],
        reach,
        cfg,
        is_round=is_round,
    )


def _matched_edges(
    view: View,
    pose: np.ndarray,
    points: np.ndarray,
    pixels: np.ndarray,
    across: np.ndarray,
    projection: np.ndarray,
    contour: np.ndarray,
    good: np.ndarray,
    number: np.ndarray,
    reach: float,
    cfg: AlignCfg,
    *,
    is_round: bool,
) -> EdgeResult:
    """Return the normal equations of samples (n, ...) at which the image has an edge."""
    searched = int((good & contour).sum())
    if good.sum() < 6:
        return EdgeResult(Normal(), np.nan, 0, searched)
    points, pixels, across, projection = points[good], pixels[good], across[good], projection[good]
    contour, number = contour[good], number[good]
    step = 0.5
    offsets = np.arange(-reach - 2 * step, reach + 2.01 * step, step)
    profile = view.sample(pixels[:, None] + offsets[:, None] * across[:, None])
    gradient = np.abs(profile[:, 4:] - profile[:, :-4] + 0.5 * (profile[:, 3:-1] - profile[:, 1:-3]))
    centre = offsets[2:-2]
    peak = gradient * np.exp(-0.5 * (centre / (0.6 * reach)) ** 2)
    best = np.clip(peak.argmax(axis=1), 1, len(centre) - 2)
    row = np.arange(len(best))
    left, top, right = (gradient[row, best + k] for k in (-1, 0, 1))
    bend = left - 2 * top + right
    shift = np.where(bend < -1e-6, 0.5 * (left - right) / np.where(bend < -1e-6, bend, 1.0), 0.0)
    offset = centre[best] + step * np.clip(shift, -1, 1)
    strong = (top > 5 * view.noise) & (top >= left) & (top >= right) & (np.abs(offset) < reach)
    found = int((strong & contour & (np.abs(offset) < max(2.0, 0.35 * reach))).sum())
    if strong.sum() < 6:
        return EdgeResult(Normal(), np.nan, found, searched)
    direction = np.einsum("ni,nij->nj", across[strong], projection[strong])
    jacobian = point_jacobian(points[strong], pose[:3, 3], direction)
    residual = offset[strong]
    left = _unexplained(jacobian, residual, cfg) if is_round else residual
    scatter = max(MAD * float(np.median(np.abs(left))), cfg.min_edge_std)
    inflation = _chain_inflation(left, number[strong], scatter)
    normal, weight, scatter = weighted(jacobian, residual, cfg.min_edge_std, cfg, inflation, left)
    scaled = jacobian * (weight / (scatter**2 * inflation))[:, None]
    angle = np.arctan2(across[strong, 1], across[strong, 0])
    side = np.floor((angle / np.pi + 1) / 2 * EDGE_SIDES).astype(int) % EDGE_SIDES
    weight = weight / (scatter**2 * inflation)
    for k in range(EDGE_SIDES):
        # What a side has in common in this frame alone (light, aliasing) is an unknown that is eliminated; what it
        # has in common in all frames is left to the covariance.
        mine = side == k
        shared, least = scaled[mine].sum(axis=0), 1 / max(cfg.edge_bias_std, 1e-6) ** 2
        total = weight[mine].sum() + least
        normal.information[:] -= np.outer(shared, shared) / total
        normal.gradient[:] -= shared * (weight[mine] @ residual[mine]) / total
        normal.bias[:, 3 + k] = shared * least / total
    return EdgeResult(normal, scatter, found, searched)


def _unexplained(jacobian: np.ndarray, residual: np.ndarray, cfg: AlignCfg) -> np.ndarray:
    """Return what the place that the edges alone ask for leaves of their residuals (n,), with derivatives (n, 6).

    That a round body is off shifts all of its contour alike. Were this taken for scatter and correlation of edges,
    their weight would be the smaller the farther off it is, and depth would hold it there. Turns are not fitted: wrong
    edges would be explained by them. Where a body has edges of its own in several directions their scatter is real.
    """
    left = residual
    if len(residual) < MIN_OWN_PLACE:
        return left
    for _ in range(OWN_PLACE_ROUNDS):
        normal, _, _ = weighted(jacobian, residual, cfg.min_edge_std, cfg, 1.0, left)
        information = normal.information[:3, :3] + np.eye(3) / NEAR**2
        left = residual - jacobian[:, :3] @ np.linalg.solve(information, normal.gradient[:3])
    return left


def _chain_inflation(residual: np.ndarray, number: np.ndarray, scatter: float) -> float:
    """Return the variance factor of residuals that follow one another along the same edges as a Markov chain."""
    pairs = (number[1:] == number[:-1]) & (np.abs(residual[1:]) < 4 * scatter) & (np.abs(residual[:-1]) < 4 * scatter)
    if pairs.sum() < 8:
        return 2.0
    a, b = residual[1:][pairs], residual[:-1][pairs]
    share = float((a * b).sum() / max(np.sqrt((a**2).sum() * (b**2).sum()), 1e-12))
    share = float(np.clip(share, 0.0, 0.93))
    return float(np.clip((1 + share) / (1 - share), 1.0, MAX_INFLATION))
