"""Tracking of pixels between images, and their depth.

Optical flow by Lucas and Kanade ("An iterative image registration technique with an application to stereo vision",
IJCAI 1981), over an image pyramid, kept where tracking the point back returns to its start (Kalal, Mikolajczyk
and Matas, "Forward-backward error: automatic detection of tracking failures", ICPR 2010). Points are corners in the
sense of Shi and Tomasi ("Good features to track", CVPR 1994).
"""

from __future__ import annotations

import numpy as np


def grayscale(rgb: np.ndarray) -> np.ndarray:
    """Return the brightness, uint8, shape (H, W), of an image, uint8, shape (H, W, 3)."""
    import cv2

    return cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)


def track_pixels(
    before: np.ndarray, after: np.ndarray, pixels: np.ndarray, guess: np.ndarray, *, window: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tracked pixels, shape (n, 2) [px], and whether each passed the forward-backward test, shape (n,) bool.

    Args:
        before: Brightness of the image that the points are known in, uint8, shape (H, W).
        after: Brightness of the next image.
        pixels: Points in `before` [px], shape (n, 2).
        guess: Initial estimate of the points in `after` [px], shape (n, 2).
        window: Edge of the square around a point that is compared [px].
        tolerance: Largest forward-backward error [px].
    """
    import cv2

    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    options = {
        "winSize": (window, window),
        "maxLevel": 2,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, guess.astype(np.float32).reshape(-1, 1, 2).copy(), **options
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, start.copy(), **options)
    there, back = there.reshape(-1, 2).astype(float), back.reshape(-1, 2)
    height, width = before.shape
    inside = ((there >= 0) & (there <= [width - 1, height - 1])).all(axis=1)
    close = np.linalg.norm(back - pixels, axis=1) < tolerance
    return there, inside & close & (found.ravel() == 1) & (returned.ravel() == 1)


def corners(image: np.ndarray, region: np.ndarray, taken: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """Return up to `count` corners [px], shape (n, 2), in a region and at least `spacing` [px] apart.

    Args:
        image: Brightness, uint8, shape (H, W).
        region: Where corners may lie, shape (H, W) bool.
        taken: Points that new ones keep the spacing to [px], shape (k, 2).
        count: How many corners at most.
        spacing: Least distance between corners [px].
    """
    import cv2

    mask = np.where(region, 255, 0).astype(np.uint8)
    for column, row in np.round(taken).astype(int):
        cv2.circle(mask, (int(column), int(row)), round(spacing), 0, -1)
    if count <= 0 or not mask.any():
        return np.zeros((0, 2))
    found = cv2.goodFeaturesToTrack(image, count, 0.02, spacing, mask=mask, blockSize=3)
    if found is None:
        return np.zeros((0, 2))
    refined = cv2.cornerSubPix(image, found, (2, 2), (-1, -1), (cv2.TERM_CRITERIA_COUNT, 10, 0.01))
    pixels = refined.reshape(-1, 2).astype(float)
    row, column = np.clip(np.round(pixels[:, ::-1]).astype(int), 0, np.array(mask.shape) - 1).T
    return pixels[mask[row, column] > 0]


def eroded(region: np.ndarray, margin: int) -> np.ndarray:
    """Return a region (H, W) bool without the pixels within `margin` [px] of its border."""
    import cv2

    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    return cv2.erode(region.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def depth_at(depth: np.ndarray, pixels: np.ndarray, *, radius: int = 2, spread: float = 0.01) -> np.ndarray:
    """Return the depth [m] at points between pixels, shape (n,); NaN where too little is measured around them.

    A plane is fitted to the measured depths around each point, those within `spread` [m] of their median; over a plane
    inverse depth is linear in the pixel coordinates.

    Args:
        depth: Measured depth [m], shape (H, W), 0 where there is none.
        pixels: Points [px], shape (n, 2).
        radius: Half edge of the square of pixels used.
        spread: Largest difference from the median [m].
    """
    height, width = depth.shape
    step = np.arange(-radius, radius + 1)
    down, across = (a.ravel() for a in np.meshgrid(step, step, indexing="ij"))
    nearest = np.round(pixels).astype(int)
    row, column = nearest[:, 1, None] + down, nearest[:, 0, None] + across
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    value = np.where(inside, depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)], 0.0)
    value = np.where(value > 0, value, np.nan)
    few = np.isfinite(value).sum(axis=1) < len(step)
    value[few] = 1.0
    used = np.abs(value - np.nanmedian(value, axis=1, keepdims=True)) < spread
    few |= used.sum(axis=1) < len(step)
    basis = np.stack([np.ones(row.shape), column - pixels[:, 0, None], row - pixels[:, 1, None]], axis=2)
    basis = basis * used[:, :, None]
    normal = np.swapaxes(basis, 1, 2) @ basis + 1e-6 * np.eye(3)
    right = np.einsum("nkd,nk->nd", basis, np.where(used, 1 / np.where(used, value, 1.0), 0.0))
    inverse_depth = np.linalg.solve(normal, right[..., None])[:, 0, 0]
    return np.divide(1.0, inverse_depth, out=np.full(len(pixels), np.nan), where=~few & (inverse_depth > 0))
