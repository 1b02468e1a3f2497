"""One frame of one camera, as the tracker uses it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from concent_warp.perception.pinhole import Pinhole

MAD = 1.4826
"""Standard deviation over median absolute deviation of normal noise [-]."""
DEPTH_SPACING = 4
"""Distance of the pixels whose depths are compared for their noise, beyond that over which sensors average [px]."""
MIN_TRIPLES = 100
"""Least number of such comparisons; with fewer, nothing is said of the noise."""
NOISE_KERNEL = np.array([[1.0, -2.0, 1.0]], dtype=np.float32)
"""Mask that is blind to even shading (as in Immerkaer, "Fast noise variance estimation", CVIU 64(2), 1996)."""


@dataclass(frozen=True)
class View:
    """A frame with the camera's pose at its time."""

    camera: Pinhole
    """The camera; its pose is camera-to-world."""
    rgb: np.ndarray
    """Colour, uint8, shape (H, W, 3)."""
    depth: np.ndarray
    """Measured depth [m], float32, shape (H, W), 0 where there is none."""

    @cached_property
    def grey(self) -> np.ndarray:
        """Brightness, float32, shape (H, W)."""
        import cv2

        return cv2.cvtColor(np.ascontiguousarray(self.rgb), cv2.COLOR_RGB2GRAY).astype(np.float32)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width [px]."""
        return self.depth.shape[0], self.depth.shape[1]

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the brightness' noise [1/255]; of some rows of the frame, which is enough."""
        import cv2

        part = self.grey[:: max(1, self.shape[0] // 60)]
        response = cv2.filter2D(part, cv2.CV_32F, NOISE_KERNEL)
        return max(float(MAD * np.median(np.abs(response)) / np.sqrt((NOISE_KERNEL**2).sum())), 0.5)

    @cached_property
    def inverse_depth_noise(self) -> float:
        """Standard deviation of the noise of inverse depth [1/m], about the same at all distances for stereo and
        structured light; 0 where too little is measured. Of a plane inverse depth is linear in the image, so that its
        second differences show the noise alone.
        """
        part = self.depth[:: max(1, self.shape[0] // 60)].astype(float)
        inverse = np.divide(1.0, part, out=np.full(part.shape, np.nan), where=part > 0)
        step = DEPTH_SPACING
        second = inverse[:, 2 * step :] - 2 * inverse[:, step:-step] + inverse[:, : -2 * step]
        second = second[np.isfinite(second)]
        return float(MAD * np.median(np.abs(second)) / np.sqrt(6)) if len(second) >= MIN_TRIPLES else 0.0

    def depth_noise(self, depth: np.ndarray | float) -> np.ndarray:
        """Return the standard deviation of the noise of measured depths [m], any shape."""
        return self.inverse_depth_noise * np.square(depth)

    def sample(self, pixels: np.ndarray) -> np.ndarray:
        """Return the brightness between pixels (..., 2) [px], shape (...); the border's outside."""
        return sampled(self.grey, pixels)

    def window(self, centre: np.ndarray, radius: float) -> tuple[slice, slice] | None:
        """Return rows and columns that a sphere around a world point covers [m], or None outside the image."""
        pixel, distance = self.camera.project(centre)
        if distance <= 1.05 * radius:
            return None
        half = radius * self.camera.intrinsics[[0, 1], [0, 1]] / (distance - radius) + 6
        limit = np.array(self.shape[::-1])
        low = np.clip(np.floor(pixel - half), 0, limit).astype(int)
        high = np.clip(np.ceil(pixel + half) + 1, 0, limit).astype(int)
        if (high - low < 3).any():
            return None
        return slice(low[1], high[1]), slice(low[0], high[0])

    def pixel_rows(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return pixels [px] (n, 2), depths [m] (n,) and derivatives of the pixels [px/m] (n, 2, 3) of world points."""
        camera = self.camera
        local = (points - camera.position) @ camera.pose[:3, :3]
        depth = np.where(local[:, 2] > 1e-6, local[:, 2], 1e-6)
        focal, skew = camera.intrinsics[[0, 1], [0, 1]], camera.intrinsics[0, 1]
        flat = local[:, :2] / depth[:, None]
        pixels = flat * focal + camera.intrinsics[:2, 2]
        pixels[:, 0] += skew * flat[:, 1]
        inner = np.zeros((len(points), 2, 3))
        inner[:, 0, 0], inner[:, 1, 1] = focal[0] / depth, focal[1] / depth
        inner[:, 0, 1] = skew / depth
        inner[:, 0, 2] = -(focal[0] * flat[:, 0] + skew * flat[:, 1]) / depth
        inner[:, 1, 2] = -focal[1] * flat[:, 1] / depth
        return pixels, local[:, 2], inner @ camera.pose[:3, :3].T


def sampled(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return an image, float32 (H, W), between its pixels (..., 2) [px], linearly, shape (...)."""
    import cv2

    flat = np.ascontiguousarray(pixels.reshape(-1, 2), dtype=np.float32)
    # OpenCV's maps have at most 32767 rows or columns.
    width = 1024
    padded = np.zeros((-(-len(flat) // width) * width, 2), dtype=np.float32)
    padded[: len(flat)] = flat
    grid = padded.reshape(-1, width, 2)
    found = cv2.remap(image, grid, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # pyright: ignore
    return found.ravel()[: len(flat)].reshape(pixels.shape[:-1])
