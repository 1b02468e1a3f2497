"""Texture points on keyframes: patches of a former frame, on the shape's surface, matched to the current one.

A keyframe keeps the positions of its points on the body, where the lines of sight met the shape at the keyframe's
pose, and those of all pixels of their patches. Each patch is projected to the current prediction and shifted by Lucas
and Kanade's method. All frames are compared with keyframes, never with the frame before, so that errors do not add up
from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import map_coordinates

from concent_warp.perception.tracking.alignment.rows import Crop, Normal, point_jacobian, weighted
from concent_warp.perception.tracking.cfg import AlignCfg, TextureCfg
from concent_warp.perception.tracking.geometry.pose import rotation_angle
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.view import View, sampled

SHIFTED_PATCHES = 12
"""Patches that a common shift is searched with."""
SHIFT_STEP = 2.0
"""Distance of the shifts that are tried [px]: a patch correlates over two pixels or so."""
SHIFT_GAIN = 0.2
"""Advantage in median correlation of a shift over none at which it is taken [-]."""
LOOKED_AT = 0.35
"""Least cosine between normal and line of sight of a texture point [-]."""
MAX_BEND = 0.9
"""Largest change of the normal from the middle of a patch to its corners [-]."""
CREASE = 0.2
"""Change of the normal from one grid pixel to the next from which on there is an edge [-]."""


@dataclass(frozen=True)
class Keyframe:
    """Texture of a body in one frame."""

    points: np.ndarray
    """Positions on the body [m], body frame, shape (n, 3)."""
    normals: np.ndarray
    """Normals there, body frame, shape (n, 3)."""
    grid: np.ndarray
    """Positions of the patches' pixels on the surface [m], body frame, shape (n, p, 3)."""
    patches: np.ndarray
    """Brightness of the patches, of mean 0 and norm 1, shape (n, p)."""
    sight: np.ndarray
    """Orientation of the body in the camera's frame, shape (3, 3)."""
    distance: float
    """Distance of the body from the camera [m]."""
    covariance: np.ndarray
    """Covariance of the keyframe's pose as a twist, shape (6, 6)."""
    pose: np.ndarray
    """Pose at the keyframe, shape (4, 4)."""


@dataclass(frozen=True)
class TextureMap:
    """Keyframes of one body."""

    cfg: TextureCfg
    keyframes: list[Keyframe] = field(default_factory=list)

    def choose(self, view: View, pose: np.ndarray, first: int = 0, factor: float = 1.0) -> Keyframe | None:
        """Return the oldest keyframe, from that number on, that sees the body from about the same side, or None.

        The turn in between is at most the largest of the settings times a factor; with one above 1 the nearest is
        taken.
        """
        sight = view.camera.pose[:3, :3].T @ pose[:3, :3]
        distance = float(np.linalg.norm(pose[:3, 3] - view.camera.position))
        angles = [rotation_angle(k.sight, sight) for k in self.keyframes]
        near = [
            k
            for k in range(first, len(self.keyframes))
            if angles[k] < factor * np.radians(self.cfg.max_angle)
            and 0.75 < distance / self.keyframes[k].distance < 1.33
        ]
        if not near:
            return None
        return self.keyframes[min(near, key=angles.__getitem__) if factor > 1 else near[0]]

    def add(self, view: View, crop: Crop, pose: np.ndarray, covariance: np.ndarray) -> bool:
        """Add a keyframe of what is seen now; return whether there was texture enough."""
        if len(self.keyframes) >= self.cfg.max_keyframes:
            return False
        made = new_keyframe(view, crop, pose, covariance, self.cfg)
        if made is not None:
            self.keyframes.append(made)
        return made is not None


def new_keyframe(view: View, crop: Crop, pose: np.ndarray, covariance: np.ndarray, cfg: TextureCfg) -> Keyframe | None:
    """Return the texture that a frame shows, or None where there are too few points."""
    import cv2

    half = cfg.half_patch
    stride = int(crop.rows[1] - crop.rows[0]) if len(crop.rows) > 1 else 1
    mask = cv2.erode(
        crop.own.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=max(1, round((half + 1) / stride))
    )
    rows, columns = crop.rows, crop.columns
    image = view.grey[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    full = cv2.resize(mask, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_NEAREST)
    if not full.any():
        return None
    # A small body has room for enough points only if they are nearer to each other.
    spacing = float(np.clip(np.sqrt(full.sum() / cfg.points), min(cfg.min_spacing, cfg.spacing), cfg.spacing))
    found = cv2.goodFeaturesToTrack(image, 2 * cfg.points, 0.01, spacing, mask=full, blockSize=5)
    if found is None:
        return None
    pixels = found.reshape(-1, 2).astype(float) + np.array([columns[0], rows[0]])
    step = np.arange(-half, half + 1.0)
    patch = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    around = pixels[:, None] + patch
    brightness = view.sample(around)
    i = np.clip(np.round((pixels[:, 1] - rows[0]) / stride).astype(int), 0, len(rows) - 1)
    j = np.clip(np.round((pixels[:, 0] - columns[0]) / stride).astype(int), 0, len(columns) - 1)
    normal = crop.normal[i, j]
    # The rendered surface, met by the patch's own lines of sight.
    places = (around[..., ::-1] - np.array([rows[0], columns[0]])) / stride
    depth, whole = (_bilinear(values, places) for values in (crop.depth, crop.own.astype(float)))
    rays = view.camera.rays(around) @ view.camera.pose[:3, :3].T
    good = crop.own[i, j] & crop.mask[i, j] & (brightness.std(axis=1) > cfg.min_contrast * view.noise)
    good &= (whole > 0.999).all(axis=1)
    good &= -np.einsum("nk,nk->n", normal, crop.rays[i, j]) > LOOKED_AT * np.linalg.norm(crop.rays[i, j], axis=1)
    bend = np.linalg.norm(crop.normal[i, j] - _corner_normals(crop, i, j, max(1, half // stride)), axis=2).max(axis=0)
    good &= (bend < MAX_BEND) & ~_near_crease(crop, max(1, half // stride))[i, j]
    if good.sum() < cfg.min_points:
        return None
    keep = np.flatnonzero(good)[: cfg.points]
    world = view.camera.position + depth[keep, :, None] * rays[keep]
    rotation = pose[:3, :3]
    grid = (world - pose[:3, 3]) @ rotation
    middle = len(patch) // 2
    return Keyframe(
        grid[:, middle].copy(),
        normal[keep] @ rotation,
        grid,
        _standardised(brightness[keep]),
        view.camera.pose[:3, :3].T @ rotation,
        float(np.linalg.norm(pose[:3, 3] - view.camera.position)),
        covariance,
        pose,
    )


def _corner_normals(crop: Crop, i: np.ndarray, j: np.ndarray, reach: int) -> np.ndarray:
    """Return the normals at four corners of the patches around grid pixels, shape (4, n, 3)."""
    height, width = crop.own.shape
    return np.stack(
        [
            crop.normal[np.clip(i + a * reach, 0, height - 1), np.clip(j + b * reach, 0, width - 1)]
            for a, b in ((-1, -1), (-1, 1), (1, -1), (1, 1))
        ]
    )


def _near_crease(crop: Crop, reach: int) -> np.ndarray:
    """Return whether an edge of the body is within some grid pixels of each, shape (h, w) bool."""
    import cv2

    crease = np.zeros(crop.own.shape, dtype=np.uint8)
    own, normal = crop.own, crop.normal
    below = own[1:] & own[:-1] & (np.linalg.norm(normal[1:] - normal[:-1], axis=2) > CREASE)
    right = own[:, 1:] & own[:, :-1] & (np.linalg.norm(normal[:, 1:] - normal[:, :-1], axis=2) > CREASE)
    for part, edge in ((crease[1:], below), (crease[:-1], below), (crease[:, 1:], right), (crease[:, :-1], right)):
        part[edge] = 1
    return cv2.dilate(crease, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0


def _bilinear(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return values (h, w) between grid pixels, at rows and columns of shape (..., 2)."""
    return map_coordinates(values, np.moveaxis(places, -1, 0), order=1, mode="nearest")


def _standardised(patches: np.ndarray) -> np.ndarray:
    """Return patches (n, p) of mean 0 and norm 1."""
    centred = patches - patches.mean(axis=1, keepdims=True)
    return centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-6)


def texture_rows(
    renderer: RayRenderer,
    view: View,
    shape: TrackedShape,
    pose: np.ndarray,
    keyframe: Keyframe,
    cfg: TextureCfg,
    align: AlignCfg,
) -> tuple[Normal, int, float, float]:
    """Return the normal equations of a keyframe's points, their number, the mean correlation of all visible patches,
    and the scatter of the points [px], NaN where there are too few.
    """
    points = keyframe.points @ pose[:3, :3].T + pose[:3, 3]
    pixels, depth, projection = view.pixel_rows(points)
    sight = points - view.camera.position
    cosine = -np.einsum("nk,nk->n", keyframe.normals @ pose[:3, :3].T, sight) / np.linalg.norm(sight, axis=1)
    border = cfg.half_patch + cfg.max_shift + 2
    inside = ((pixels > border) & (pixels < np.array(view.shape[::-1]) - border)).all(axis=1) & view.may_show(pixels)
    hits = renderer.cast(view.camera, pixels)
    seen = (
        inside
        & (cosine > 0.8 * LOOKED_AT)
        & (hits.body == shape.row)
        & (np.abs(hits.depth - depth) < 0.05 * shape.reach)
    )
    rows = np.flatnonzero(seen)
    if len(rows) < 4:
        return Normal(), 0, 0.0, np.nan
    grid = keyframe.grid[rows] @ pose[:3, :3].T + pose[:3, 3]
    places = view.pixel_rows(grid.reshape(-1, 3))[0].reshape(*grid.shape[:2], 2)
    shift, correlation = _shifts(view.grey, places, keyframe.patches[rows], cfg.max_shift)
    good = (correlation > cfg.min_correlation) & (np.abs(shift).max(axis=1) < cfg.max_shift)
    mean = float(np.clip(correlation, 0, 1).mean())
    if good.sum() < 4:
        return Normal(), int(good.sum()), mean, np.nan
    rows, shift = rows[good], shift[good]
    jacobian = np.concatenate(
        [point_jacobian(points[rows], pose[:3, 3], projection[rows, axis]) for axis in (0, 1)], axis=0
    )
    normal, weight, scatter = weighted(jacobian, shift.T.ravel(), align.min_texture_std, align)
    return normal, int((weight > 0.1).sum() // 2), mean, scatter


def _shifts(image: np.ndarray, places: np.ndarray, patches: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the shifts [px], shape (n, 2), that bring patches (n, p) to an image, and the correlations (n,) there.

    Args:
        image: Brightness, float32, shape (H, W).
        places: Where the patches' pixels are predicted [px], shape (n, p, 2).
        patches: Of mean 0 and norm 1.
        most: Largest shift [px].
    """
    shift = np.zeros((len(places), 2))
    unit = np.eye(2)
    brightness = sampled(image, places)
    for _ in range(4):
        at = places + shift[:, None]
        gradient = np.stack([sampled(image, at + 0.5 * e) - sampled(image, at - 0.5 * e) for e in unit], axis=2).astype(
            float
        )
        gradient -= gradient.mean(axis=1, keepdims=True)
        centred = brightness - brightness.mean(axis=1, keepdims=True)
        # Gain between the keyframe's light and today's.
        gain = np.maximum((centred * patches).sum(axis=1, keepdims=True), 1e-3)
        error = gain * patches - centred
        normal = np.einsum("npa,npb->nab", gradient, gradient) + 1e-3 * np.eye(2)
        step = np.linalg.solve(normal, np.einsum("npa,np->na", gradient, error)[..., None])[..., 0]
        shift = np.clip(shift + np.clip(step, -1.5, 1.5), -most, most)
        brightness = sampled(image, places + shift[:, None])
    return shift, (_standardised(brightness.astype(float)) * patches).sum(axis=1)


def common_shift(
    renderer: RayRenderer, view: View, shape: TrackedShape, pose: np.ndarray, keyframe: Keyframe, cfg: TextureCfg
) -> np.ndarray:
    """Return the translation [m], parallel to the image, shape (3,), at which a keyframe's patches match together.

    All shifts up to `cfg.search_range` are tried on some of the visible patches; zero where none is better than none by
    much, so that a good prediction stays. On a round body it is a displacement of the surface that faces the camera,
    which a turn may cause.
    """
    points = keyframe.points @ pose[:3, :3].T + pose[:3, 3]
    pixels, depth, _ = view.pixel_rows(points)
    sight = points - view.camera.position
    facing = -np.einsum("nk,nk->n", keyframe.normals @ pose[:3, :3].T, sight) > LOOKED_AT * np.linalg.norm(
        sight, axis=1
    )
    seen = facing & view.may_show(pixels) & (renderer.cast(view.camera, pixels).body == shape.row)
    rows = np.flatnonzero(seen)[:: max(1, int(seen.sum()) // SHIFTED_PATCHES)]
    if len(rows) < 4:
        return np.zeros(3)
    edge = 2 * cfg.half_patch + 1
    some = np.arange(edge**2).reshape(edge, edge)[::2, ::2].ravel()
    grid = keyframe.grid[rows][:, some] @ pose[:3, :3].T + pose[:3, 3]
    places = view.pixel_rows(grid.reshape(-1, 3))[0].reshape(*grid.shape[:2], 2)
    patches = _standardised(keyframe.patches[rows][:, some])
    step = np.arange(-cfg.search_range, cfg.search_range + 1e-6, SHIFT_STEP)
    shifts = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    brightness = sampled(view.grey, places[None] + shifts[:, None, None]).astype(float)
    brightness -= brightness.mean(axis=2, keepdims=True)
    norm = np.maximum(np.linalg.norm(brightness, axis=2), 1e-6)
    score = np.median((brightness * patches).sum(axis=2) / norm, axis=1)
    best = int(score.argmax())
    if score[best] < np.median(score) + SHIFT_GAIN or score[best] < score[len(score) // 2] + SHIFT_GAIN:
        return np.zeros(3)
    inverse = np.linalg.inv(view.camera.intrinsics)[:, :2] @ shifts[best]
    return float(np.median(depth[rows])) * (view.camera.pose[:3, :3] @ inverse)
